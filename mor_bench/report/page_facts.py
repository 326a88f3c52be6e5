"""What the files of a dataset and of a method say, and how a configuration qualifies, in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from mor_bench.analysis.selection import asked_of, bounds_of
from mor_bench.analysis.selection_text import FIGURE_NAMES, limits_missed, run_command
from mor_bench.analysis.verdict import Requirements, needs_of
from mor_bench.measure.discretisation_error import measured
from mor_bench.report.cards import pair_text
from mor_bench.report.entries import Analysis, Entry, verdict_of
from mor_bench.report.method_styles import style_of
from mor_bench.report.not_measured import beyond_training
from mor_bench.report.number_format import bytes_text, number, percent
from mor_bench.report.page_samples import Sampled, dataset_arrays
from mor_bench.report.scene_text import recorded_scene
from mor_bench.report.short_names import renamed, short_names
from mor_bench.report.summary import discretisation_error, needs_in_words
from mor_bench.results.comparison import Comparison


def answer_of(entry: Entry, needs: Requirements) -> str:
    """Say whether a configuration qualifies, or why not: "no: median error, 95 % bound 2 %"."""
    if entry.qualified or not entry.ran:
        return "yes" if entry.qualified else entry.row.status
    missed = [
        f"{name}{', 95 % bound' if name in _UNCERTAIN else ':'} {bound}"
        for name, bound, _ in _missed(entry, needs)
    ]
    missed += ["loads without an answer"] if entry.n_failed else []
    return f"no: {', '.join(missed)}" if missed else "no"


def reason_of(entry: Entry, needs: Requirements) -> str:
    """As `answer_of`, with the upper bounds and the limits."""
    missed = [
        f"{name}: {'95 % upper bound ' if name in _UNCERTAIN else ''}{bound}, limit {limit}"
        for name, bound, limit in _missed(entry, needs)
    ]
    return f"no: {'; '.join(missed)}" if entry.ran and missed else answer_of(entry, needs)


def _missed(entry: Entry, needs: Requirements) -> list[tuple[str, str, str]]:
    """List the limits that a configuration misses; its error is that on the validation part."""
    if entry.qualified:
        return []
    shown = {FIGURE_NAMES["error"]: _MEDIANS[bool(entry.row.validation)]}
    missed = limits_missed(bounds_of(entry.row, entry.intervals), needs)
    return [(shown.get(name, name), bound, limit) for name, bound, limit in missed]


_MEDIANS = ("median error", "median validation error")
"""Names of the error that selects: on the test set, and on the validation part."""

_UNCERTAIN = (*_MEDIANS, FIGURE_NAMES["latency_ms"])
"""Figures whose 95 % upper bound must meet the limit."""


def deformation(entries: Sequence[Entry], found: Sequence[Sampled]) -> str:
    """State how far the test loads move the body, and how nonlinear that is; empty if unknown."""
    known = (entry.figure("error", "amplitude_m") for entry in entries)
    largest = next((value for value in known if value), None)
    if not largest:
        return ""
    moved = next((i.arrays["amplitude_m"] for i in found if "amplitude_m" in i.arrays), None)
    middle = "" if moved is None else f"{number(float(np.nanmedian(moved)))} m (median), "
    said = (
        f"Largest displacement of a node in the test loads: {middle}{number(largest)} m (largest)."
    )
    linear = next((e for e in entries if e.method == "linear-fem" and e.ran), None)
    if linear is not None:
        shares = {"median": linear.error}
        for name, figure in (("95th percentile", "rel_l2_p95"), ("largest", "rel_l2_max")):
            if (value := linear.figure("error", figure)) is not None:
                shares[name] = value
        errors = ", ".join(f"{percent(value)} % ({name})" for name, value in shares.items())
        said += f" Errors of the linear model, which tell how nonlinear the answers are: {errors}."
    return said


_UNSEEN = {
    "region": "No test load is centred where a training load is centred; neighbouring patches "
    "overlap.",
    "direction": "The test loads have directions that no training load has.",
    "sample": "The test loads are drawn as the training loads are.",
}
"""What is new in the test loads of each split."""


def _listed(names: Sequence[str]) -> str:
    return " and ".join([*([", ".join(names[:-1])] if names[:-1] else []), names[-1]])


def _compared(comparison: Comparison, entries: Sequence[Entry]) -> str:
    """Name the quantities that are compared, and their references."""
    names = {entry.row.dataset for entry in entries}
    imported = any(comparison.datasets.get(name, {}).get("snapshots") for name in names)
    reference = "the data" if imported else "full-order solutions on this mesh"
    figures = {"reactions": "reaction_rel_median", "stresses": "stress_rel_median"}
    given = {
        name: any(entry.figure("error", figure) for entry in entries)
        for name, figure in figures.items()
    }
    what = _listed(["displacements", *(name for name in figures if given[name])])
    others = _listed([*(name for name in figures if not given[name]), "motion in time"])
    return f"Errors are those of static {what} against {reference}; {others} are not compared."


def _answered(entries: Sequence[Entry]) -> str:
    """Count the configurations that ran and answered every load."""
    good = sum(entry.ran and not entry.n_failed for entry in entries)
    return f"{good} of {len(entries)} configurations ran and answered every test load."


def untested_of(analysis: Analysis, entries: Sequence[Entry]) -> dict[str, str]:
    """Say, by method, why the comparison does not test it where it is built for."""
    present = {entry.method for entry in entries}
    return {
        record["method"]: record["verdict"].partition("(")[2].partition("). It is for: ")[0]
        for record in analysis["regimes"]
        if record["in_regime"] is False and record["method"] in present
    }


def limits_of(comparison: Comparison, analysis: Analysis, entries: Sequence[Entry]) -> str:
    """State for what a run holds, and what it does not tell: regimes, other loads, other seeds."""
    dataset = next((entry.row.dataset for entry in entries), "")
    said = [_compared(comparison, entries), _answered(entries)]
    said.append(
        "Data, fits and errors hold for this body, material, supports and kind of load only; "
        "another scene needs its own."
    )
    split = next((entry.row.split for entry in entries if entry.ran), None)
    if split in _UNSEEN:
        said.append(_UNSEEN[split])
    if counts := _patches(comparison.datasets.get(dataset, {}), entries):
        said.append(f"The split: {_samples(entries)}{counts}.")
    choice = verdict_of(analysis, dataset).get("choice")
    beyond = beyond_training(comparison, dataset, entries, choice)
    said.append(renamed(beyond, short_names(entry.row for entry in entries)))
    if processor := comparison.machine.get("processor"):
        said.append(f"Latencies hold for {processor}; `--retime` measures them on another machine.")
    if comparison.settings.get("seeds") == 1:
        said.append(
            "One training each: the intervals do not hold its random seed, `--seeds 3` measures it."
        )
    return " ".join(said)


_FIRST = {
    "commit": "commit of mor-bench",
    "date": "date",
    "processor": "processor",
    "processor_model": "processor model",
}
"""Facts of a run that come first, and their names."""


def machine_facts(machine: Mapping[str, Any]) -> list[tuple[str, str]]:
    """List the commit and date of a run and its machine; older runs lack some of them."""
    facts = [(name, str(machine.get(key) or "not recorded")) for key, name in _FIRST.items()]
    for key, text in flat({key: value for key, value in machine.items() if key not in _FIRST}):
        name = key.removesuffix("_bytes")
        size = name != key and text.isdecimal()
        facts.append((name, bytes_text(float(text)) if size else text))
    return facts


def method_facts(comparison: Comparison, method: str) -> list[tuple[str, str]]:
    """List what a method's file says of it."""
    spec = comparison.methods.get(method, {})
    regime = spec.get("regime") or {}
    facts = {
        "title": spec.get("title"),
        "family": style_of(method).family,
        "origin": spec.get("source"),
        "built for": regime.get("says") if isinstance(regime, dict) else None,
        "limits": spec.get("limits"),
    }
    return [(name, str(text).strip()) for name, text in facts.items() if text]


AGAIN = "command that runs it all again"
"""Name of the fact that repeats a run."""


def facts_of(
    comparison: Comparison, dataset: str, entries: Sequence[Entry]
) -> list[tuple[str, str]]:
    """List facts about the run: the dataset's description, its split, its needs, counts of rows."""
    spec, rows = comparison.datasets.get(dataset, {}), [entry.row for entry in entries]
    unused = _values(row.n_unused for row in rows)
    split = f"by {_values(row.split for row in rows)}; "
    split += f"training samples: {_values(row.n_train for row in rows)}; "
    split += f"validation samples: {_values(row.n_validation for row in rows)}; "
    split += f"test samples: {_values(row.n_test for row in rows)}"
    split += f"; in no part: {unused}" if any(row.n_unused for row in rows) else ""
    split += _patches(spec, entries)
    refused = dataset_arrays(comparison, dataset).get("n_refused")
    counts = (
        f"{sum(r.status == status for r in rows)} {status}" for status in ("failed", "skipped")
    )
    facts = [("source", str(spec["source"]))] if spec.get("source") else []
    for key, heading in _SCENE.items():
        if spec.get(key):
            pairs = [(k, _WORDS.get((key, k, v), v)) for k, v in flat(spec[key]) if v != "None"]
            facts.append((heading, "; ".join(pair_text(k, v) if k else v for k, v in pairs)))
    asked = asked_of(comparison, dataset)
    drawn = (row.hidden.seed for row in rows if row.hidden)
    if (seed := next(drawn, None)) is not None:
        asked = {**asked, "test_seed": seed}
    command = run_command(asked) if comparison.settings else ""
    return [
        *([(AGAIN, command)] if command else []),
        *facts,
        ("split", split),
        (
            "samples refused by the full-order model (no stable equilibrium found)",
            "not recorded" if refused is None else f"{int(refused):,}, in no part of the split",
        ),
        *([] if spec.get("snapshots") else [("reference solutions", _REFERENCE)]),
        ("needs", needs_in_words(needs_of(comparison, dataset))),
        ("degrees of freedom", _values(f"{row.n_dofs:,}" for row in rows if row.n_dofs)),
        ("discretisation error of the dataset's mesh", discretisation_error(entries)),
        *_refinement(spec),
        ("threads", _values(row.threads for row in rows)),
        ("configurations", f"{len(rows)}: {sum(r.ok for r in rows)} ran, {', '.join(counts)}"),
    ]


def _samples(entries: Sequence[Entry]) -> str:
    """Count the loads of each part of a split."""
    row = next(entry.row for entry in entries if entry.ran)
    parts = {"training": row.n_train, "validation": row.n_validation or 0, "test": row.n_test}
    return ", ".join(f"{n:,} {part}" for part, n in parts.items()) + " loads"


def protocol_of(comparison: Comparison, dataset: str, entries: Sequence[Entry]) -> str:
    """State in a few sentences how all configurations were timed and tuned."""
    rows = [entry.row for entry in entries if entry.ran and entry.row.latency_ms]
    if not rows:
        return ""
    processes = _values(r.latency_ms.n_processes for r in rows if r.latency_ms)
    rounds = set()
    for row in rows[:1]:
        with suppress(OSError, KeyError):
            rounds = set(np.asarray(comparison.samples(row)["round"]).tolist())
    turns = f" in {len(rounds)} interleaved rounds" if len(rounds) > 1 else ""
    threads = _values(row.threads for row in rows)
    budget = comparison.settings.get("budget") or {}
    allowed = [f"{budget['configurations']} configurations"] if budget.get("configurations") else []
    allowed += [f"{budget['seconds']:g} s of fitting"] if budget.get("seconds") else []
    cores = comparison.machine.get("cores")
    of = f" on {cores} cores" if cores else ""
    text = f"One query at a time, {threads} thread{'s' * (threads != '1')}{of}, after warm-up, in "
    text += f"{processes} fresh process{'es' * (processes != '1')}{turns}."
    return f"{text} Budget of each method: {' and '.join(allowed)}." if allowed else text


def _patches(spec: Mapping[str, Any], entries: Sequence[Entry]) -> str:
    """Count the load patches of each part of a split by region; empty for other splits."""
    row = next((entry.row for entry in entries if entry.ran), None)
    loads = spec.get("loads")
    each = loads.get("samples_per_patch") if isinstance(loads, dict) else None
    if row is None or row.split != "region" or not isinstance(each, int) or each < 1:
        return ""
    parts = {"training": row.n_train, "validation": row.n_validation, "test": row.n_test}
    counts = [f"{n // each} {part}" for part, n in parts.items() if n]
    return f"; load patches: {', '.join(counts)}, none in two parts"


def n_refined(spec: Mapping[str, Any]) -> int:
    """Count the loads that the discretisation error was measured with; 0 if it was not."""
    found = recorded_scene(spec)
    record = measured(found) if found else None
    return 0 if record is None else len(record["loads"])


def _refinement(spec: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Say on which meshes the discretisation error was measured; nothing if that is unknown."""
    found = recorded_scene(spec)
    record = measured(found) if found else None
    if record is None:
        return []
    loads = record["loads"]
    orders = [load["order"] for load in loads if load.get("order") is not None]
    n = sum(load.get("limit") == "extrapolated" for load in loads)
    meshes = ", ".join(f"{mesh['n_dofs']:,}" for mesh in record["meshes"])
    errors = [load["relative_l2"] for load in loads if load.get("relative_l2") is not None]
    text = f"{len(loads)} loads on meshes with {meshes} degrees of freedom"
    text += f"; errors from {percent(min(errors))} % to {percent(max(errors))} %" if errors else ""
    text += f"; median order {number(float(np.median(orders)))}" if orders else ""
    text += f"; limit by Richardson extrapolation for {n} loads, else the finest mesh"
    return [("how it was measured", text)]


_REFERENCE = "full-order model on this mesh, residual at most 1e-8 of the load"

_SCENE = {
    "geometry": "geometry",
    "discretisation": "discretisation",
    "material": "material",
    "supports": "supports (clamped: no displacement)",
    "loads": "loads",
    "snapshots": "snapshots",
}
"""Parts of a dataset's description, and their headings."""

_WORDS = {
    ("discretisation", "element", "hexahedron"): "hexahedron with 8 nodes (H8)",
    (
        "discretisation",
        "element",
        "tetrahedron",
    ): "tetrahedron with 4 nodes (T4), or with 10 (T10) if order is 2",
    ("loads", "kind", "force"): "force, its direction uniform on the sphere",
    ("loads", "kind", "normal"): "force along the normal, pressing or pulling",
    ("loads", "kind", "tangential"): "force along the surface, its direction uniform",
}
"""What some values mean, by part, key and value."""


def _values(found: Iterable[object]) -> str:
    """Join the different values, in order; a dash if there are none."""
    return ", ".join(dict.fromkeys(map(str, found))) or "–"


def flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Flatten nested tables to pairs such as ``("versions numpy", "2.4.6")``."""
    ends = value if prefix.startswith("magnitude_") and isinstance(value, list | tuple) else ()
    if len(ends) == 2 and all(isinstance(end, int | float) for end in ends):
        value = f"uniform from {value[0]:g} to {value[1]:g}"
    if isinstance(value, dict):
        for key, item in value.items():
            yield from flat(item, f"{prefix} {key}".strip())
    elif isinstance(value, list | tuple) and any(isinstance(item, dict) for item in value):
        for item in value:
            yield from flat(item, prefix)
    else:
        yield prefix, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
