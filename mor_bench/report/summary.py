"""Sentences for console and page: warnings, notes, and the basis of the intervals."""

from __future__ import annotations

from collections.abc import Sequence

from mor_bench.analysis.selection_text import needs_text
from mor_bench.analysis.verdict import Requirements
from mor_bench.report.entries import Analysis, Entry, entries_of
from mor_bench.report.number_format import metres, number, percent
from mor_bench.report.published_figures import SCENES, scene_of
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import TrainedElsewhere
from mor_bench.results.row import Row

MESH_NOTE = "an error below it is not evidence about the real body"


def warnings_of(entries: Sequence[Entry]) -> list[tuple[str, str]]:
    """List each warning once, after the configuration's label or the number of configurations."""
    labels: dict[str, list[str]] = {}
    for entry in entries:
        for warning in entry.row.warnings:
            labels.setdefault(warning, []).append(entry.label)
    return [(_first_of(given), warning) for warning, given in labels.items()]


def notes_of(comparison: Comparison, dataset: str, analysis: Analysis) -> list[tuple[str, str]]:
    """List doubts, each after the name of its configuration or method.

    Doubts are unstable timings, networks trained elsewhere, a fresh test set that disagrees, and
    untested regimes.
    """
    entries = entries_of(comparison, dataset)
    unstable: dict[str, list[str]] = {}
    for entry in entries:
        for reason in entry.unstable:
            unstable.setdefault(reason, []).append(entry.label)
    notes = [
        (_first_of(labels), f"timing not stable: {reason}") for reason, labels in unstable.items()
    ]
    notes += origins(comparison, dataset)
    notes += hidden_doubts(dataset, analysis)
    methods = {entry.method for entry in entries}
    notes += [
        (record["method"], record["verdict"])
        for record in analysis["regimes"]
        if record["method"] in methods and record["in_regime"] is False
    ]
    return notes


def hidden_doubts(dataset: str, analysis: Analysis) -> list[tuple[str, str]]:
    """List the configurations that are clearly worse on the fresh test set, and by how much."""
    doubts = []
    for record in analysis["hidden"]:
        if record["dataset"] == dataset and record["worse"]:
            ratio = "infinitely" if record["ratio"] is None else f"{number(record['ratio'])} times"
            doubt = f"the median error is {ratio} as large on the fresh test set as on the shipped"
            doubts.append((record["label"], f"{doubt} one"))
    return doubts


def origins(comparison: Comparison, dataset: str) -> list[tuple[str, str]]:
    """Describe each training that was done elsewhere, after the label of its configuration."""
    return [
        (row.label, _origin(row, row.trained_elsewhere, comparison))
        for row in comparison.rows
        if row.dataset == dataset and row.trained_elsewhere
    ]


def _origin(row: Row, training: TrainedElsewhere, comparison: Comparison) -> str:
    """State the size and iterations beside those of the paper, the method's file and `--train`."""
    spec = comparison.methods.get(row.method, {})
    published = spec.get("parameters", {}).get("iterations", 0)
    profile = spec.get("profiles", {}).get(comparison.settings.get("profile")) or {}
    here = profile.get("parameters", {}).get("iterations", published)
    fewer = f", not the {published:,} of its method file" if published > training.iterations else ""
    return (
        f"{paper_size(row)}"
        f"trained elsewhere for {training.iterations:,} iterations{fewer}; seed {training.seed}, "
        f"{number(training.core_s)} core-seconds on {training.machine} cores, {training.date}, "
        f"commit {training.commit[:7]}; `--train` trains here"
        + (f" for {here:,} iterations, those of this profile" if here else "")
    )


def paper_size(row: Row) -> str:
    """State the size of a network of the paper's kind beside the one that the paper selected."""
    channels, steps = (row.parameters.get(name) for name in ("channels", "steps"))
    scene = SCENES.get(scene_of(row.dataset))
    if not isinstance(channels, int) or not isinstance(steps, int) or scene is None:
        return ""
    paper = scene.network
    size = f"channels={paper.channels},steps={paper.steps}"
    command = f"mor-bench run {row.dataset} --profile full -m '{row.method}[{size}]'"
    trained = f", trained by `{command}`" if row.told == "input" else ""
    return (
        f"{channels} channels and {steps} steps (the paper's network: {paper.channels} channels "
        f"and {paper.steps} steps{trained}); "
    )


def _first_of(labels: Sequence[str]) -> str:
    return labels[0] if len(labels) == 1 else f"{labels[0]} and {len(labels) - 1} more"


def interval_basis(dataset: str, analysis: Analysis) -> str:
    """Describe in a sentence the basis of a dataset's intervals; empty if there are none."""
    n = analysis["settings"]["n_resamples"]
    parts = [
        f"95 % intervals: errors over {c['n']} {c['of']} (bootstrap of {n:,} resamples)"
        for c in analysis["clusters"]
        if c["dataset"] == dataset
    ]
    for found in analysis["timing"]:
        if found["dataset"] != dataset:
            continue
        n_processes, specific, common = (
            found[key] for key in ("n_processes", "specific", "common")
        )
        spread = (
            "and a typical spread between processes"
            if specific is None
            else f"that differ by {percent(specific)} %"
        )
        drift = f"; the machine's speed drifts by {percent(common)} %" if common else ""
        parts.append(
            f"latencies from one process {spread}"
            if n_processes == 1
            else f"latencies over {n_processes} processes {spread}{drift}"
        )
    return f"{', '.join(parts)}." if parts else ""


def discretisation_error(entries: Sequence[Entry]) -> str:
    """State the discretisation error of the dataset's own mesh."""
    measured = (e.row for e in entries if e.row.discretisation_error_m is not None)
    row = next(measured, None)
    if row is None:
        return "not known"
    least = "at least " if row.discretisation_at_least else ""
    relative = row.discretisation_rel_l2
    beside = "" if relative is None else f", relative L2 error {percent(relative)} % (median)"
    return f"{least}{metres(row.discretisation_error_m)} m{beside}; {MESH_NOTE}"


def needs_in_words(needs: Requirements) -> str:
    """State limits as the page shows them."""
    return needs_text(needs).replace("<=", "≤")
