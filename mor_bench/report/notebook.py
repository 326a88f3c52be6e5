"""A comparison for notebooks: it shows itself as a table, and draws on axes of matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from html import escape
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.verdict import needs_of
from mor_bench.errors import InvalidInputError
from mor_bench.report.console_columns import MAIN, NOTE
from mor_bench.report.entries import (
    Entry,
    best_per_method,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.method_styles import style_of
from mor_bench.report.short_names import constants, renamed, short_names
from mor_bench.results import comparison as results
from mor_bench.runs import compare
from mor_bench.runs.listener import Listener
from mor_bench.specs.one_line_errors import nearest_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

METRICS = {
    "rel_l2_median": ("relative L2 error, median (%)", 100.0),
    "rel_l2_p95": ("relative L2 error, 95th percentile (%)", 100.0),
    "rel_l2_max": ("relative L2 error, maximum (%)", 100.0),
    "mean_dof_m": ("mean error per degree of freedom, ē (m)", 1.0),
    "max_nodal_m": ("largest nodal error (m)", 1.0),
    "tip_rel_median": ("relative error at the tip, median (%)", 100.0),
}
"""Errors that can be drawn: the axis label, and the factor to its unit."""

TIMES = {"median": "median", "p95": "95th percentile", "p99": "99th percentile"}
"""Latencies that can be drawn."""

LEAST_ERROR = 1e-6
"""Smaller values of a metric are drawn here: a reference has nearly no error."""


class Comparison(results.Comparison):
    """The results of a run, with pictures of them.

    `table` is a `pandas.DataFrame`. The functions `plot_…` draw on the given axes, or on new ones,
    and return them. See `mor_bench.results.comparison.Comparison` for the attributes.
    """

    @classmethod
    def of(cls, found: results.Comparison) -> Comparison:
        """Return the same comparison with pictures."""
        return cls(**{field.name: getattr(found, field.name) for field in fields(found)})

    def plot_frontier(
        self,
        ax: Axes | None = None,
        *,
        dataset: str | None = None,
        error: str = "rel_l2_median",
        latency: str = "median",
    ) -> Axes:
        """Draw error over latency, log-log, and the Pareto front of the medians as steps.

        Parameters
        ----------
        ax : matplotlib axes, optional
        dataset : str, optional
            Needed if the comparison has several.
        error, latency : str
            A name in `METRICS` and in `TIMES`.

        Raises
        ------
        InvalidInputError
            If a name is unknown; the message gives the nearest one.
        """
        _check_name("error", error, METRICS)
        _check_name("latency", latency, TIMES)
        name = self._dataset(dataset)
        label, scale = METRICS[error]
        entries = [e for e in entries_of(self, name) if _is_drawn(e, error, latency)]
        names = short_names(entry.row for entry in entries)
        ax = _axes(ax)
        for method, mine in _by_method(entries).items():
            style = style_of(method)
            xy = np.array([_place(e, error, latency, scale) for e in mine])
            ax.plot(*xy.T, marker=style.marker, color=style.colour, lw=0.9, label=method)
            for entry, (x, y) in zip(mine, xy, strict=True):
                text = names[entry.label].values
                ax.annotate(_plain(text), (x, y), xytext=(4, 4), textcoords="offset points", size=7)
        if (error, latency) == ("rel_l2_median", "median"):
            _draw_front(ax, [e for e in entries if e.on_front], scale)
            _draw_needs(ax, self, name)
        ax.set(xscale="log", yscale="log", title=_plain(name))
        ax.set(xlabel=f"latency of one query, {TIMES[latency]} (ms)", ylabel=label)
        if entries:
            ax.legend(fontsize="small", frameon=False)
        return ax

    def plot_error_distribution(
        self, ax: Axes | None = None, *, dataset: str | None = None
    ) -> Axes:
        """Draw the share of test samples with at most an error, for the best of each method."""
        name, ax = self._dataset(dataset), _axes(ax)
        for entry in best_per_method(entries_of(self, name)):
            errors = 100 * np.sort(self.samples(entry.row)["relative_l2"])
            style, share = style_of(entry.method), 100 * np.arange(1, len(errors) + 1) / len(errors)
            shown = np.isfinite(errors) & (errors > 0)
            ax.step(
                errors[shown], share[shown], where="post", color=style.colour, label=entry.method
            )
        ax.set(xscale="log", ylim=(0, 101), title=_plain(name), ylabel="test samples (%)")
        ax.set_xlabel("relative L2 error of a sample, at most (%)")
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize="small", frameon=False)
        return ax

    def plot_learning_curves(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw error over number of training samples, log-log; a full comparison has them."""
        name, ax = self._dataset(dataset), _axes(ax)
        points = [p for p in self.learning if p.dataset == name and p.error]
        for method in dict.fromkeys(point.method for point in points):
            curve = sorted(
                (p.n_train, 100 * p.error.rel_l2_median)
                for p in points
                if p.method == method and p.error and 0 < p.error.rel_l2_median < np.inf
            )
            style, xy = style_of(method), np.array(curve).reshape(-1, 2)
            ax.plot(*xy.T, marker=style.marker, color=style.colour, label=method)
        ax.set(xscale="log", yscale="log", title=_plain(name), xlabel="training samples")
        ax.set_ylabel(METRICS["rel_l2_median"][0])
        if points:
            ax.legend(fontsize="small", frameon=False)
        return ax

    def plot_singular_values(self, ax: Axes | None = None, *, dataset: str | None = None) -> Axes:
        """Draw the singular values of the training snapshots relative to the largest."""
        name, ax = self._dataset(dataset), _axes(ax)
        values = np.asarray(self.dataset_arrays(name)["singular_values"], dtype=float)
        ax.plot(np.arange(1, len(values) + 1), values / values[0], marker=".", color="#222222")
        ax.set(xscale="log", yscale="log", title=_plain(name), xlabel="number of the mode")
        ax.set_ylabel("singular value, relative to the largest")
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


def _check_name(key: str, name: str, known: Mapping[str, object]) -> None:
    if name not in known:
        raise InvalidInputError(
            f"`{key}`: unknown metric {name!r}{nearest_name(name, known)} "
            f"Known: {', '.join(known)}."
        )


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


def _plain(text: str) -> str:
    return text.replace("$", r"\$")


def _is_drawn(entry: Entry, error: str, latency: str) -> bool:
    values = entry.figure("error", error), entry.figure("latency_ms", latency)
    return entry.ran and all(value is not None and isfinite(value) for value in values)


def _place(entry: Entry, error: str, latency: str, scale: float) -> tuple[float, float]:
    x, y = entry.figure("latency_ms", latency), entry.figure("error", error)
    assert x is not None
    assert y is not None
    return x, scale * max(y, LEAST_ERROR)


def _by_method(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    methods: dict[str, list[Entry]] = {}
    for entry in entries:
        methods.setdefault(entry.method, []).append(entry)
    return methods


def _draw_front(ax: Axes, front: Sequence[Entry], scale: float) -> None:
    xy = np.array(sorted(_place(e, "rel_l2_median", "median", scale) for e in front))
    if len(xy):
        ax.step(*xy.T, where="post", color="#222222", lw=1, ls="--", label="Pareto front")


def _draw_needs(ax: Axes, comparison: results.Comparison, dataset: str) -> None:
    """Mark the limits of the dataset's user."""
    needs = needs_of(comparison, dataset)
    look: dict[str, Any] = {"color": "#6a9a55", "lw": 1, "zorder": 0}
    if needs.latency_ms is not None:
        ax.axvline(needs.latency_ms, **look)
    if needs.error is not None:
        ax.axhline(100 * needs.error, **look)
