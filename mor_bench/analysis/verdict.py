"""The verdict on a dataset's configurations, and the limits that they must meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

from mor_bench.analysis.draws import Interval
from mor_bench.analysis.frontier import median_latency_ms, number_or_inf, selecting_error
from mor_bench.analysis.told import FORCE, classes_of
from mor_bench.errors import InvalidInputError
from mor_bench.results.comparison import Comparison
from mor_bench.results.json_file import without_nan
from mor_bench.results.row import Row
from mor_bench.specs.method_spec import Told

RULE = (
    "The fastest configuration wins that answers every load and whose 95 % upper bounds of latency "
    "and of error on the validation part, and whose median error on a fresh test set if there is "
    "one, meet the limits."
)

Figures = Mapping[str, Mapping[str, float]]
"""By label: the upper bounds of the figures that requirements limit, by their names."""


@dataclass(frozen=True)
class Requirements:
    """Upper limits; None means no limit.

    Attributes
    ----------
    error
        Median relative L2 error, as a fraction.
    latency_ms
        Median latency of one query, ms.
    memory_bytes
        Peak memory of a predicting process, bytes.
    offline_s
        Sum of data generation and fitting, core-seconds.

    Raises
    ------
    InvalidInputError
        If a limit is not a positive number.
    """

    error: float | None = None
    latency_ms: float | None = None
    memory_bytes: float | None = None
    offline_s: float | None = None

    def __post_init__(self) -> None:
        for name, limit in self.asked.items():
            is_number = isinstance(limit, int | float) and not isinstance(limit, bool)
            if not (is_number and limit > 0 and isfinite(limit)):
                raise InvalidInputError(f"`{name}` must be a positive number; got {limit!r}.")

    @property
    def asked(self) -> dict[str, float]:
        """The given limits, by name."""
        return {name: limit for name, limit in asdict(self).items() if limit is not None}


def needs_of(comparison: Comparison, dataset: str) -> Requirements:
    """Return the limits that a dataset's file states."""
    stated = comparison.datasets.get(dataset, {}).get("needs") or {}
    return Requirements(stated.get("error"), stated.get("latency_ms"))


@dataclass(frozen=True)
class Relaxation:
    """One limit that would let a configuration qualify if it alone changed.

    Attributes
    ----------
    name : str
        Name of the requirement.
    asked, needed : float
        The present limit, and the strictest one that suffices.
    row : Row
        The configuration that then qualifies.
    """

    name: str
    asked: float
    needed: float
    row: Row


@dataclass(frozen=True)
class Verdict:
    """The winner on a dataset, and what stands beside it.

    Attributes
    ----------
    dataset : str
    requirements : Requirements
    rows : list of Row
        All configurations of the dataset.
    qualified : list of Row
        The fastest first.
    undecided : list of Row
        Qualified configurations whose latency cannot be told apart from the winner's.
    relaxations : list of Relaxation
        Without a winner: the limits that suffice if relaxed alone.
    nearest : Row or None
        Without a winner: the configuration that exceeds the limits by the smallest factor.
    unknown : list of str
        Without a winner: requirements on a figure that no configuration has.
    nearest_told : dict
        By class of information: of those that answer every load, the configuration that exceeds the
        limits by the smallest factor; None if there is none.
    n_without_answers : int
        Configurations that failed, were skipped or left a load without an answer.
    figures : dict
        By label: the upper bounds that the limits are compared with.
    intervals : dict
        By label: the 95 % intervals, see `mor_bench.analysis.draws.Draws`.
    given : str
        Input of the dataset's queries in words, see `mor_bench.analysis.told.given_by`.
    run : Path or None
        Folder of the comparison.
    machine, settings : dict
        Those of the comparison, with the names of its datasets and methods.
    headline : str
        The winner and its error on the test set.
    beside : list of str
        Sentences about everything else.
    evidence : list of str
        Lines with the figures of the winner, or of the nearest configuration.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:  # doctest: +SKIP
    ...     comparison = mor_bench.run(["beam-tiny"], ["linear-fem"], out=f"{folder}/run")
    ...     verdict = mor_bench.pick("beam-tiny", comparison=comparison, error=1e-6)
    ...     verdict.qualified, verdict.nearest.label
    ([], 'linear-fem')
    """

    dataset: str
    requirements: Requirements
    rows: Sequence[Row]
    qualified: Sequence[Row] = ()
    undecided: Sequence[Row] = ()
    relaxations: Sequence[Relaxation] = ()
    nearest: Row | None = None
    unknown: Sequence[str] = ()
    nearest_told: Mapping[Told | None, Row | None] = field(default_factory=dict)
    n_without_answers: int = 0
    figures: Figures = field(default_factory=dict)
    intervals: Mapping[str, Mapping[str, Interval]] = field(default_factory=dict)
    given: str = FORCE
    run: Path | None = None
    machine: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    headline: str = ""
    beside: Sequence[str] = ()
    evidence: Sequence[str] = ()

    @property
    def choice(self) -> Row | None:
        """The winner."""
        return self.qualified[0] if self.qualified else None

    @property
    def runner_up(self) -> Row | None:
        """The fastest qualified configuration of another method."""
        return next((r for r in self.qualified if r.method != self.qualified[0].method), None)

    @property
    def cheapest(self) -> Row | None:
        """The qualified configuration with the least offline cost; a tie goes to the faster one."""
        return min(self.qualified, key=offline_rank, default=None)

    @property
    def best_told(self) -> dict[Told | None, Row | None]:
        """The fastest qualified configuration of each class of information; None if none is."""
        return {
            told: next((row for row in self.qualified if row.told == told), None)
            for told in classes_of(self.rows)
        }

    def text(self) -> str:
        """Return the whole verdict for readers."""
        return "\n".join([self.headline, *self.evidence, *self.beside])

    def as_json(self) -> dict[str, Any]:
        """Return everything for `json.dumps`; infinite errors become strings."""
        rows = {name: getattr(self, name) for name in ("choice", "runner_up", "cheapest")}
        rows["nearest"] = self.nearest
        content = {
            **self.summary(),
            "requirements": self.requirements.asked,
            **{name: row and row.as_dict() for name, row in rows.items()},
            "relaxations": [{**vars(item), "row": item.row.as_dict()} for item in self.relaxations],
            "unknown": list(self.unknown),
            "n_configurations": len(self.rows),
            "n_meeting": len(self.qualified),
            "n_without_answers": self.n_without_answers,
            "run": None if self.run is None else str(self.run),
        }
        plain: dict[str, Any] = without_nan(content)
        return plain

    def summary(self) -> dict[str, Any]:
        """Return the sentences, and the labels of the winner and of those beside it."""
        best = {told or "not stated": row and row.label for told, row in self.best_told.items()}
        named = {name: getattr(self, name) for name in ("choice", "runner_up", "cheapest")}
        return {
            "dataset": self.dataset,
            "headline": self.headline,
            "evidence": list(self.evidence),
            "beside": list(self.beside),
            **{name: row and row.label for name, row in named.items()},
            "qualified": [row.label for row in self.qualified],
            "undecided": [row.label for row in self.undecided],
            "best_told": best,
        }


CHANCE_S = 1.0
"""Offline cost below which repeated fits differ by factors, core-seconds; not shown in digits."""


def offline_rank(row: Row) -> tuple[Any, ...]:
    """Rank by offline cost in core-seconds, to two digits, then by speed.

    Costs below `CHANCE_S` count as equal. Rows with an unknown cost come last.
    """
    seconds = number_or_inf(row.offline_core_s)
    return 0.0 if seconds < CHANCE_S else float(f"{seconds:.1e}"), *speed_rank(row)


def speed_rank(row: Row) -> tuple[float, float, str]:
    """Rank by latency, then by the error that selects."""
    return median_latency_ms(row), selecting_error(row), row.label
