"""What a run did not measure, and the command that does: loads beyond training, learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from mor_bench.analysis.selection_text import ERROR
from mor_bench.report.entries import Entry
from mor_bench.report.number_format import percent
from mor_bench.results.comparison import Comparison

IN_RANGE = "in-range"
"""Named test set whose loads are like those of the training."""


def beyond_training(
    comparison: Comparison, dataset: str, entries: Sequence[Entry], choice: str | None
) -> str:
    """State the errors beyond the training loads, or how to measure them.

    They are those of the configuration that the verdict chose, or else of the most accurate one.
    """
    tested = [entry for entry in entries if entry.ran and set(entry.row.sets) - {IN_RANGE}]
    if not tested:
        command = _full_command(comparison, dataset)
        measures = f"; {command} measures them" if command else ""
        return f"Errors beyond the training loads were not measured{measures}."
    chosen = next((entry for entry in tested if entry.label == choice), None)
    shown = chosen or min(tested, key=lambda entry: (entry.error_bound, entry.error))
    errors = [
        f"{percent(found.rel_l2_median)} % on {name}"
        for name, found in shown.row.sets.items()
        if name != IN_RANGE
    ]
    return f"Beyond the training loads, the median {ERROR} of {shown.label} is {', '.join(errors)}."


def unmeasured(comparison: Comparison, dataset: str, entries: Sequence[Entry]) -> list[str]:
    """List what a full comparison adds to this one, each with the command."""
    found = []
    if any(entry.row.bound and not isfinite(entry.row.bound.relative_l2) for entry in entries):
        found.append("Calibrated error bounds: the validation part has too few load regions.")
    command = _full_command(comparison, dataset)
    if not command or not any(entry.ran for entry in entries):
        return found
    if not any(point.dataset == dataset for point in comparison.learning):
        found.append(f"Learning curves, the error over the number of training samples: {command}.")
    if not any(set(entry.row.sets) - {IN_RANGE} for entry in entries):
        found.append(f"Errors beyond the training loads, on the named test sets: {command}.")
    return found


def _full_command(comparison: Comparison, dataset: str) -> str:
    """Return the command of a full comparison of the same methods; empty if this was one."""
    imported = comparison.datasets.get(dataset, {}).get("snapshots")
    if imported or comparison.settings.get("profile") == "full":
        return ""
    return f"`mor-bench run {dataset} --profile full`"
