"""Choose the cheapest configuration that meets a scene's requirements, from a comparison's rows.

A configuration qualifies only if its 95 % upper bounds meet the limits, on the test set and on a
fresh one. It does not qualify if a figure is unknown or a test load has no answer.

The qualifying configuration with the least offline cost is chosen: data generation and fitting are
paid again for every new body, material or support. Offline seconds are rounded to two digits and
whole seconds, because repeated trainings differ by less. A tie goes to the lower latency.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import inf, isfinite
from pathlib import Path
from typing import Any

from mor_bench.analysis.selection_text import FIGURE_NAMES, evidence, limit_text
from mor_bench.errors import InvalidInputError
from mor_bench.results.json_file import without_nan
from mor_bench.results.row import Row

RANKED_BY = "offline cost (data + fit, to the second and two digits), then latency, then memory"


@dataclass(frozen=True)
class Requirements:
    """Upper limits; None means no limit.

    Attributes
    ----------
    error
        Median relative L2 error over the test set, as a fraction.
    latency_ms
        Median latency of one query, ms.
    memory_bytes
        Peak memory of a predicting process, bytes.
    offline_s
        Sum of data generation, core-seconds, and fitting, seconds.

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
class Pick:
    """The chosen configuration and the evidence.

    Attributes
    ----------
    dataset : str
    requirements : Requirements
    choice, runner_up : Row or None
        The cheapest configuration that qualifies, and the cheapest of another method.
    relaxations : list of Relaxation
        Without a choice: the limits that suffice if relaxed alone.
    nearest : Row or None
        Without a choice: the configuration that exceeds the limits by the smallest factor.
    unknown : list of str
        Without a choice: requirements on a figure that no configuration has.
    n_configurations, n_meeting : int
    n_without_answers : int
        Configurations that failed, were skipped or left a test load without an answer.
    run : Path or None
        Folder of the comparison.
    processor, kind : str
        Processor of the timings; profile, split and number of samples of the run.
    """

    dataset: str
    requirements: Requirements
    choice: Row | None
    runner_up: Row | None
    relaxations: list[Relaxation]
    nearest: Row | None
    unknown: list[str]
    n_configurations: int
    n_meeting: int
    n_without_answers: int
    run: Path | None = None
    processor: str = ""
    kind: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return everything for `json.dumps`; infinite errors become strings."""
        rows = {name: getattr(self, name) for name in ("choice", "runner_up", "nearest")}
        content = {
            **vars(self),
            **{name: row and row.as_dict() for name, row in rows.items()},
            "relaxations": [{**vars(item), "row": item.row.as_dict()} for item in self.relaxations],
            "requirements": self.requirements.asked,
            "ranked_by": RANKED_BY,
            "run": None if self.run is None else str(self.run),
        }
        plain: dict[str, Any] = without_nan(content)
        return plain

    def text(self) -> str:
        """Return a few lines of text for readers."""
        limits = [limit_text(name, limit) for name, limit in self.requirements.asked.items()]
        counted = f"{self.n_configurations} configurations"
        excluded = (
            f"; {self.n_without_answers} of them failed, were skipped or left loads without an "
            "answer"
            if self.n_without_answers
            else ""
        )
        lines = [f"{self.dataset} needs {', '.join(limits)}."]
        if self.choice is None:
            lines.append(f"None of {counted} meets all{excluded}.")
            lines += self._relaxation_lines()
        else:
            lines += [f"Cheapest by {RANKED_BY}:", *evidence(self.choice)]
            if self.runner_up is None:
                lines.append("No other method meets all.")
            else:
                lines += ["Next method:", *evidence(self.runner_up)]
            lines.append(f"{self.n_meeting} of {counted} meet all{excluded}.")
        if self.run is not None:
            processor = f"timed on {self.processor}" if self.processor else ""
            parts = filter(None, [str(self.run), self.kind, processor])
            lines.append(f"Evidence: {', '.join(parts)}")
        return "\n".join(lines)

    def _relaxation_lines(self) -> list[str]:
        lines = []
        relaxed = {item.name: item for item in self.relaxations}
        for name in self.requirements.asked:
            if name in self.unknown:
                lines.append(f"Not known of any configuration: {FIGURE_NAMES[name]}")
            elif name in relaxed:
                needed = limit_text(name, relaxed[name].needed, round_up=True)
                lines.append(f"Enough alone: {needed}, by {relaxed[name].row.label}")
            else:
                lines.append(f"Not enough alone: {FIGURE_NAMES[name]}, whatever the limit")
        if self.nearest is not None:
            excess = _excesses(self.nearest, self.requirements)
            misses = ", ".join(
                f"{FIGURE_NAMES[name]} {factor:.3g} times the limit"
                for name, factor in excess.items()
                if factor > 1
            )
            lines += [f"Nearest, with {misses}:", *evidence(self.nearest)]
        return lines


def figure(row: Row, name: str) -> float:
    """Return the figure that a requirement limits; infinite where it is unknown."""
    value: float | None = None
    if name == "error" and row.error:
        high, fresh = row.error.rel_l2_median_high, row.hidden
        value = max(high or row.error.rel_l2_median, fresh.rel_l2_median if fresh else 0.0)
    elif name == "latency_ms" and row.latency_ms:
        value = max(row.latency_ms.high or 0.0, row.latency_ms.median)
    elif name == "memory_bytes" and row.memory_bytes:
        value = row.memory_bytes.predict
    elif name == "offline_s" and row.offline_s and row.offline_s.data is not None:
        value = row.offline_s.data + row.offline_s.fit
    return inf if value is None or not value >= 0 else value


def choose(rows: Sequence[Row], requirements: Requirements, dataset: str) -> Pick:
    """Choose among the rows of one dataset; rows of other datasets are left out."""
    asked = requirements.asked
    mine = [row for row in rows if row.dataset == dataset]
    answering = [row for row in mine if _answers_all(row)]
    meeting = sorted((row for row in answering if _meets(row, asked)), key=_rank)
    first = meeting[0] if meeting else None
    second = next((row for row in meeting if row.method != meeting[0].method), None)
    chosen = Pick(
        dataset=dataset,
        requirements=requirements,
        choice=first,
        runner_up=second,
        relaxations=[],
        nearest=None,
        unknown=[],
        n_configurations=len(mine),
        n_meeting=len(meeting),
        n_without_answers=len(mine) - len(answering),
    )
    if meeting:
        return chosen
    relaxations = [found for name in asked if (found := _relaxation(name, asked, answering))]
    unknown = [name for name in asked if all(figure(row, name) == inf for row in answering)]
    nearest = _nearest(answering, requirements)
    return replace(chosen, relaxations=relaxations, nearest=nearest, unknown=unknown)


def offline_rank(row: Row) -> tuple[bool, float]:
    """Return offline seconds for comparison: two digits, whole seconds.

    Rows with unknown data cost come last, ordered by fitting time.
    """
    if row.offline_s is None:
        return True, inf
    seconds = row.offline_s.fit + (row.offline_s.data or 0.0)
    rounded = float(f"{round(seconds):.1e}") if isfinite(seconds) else inf
    return row.offline_s.data is None, rounded


def _answers_all(row: Row) -> bool:
    return row.ok and row.n_failed == 0 and not (row.hidden and row.hidden.rel_l2_max == inf)


def _meets(row: Row, asked: Mapping[str, float]) -> bool:
    return all(figure(row, name) <= limit for name, limit in asked.items())


def _rank(row: Row) -> tuple[Any, ...]:
    return (*offline_rank(row), figure(row, "latency_ms"), figure(row, "memory_bytes"), row.label)


def _excesses(row: Row, requirements: Requirements) -> dict[str, float]:
    return {name: figure(row, name) / limit for name, limit in requirements.asked.items()}


def _nearest(rows: Sequence[Row], requirements: Requirements) -> Row | None:
    """Return the row that exceeds the limits by the smallest factor."""

    def excess(row: Row) -> float:
        return max(_excesses(row, requirements).values(), default=0.0)

    known = [row for row in rows if excess(row) < inf]
    return min(known, key=lambda row: (excess(row), _rank(row)), default=None)


def _relaxation(name: str, asked: Mapping[str, float], rows: Sequence[Row]) -> Relaxation | None:
    """Return the strictest limit on one figure that lets a row qualify; None if there is none."""
    others = {other: limit for other, limit in asked.items() if other != name}
    able = [row for row in rows if _meets(row, others) and figure(row, name) < inf]
    row = min(able, key=lambda row: (figure(row, name), _rank(row)), default=None)
    return None if row is None else Relaxation(name, asked[name], figure(row, name), row)
