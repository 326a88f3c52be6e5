"""A comparison for notebooks: it shows itself as a table, and draws on axes of matplotlib.

The functions that draw are those of the files. They are imported when they are used, because
matplotlib takes long to import.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.verdict import needs_of
from mor_bench.errors import InvalidInputError
from mor_bench.report.console_columns import MAIN, NOTE
from mor_bench.report.entries import (
    Entry,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.short_names import constants, renamed, short_names
from mor_bench.results import comparison as results
from mor_bench.runs import compare
from mor_bench.runs.listener import Listener
from mor_bench.specs.one_line_errors import nearest_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

T = TypeVar("T")


class Comparison(results.Comparison):
    """The results of a run, with pictures of them.

    `table` is a `pandas.DataFrame`. The functions `plot_…` draw on the given axes, or on new ones,
    and return them. See `mor_bench.results.comparison.Comparison` for the attributes.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:  # doctest: +SKIP
    ...     _ = run(["beam-tiny"], ["linear-fem"], out=f"{folder}/run")
    ...     Comparison.read(f"{folder}/run").table[["dataset", "method", "n_test"]]
         dataset      method  n_test
    0  beam-tiny  linear-fem      40
    """

    @classmethod
    def of(cls, found: results.Comparison) -> Comparison:
        """Return the same comparison with pictures."""
        return cls(**{field.name: getattr(found, field.name) for field in fields(found)})

    def plot_frontier(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw error over latency with the Pareto front, the needs and the mesh's own error.

        Parameters
        ----------
        ax : matplotlib axes, optional
        dataset : str, optional
            Needed if the comparison has several.

        Raises
        ------
        InvalidInputError
            If there is no such dataset, or nothing to draw.
        """
        from mor_bench.report.error_against_time import draw_frontier
        from mor_bench.report.frontier_plane import timed_and_scored

        name = self._dataset(dataset)
        self.analysis = self.analysis or analyse(self)
        entries = entries_of(self, name, self.analysis)
        _known(name, timed_and_scored(entries))
        draw_frontier(ax := _axes(ax), entries, needs_of(self, name))
        return ax

    def plot_error_distribution(
        self, ax: Axes | None = None, *, dataset: str | None = None
    ) -> Axes:
        """Draw the share of test loads with at most an error, for one of each method."""
        from mor_bench.report.distribution_figure import draw_distribution, staircases

        name = self._dataset(dataset)
        self.analysis = self.analysis or analyse(self)
        found = _known(name, staircases(self, name, "relative_l2", self.analysis))
        draw_distribution(ax := _axes(ax), found, needs_of(self, name))
        return ax

    def plot_whole_cost(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw core-seconds over the number of queries, with the break-even of each method."""
        from mor_bench.report.whole_cost import costs_of, draw_totals

        name = self._dataset(dataset)
        self.analysis = self.analysis or analyse(self)
        costs = costs_of(self, name, self.analysis, entries_of(self, name, self.analysis))
        draw_totals(ax := _axes(ax), _known(name, costs))
        return ax

    def plot_learning_curves(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw error over number of training samples, log-log; a full comparison has them."""
        from mor_bench.report.training_curves import draw_learning, learning_lines

        name = self._dataset(dataset)
        lines, _ = learning_lines(self, name)
        names = short_names(row for row in self.rows if row.dataset == name)
        draw_learning(ax := _axes(ax), _known(name, lines), names)
        return ax

    def plot_singular_values(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw the singular values of the training snapshots, and what r modes leave out."""
        from mor_bench.report.singular_values import draw_singular_values, spectrum_of

        name = self._dataset(dataset)
        spectrum = _known(name, spectrum_of(self.dataset_arrays(name)))
        draw_singular_values(ax := _axes(ax), spectrum, entries_of(self, name))
        return ax

    def _repr_html_(self) -> str:
        """Show the verdict and the six columns of each dataset."""
        self.analysis = self.analysis or analyse(self)
        return "".join(self._html_of(name) for name in dataset_names(self))

    def _html_of(self, dataset: str) -> str:
        assert self.analysis is not None
        entries = entries_of(self, dataset, self.analysis)
        names = short_names(entry.row for entry in entries)
        headline = renamed(
            verdict_of(self.analysis, dataset).get("headline", "No configuration."), names
        )
        headings = ["configuration", *(heading.replace("\n", " ") for heading in MAIN)]
        rows = [
            [f"{names[e.label]}{' *' if e.pareto_mark == '*' else ''}", *_cells(e)] for e in entries
        ]
        fixed = constants(entry.row for entry in entries)
        note = f"{NOTE} Same in all rows: {fixed}." if fixed else NOTE
        head = "".join(f'<th scope="col">{escape(text)}</th>' for text in headings)
        body = "".join(_html_row(row) for row in rows)
        return (
            f"<h3>{escape(dataset)}</h3><p>{escape(headline)}</p><table><caption>{escape(note)}"
            f"</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        )

    def _dataset(self, name: str | None) -> str:
        """Return the name of the dataset to draw."""
        known = dataset_names(self)
        if name is None and len(known) == 1:
            return known[0]
        if name not in known:
            given = "is needed" if name is None else f"{name!r} is unknown"
            near = "." if name is None else nearest_name(name, known)
            raise InvalidInputError(f"`dataset` {given}{near} Datasets: {', '.join(known)}.")
        return name


def run(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    out: str | Path | None = None,
    *,
    listener: Listener = Listener(),
    **options: Any,
) -> Comparison:
    """Compare methods on datasets; see `mor_bench.runs.compare.run`."""
    return Comparison.of(compare.run(datasets, methods, profile, out, listener=listener, **options))


run.__doc__ = compare.run.__doc__


def _known(dataset: str, found: T | None) -> T:
    """Return what was found; raise `InvalidInputError` if there is nothing to draw."""
    if not found:
        raise InvalidInputError(f"the run has nothing of this kind to draw for {dataset}.")
    return found


def _cells(entry: Entry) -> list[str]:
    cells: list[Callable[[Entry], str]] = list(MAIN.values())
    return [cell(entry) for cell in cells]


def _html_row(cells: Sequence[str]) -> str:
    first, *others = map(escape, cells)
    return f'<tr><th scope="row">{first}</th>{"".join(f"<td>{text}</td>" for text in others)}</tr>'


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained")[1]
