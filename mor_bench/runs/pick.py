"""The cheapest configuration that meets what a scene needs, with the evidence, or what would have to give.

A requirement is met only by what a repeated measurement would confirm: of an interval its upper end counts, of the test set and a
fresh one the worse, and a configuration that left a test load without an answer meets nothing, nor does a figure that is not known.

Of those that meet all, the one with the least offline cost is chosen: data generation and fit are paid again for every new body,
material or support, while memory and latency within their limits cost nothing more. Offline seconds are compared to two digits
and to whole seconds, since training on the same data differs by less than a repetition does; then the lower latency counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import ceil, floor, inf, isfinite, log10
from pathlib import Path
from typing import Any

from mor_bench.analysis.analyse import analyse
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.results.comparison import Comparison
from mor_bench.results.json_file import without_nan
from mor_bench.runs.compare import run
from mor_bench.runs.dataset_run import Listener
from mor_bench.specs import AnyDatasetSpec, load_dataset_spec

Row = Mapping[str, Any]

RANKED_BY = "offline cost (data + fit, to the second and two digits), then latency, then memory"
RUNS = Path("reports") / "runs"


@dataclass(frozen=True)
class Requirements:
    """Upper limits; None asks for nothing.

    Attributes
    ----------
    error
        Relative l2, median over the test set.
    latency_ms
        Of one query, median.
    memory_bytes
        Resident at most in a process that predicts.
    offline_s
        Core-seconds of data generation and seconds of fitting together.
    """

    error: float | None = None
    latency_ms: float | None = None
    memory_bytes: float | None = None
    offline_s: float | None = None

    def __post_init__(self) -> None:
        for name, limit in self.asked.items():
            if (
                isinstance(limit, bool)
                or not isinstance(limit, int | float)
                or not (limit > 0 and isfinite(limit))
            ):
                raise InvalidInputError(f"`{name}` must be a positive number; got {limit!r}.")

    @property
    def asked(self) -> dict[str, float]:
        """The limits that there are, by name."""
        return {name: limit for name, limit in asdict(self).items() if limit is not None}


@dataclass(frozen=True)
class Relaxation:
    """One limit that would have to give, the others kept.

    Attributes
    ----------
    name : str
        Of the requirement.
    asked, needed : float
        The limit, and the least one that lets a configuration qualify.
    row : dict
        That configuration.
    """

    name: str
    asked: float
    needed: float
    row: Row


@dataclass(frozen=True)
class Pick:
    """What was chosen, and from what.

    Attributes
    ----------
    dataset : str
    requirements : Requirements
    choice, runner_up : dict or None
        Rows of results.json: the cheapest configuration that meets all requirements, and the cheapest of another method.
    relaxations : list of Relaxation
        Without a choice, for each requirement that could give alone; empty if only several together help.
    nearest : dict or None
        Without a choice, the configuration whose largest excess over a limit, as a factor, is the least.
    unknown : list of str
        Without a choice, requirements on a figure that no configuration has.
    n_configurations, n_meeting : int
    n_without_answers : int
        Configurations that failed, were skipped, or left a test load without an answer.
    run : Path or None
        Folder of the comparison that is the evidence.
    processor : str
        On which it was timed.
    kind : str
        Profile, split and number of samples of the run.
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
        """Everything, for `json.dumps`; infinite errors are strings."""
        content: dict[str, Any] = without_nan(asdict(self))
        run = None if self.run is None else str(self.run)
        return {
            **content,
            "requirements": self.requirements.asked,
            "ranked_by": RANKED_BY,
            "run": run,
        }

    def text(self) -> str:
        """A few lines for people."""
        lines = [
            f"{self.dataset} needs {', '.join(_said(name, limit) for name, limit in self.requirements.asked.items())}."
        ]
        if self.choice is not None:
            lines += [f"Cheapest by {RANKED_BY}:", *_evidence(self.choice)]
            lines += (
                ["Next method:", *_evidence(self.runner_up)]
                if self.runner_up is not None
                else ["No other method meets all."]
            )
            lines.append(
                f"{self.n_meeting} of {self.n_configurations} configurations meet all{self._left_out()}."
            )
        else:
            lines.append(
                f"None of {self.n_configurations} configurations meets all{self._left_out()}."
            )
            lines += self._what_would_have_to_give()
        if self.run is not None:
            lines.append(
                f"Evidence: {self.run}{f', {self.kind}' if self.kind else ''}{f', timed on {self.processor}' if self.processor else ''}"
            )
        return "\n".join(lines)

    def _left_out(self) -> str:
        return (
            f"; {self.n_without_answers} of them failed, were skipped or left loads without an answer"
            if self.n_without_answers
            else ""
        )

    def _what_would_have_to_give(self) -> list[str]:
        lines = []
        for name in self.requirements.asked:
            relaxed = next((r for r in self.relaxations if r.name == name), None)
            if name in self.unknown:
                lines.append(f"Not known of any configuration: {_NAMES[name]}")
            elif relaxed is not None:
                lines.append(
                    f"Enough alone: {_said(name, relaxed.needed, up=True)}, by {relaxed.row['label']}"
                )
            else:
                lines.append(f"Not enough alone: {_NAMES[name]}, whatever the limit")
        if self.nearest is not None:
            excess = _excesses(self.nearest, self.requirements)
            misses = ", ".join(
                f"{_NAMES[name]} {factor:.3g} times the limit"
                for name, factor in excess.items()
                if factor > 1
            )
            lines += [f"Nearest, with {misses}:", *_evidence(self.nearest)]
        return lines


def figure(row: Row, name: str) -> float:
    """What a row can claim for a requirement; infinite where it is not known."""
    value = inf
    if name == "error" and row.get("error"):
        error, fresh = row["error"], row.get("hidden") or {}
        value = max(
            error.get("rel_l2_median_high") or error["rel_l2_median"],
            fresh.get("rel_l2_median", 0.0),
        )
    elif name == "latency_ms" and row.get("latency_ms"):
        latency = row["latency_ms"]
        value = (
            latency["median"]
            if latency.get("high") is None
            else max(latency["high"], latency["median"])
        )
    elif name == "memory_bytes":
        value = _known((row.get("memory_bytes") or {}).get("predict"))
    elif name == "offline_s":
        offline = row.get("offline_s") or {}
        value = _known(offline.get("data")) + _known(offline.get("fit"))
    return value if value >= 0 else inf  # NaN is not known


def _known(value: float | None) -> float:
    return inf if value is None else value


def _answers(row: Row) -> bool:
    """Whether a configuration answered every load of the test set and of the fresh one."""
    fresh = row.get("hidden") or {}
    return row["status"] == "ok" and row.get("n_failed") == 0 and fresh.get("rel_l2_max", 0.0) < inf


def _meets(row: Row, asked: Mapping[str, float]) -> bool:
    return _answers(row) and all(figure(row, name) <= limit for name, limit in asked.items())


def offline_rank(row: Row) -> tuple[bool, float]:
    """Offline seconds as they are compared: two digits, and whole seconds. A row whose data have no known cost comes last, by its fit."""
    offline = row.get("offline_s") or {}
    data, fit = offline.get("data"), _known(offline.get("fit"))
    seconds = fit + (data or 0.0)
    return data is None, float(f"{round(seconds):.1e}") if isfinite(seconds) else inf


def _rank(row: Row) -> tuple[Any, ...]:
    return (
        *offline_rank(row),
        figure(row, "latency_ms"),
        figure(row, "memory_bytes"),
        row["label"],
    )


def _excesses(row: Row, requirements: Requirements) -> dict[str, float]:
    return {name: figure(row, name) / limit for name, limit in requirements.asked.items()}


def choose(rows: Sequence[Row], requirements: Requirements, dataset: str) -> Pick:
    """Choose among results rows of one dataset.

    Parameters
    ----------
    rows : sequence of dict
        As in `Comparison.rows`; keys that an older run lacks count as not known.
    requirements : Requirements
    dataset : str
        Its name; other rows are left out.
    """
    asked = requirements.asked
    mine = [row for row in rows if row["dataset"] == dataset]
    answering = [row for row in mine if _answers(row)]
    meeting = sorted((row for row in answering if _meets(row, asked)), key=_rank)
    relaxations = (
        [] if meeting else [r for name in asked if (r := _relaxation(name, asked, answering))]
    )
    excess = {id(row): max(_excesses(row, requirements).values(), default=0.0) for row in answering}
    measured = [] if meeting else [row for row in answering if excess[id(row)] < inf]
    nearest = min(measured, key=lambda row: (excess[id(row)], _rank(row)), default=None)
    unknown = (
        []
        if meeting
        else [name for name in asked if all(figure(row, name) == inf for row in answering)]
    )
    first = meeting[0] if meeting else None
    second = next((row for row in meeting if row["method"] != meeting[0]["method"]), None)
    return Pick(
        dataset,
        requirements,
        first,
        second,
        relaxations,
        nearest,
        unknown,
        len(mine),
        len(meeting),
        len(mine) - len(answering),
    )


def _relaxation(name: str, asked: Mapping[str, float], rows: Sequence[Row]) -> Relaxation | None:
    """The least limit on one figure that lets one of the rows qualify; None if no limit does."""
    others = {other: limit for other, limit in asked.items() if other != name}
    able = [row for row in rows if _meets(row, others) and figure(row, name) < inf]
    row = min(able, key=lambda row: (figure(row, name), _rank(row)), default=None)
    return None if row is None else Relaxation(name, asked[name], figure(row, name), row)


def pick(
    dataset: str | Path | Mapping[str, Any],
    *,
    error: float | None = None,
    latency_ms: float | None = None,
    memory_bytes: float | None = None,
    offline_s: float | None = None,
    comparison: Comparison | str | Path | None = None,
    cache: Path | None = None,
    suite: Path | None = None,
    listener: Listener = Listener(),
) -> Pick:
    """The cheapest configuration that meets what a scene needs.

    Parameters
    ----------
    dataset : str, Path or dict
        A name in ``datasets/``, the path of a TOML, or its content.
    error, latency_ms : float, optional
        Relative l2, median over the test set; ms of one query, median. By default those of the dataset's ``[needs]``.
    memory_bytes, offline_s : float, optional
        Of the process that predicts; core-seconds of data generation and seconds of fitting. By default not limited.
    comparison : Comparison or path, optional
        The evidence, or the folder of a run. By default the newest finished run of the dataset under ``reports/runs``; if there
        is none, `mor_bench.run` compares the default methods first.
    cache, suite : Path, optional
        Cache folder; folder with ``datasets/`` and ``methods/``.
    listener : Listener
        Told of progress, if a comparison must be run.

    Raises
    ------
    InvalidInputError
        If a limit is not positive, or the comparison holds no rows of this dataset, or of another one with its name.
    SpecError, StoreError
        If the dataset is not valid, or the run's folder cannot be read.
    """
    spec = load_dataset_spec(dataset, suite)
    requirements = Requirements(
        spec.needs.error if error is None else error,
        spec.needs.latency_ms if latency_ms is None else latency_ms,
        memory_bytes,
        offline_s,
    )
    if comparison is None:
        evidence = newest_run(spec) or run([dataset], cache=cache, suite=suite, listener=listener)
    elif not isinstance(comparison, Comparison | str | Path):
        raise InvalidInputError(
            f"`comparison` must be a Comparison or the folder of a run; got {type(comparison).__name__}."
        )
    else:
        evidence = comparison if isinstance(comparison, Comparison) else Comparison.read(comparison)
        _check_evidence(evidence, spec)
    chosen = choose(_with_intervals(evidence), requirements, spec.name)
    return replace(
        chosen,
        run=evidence.out,
        processor=str(evidence.machine.get("processor", "")),
        kind=_kind(evidence),
    )


def _kind(comparison: Comparison) -> str:
    settings = comparison.settings
    parts = [
        f"profile {settings.get('profile')}",
        f"split by {settings['split']}" if settings.get("split") else "",
    ]
    return ", ".join(
        filter(
            None, [*parts, f"first {settings['limit']:,} samples" if settings.get("limit") else ""]
        )
    )


def _with_intervals(comparison: Comparison) -> list[Row]:
    """Rows with the upper end of their median error's interval."""
    high = {
        (record["dataset"], record["label"]): record["rel_l2_median"]["high"]
        for record in analyse(comparison)["rows"]
    }

    def extended(row: Any) -> Row:
        bound = high.get((row["dataset"], row["label"]))
        return (
            row
            if bound is None or not row["error"]
            else {**row, "error": {**row["error"], "rel_l2_median_high": bound}}
        )

    return [extended(row) for row in (row.as_dict() for row in comparison.rows)]


def _is_of(comparison: Comparison, spec: AnyDatasetSpec) -> bool:
    """Whether a comparison holds this dataset, whatever it is called and needs."""
    shown = {"title", "source", "needs"}

    def decisive(content: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in content.items() if name not in shown}

    held = comparison.datasets.get(spec.name)
    return held is not None and decisive(held) == decisive(spec.model_dump(mode="json"))


def _check_evidence(comparison: Comparison, spec: AnyDatasetSpec) -> None:
    if spec.name not in comparison.datasets:
        raise InvalidInputError(
            f"{comparison.out} holds no {spec.name}; it holds {', '.join(comparison.datasets) or 'nothing'}."
        )
    if not _is_of(comparison, spec):
        raise InvalidInputError(
            f"{comparison.out} holds another {spec.name}: the dataset's file has changed since."
        )


def newest_run(spec: AnyDatasetSpec, runs: Path = RUNS) -> Comparison | None:
    """The newest finished run of a dataset in a folder of runs, one of all samples before others, and a full one before quick ones.

    comparison.json is written when a run ends.
    """
    found: list[tuple[tuple[bool, bool, float], Comparison]] = []
    for file in runs.glob("*/comparison.json"):
        try:
            comparison = Comparison.read(file.parent)
        except StoreError:  # of another version, or damaged
            continue
        if _is_of(comparison, spec) and any(
            row["dataset"] == spec.name and row["status"] == "ok" for row in comparison.rows
        ):
            settings = comparison.settings
            found.append(
                (
                    (
                        settings.get("limit") is None,
                        settings.get("profile") == "full",
                        file.stat().st_mtime,
                    ),
                    comparison,
                )
            )
    return max(found, key=lambda item: item[0])[1] if found else None


_NAMES = {
    "error": "error",
    "latency_ms": "latency",
    "memory_bytes": "memory",
    "offline_s": "offline time",
}


def _up(value: float, digits: int = 3) -> str:
    """A number to three digits, rounded up, so that it can be asked for."""
    if not 0 < value < inf:
        return f"{value:g}"
    step = 10.0 ** (floor(log10(value)) - digits + 1)
    text = f"{ceil(value / step - 1e-9) * step:.{digits}g}"
    return text if float(text) >= value else f"{value:.17g}"


def _said(name: str, limit: float, up: bool = False) -> str:
    scale, unit = {
        "error": (100.0, " % (relative l2, median)"),
        "latency_ms": (1.0, " ms (median)"),
        "memory_bytes": (1e-6, " MB"),
        "offline_s": (1.0, " s"),
    }[name]
    return f"{_NAMES[name]} <= {_up(scale * limit) if up else f'{scale * limit:g}'}{unit}"


def _errors(record: Row | None) -> str:
    if not record:
        return "unknown"
    median, p95, largest = (100 * record[f"rel_l2_{name}"] for name in ("median", "p95", "max"))
    return f"{median:.3g} % median, {p95:.3g} % p95, {largest:.3g} % max"


def _evidence(row: Row) -> list[str]:
    """The figures of a configuration, indented."""
    lines = [
        f"  {row['label']}",
        f"    error    {_errors(row['error'])} on {row['n_test']} test loads",
    ]
    if row.get("hidden"):
        lines.append(
            f"    fresh    {_errors(row['hidden'])} on {row['hidden']['n']} loads drawn anew"
        )
    lines.append(f"    latency  {_latency(row)}")
    memory, model = (row.get("memory_bytes") or {}).get("predict"), row.get("model_bytes")
    lines.append(f"    memory   {_size(memory)} to predict, model {_size(model)}")
    offline = row.get("offline_s") or {}
    samples = f" of {row['n_train']} samples" if offline.get("data") else ""
    lines.append(
        f"    offline  data {_seconds(offline.get('data'))}{samples}, fit {_seconds(offline.get('fit'))}"
    )
    for name, record in (row.get("sets") or {}).items():
        missing = f", {record['n_failed']} without an answer" if record.get("n_failed") else ""
        lines.append(f"    {name:<8} {_errors(record)} on {record['n']} loads{missing}")
    mesh = row.get("discretisation_rel_l2")
    if mesh is not None:
        lines.append(
            f"    mesh     {100 * mesh:.3g} % median: what the mesh itself errs, which no method makes good"
        )
    return lines


def _latency(row: Row) -> str:
    latency = row.get("latency_ms")
    if not latency:
        return "unknown"
    interval = (
        f" [{latency['low']:.3g}, {latency['high']:.3g}]" if latency.get("high") is not None else ""
    )
    reasons = "; ".join(latency.get("unstable_because") or ["no reason given"])
    unstable = f"; unstable: {reasons}" if latency.get("stable") is False else ""
    return f"{latency['median']:.3g} ms median{interval}, {latency['p95']:.3g} p95, {row['threads']} thread{'s' * (row['threads'] != 1)}{unstable}"


def _seconds(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g} s"


def _size(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value / 1e6:.3g} MB" if value >= 1e6 else f"{value / 1e3:.3g} kB"
