"""Tables in Markdown of errors over iterations and training samples of networks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from mor_bench.report.number_format import number
from tests.benchmarks.learning_curves import FLAT
from tests.published.run_tables import markdown
from tests.published.stored import content_of

Points = list[dict[str, Any]]

FLATNESS = (
    "falls of the validation error by the last doublings, %",
    f"flat (both < {100 * FLAT:.0f} %)",
)
"""Headings of the cells of `flatness`."""


def _by_method(source: str) -> dict[str, Points]:
    """Return the points of each method from the last of several files that has it."""
    found: dict[str, Points] = {}
    for name in source.split(","):
        points: Points = content_of(name)["points"]
        methods = dict.fromkeys(point["method"] for point in points)
        found |= {method: [p for p in points if p["method"] == method] for method in methods}
    return found


def _grouped(points: Points, key: str) -> dict[int, Points]:
    """Return the trainings of several seeds by a number, smallest first."""
    return {n: [p for p in points if p[key] == n] for n in sorted({p[key] for p in points})}


def curves_of(source: str) -> dict[str, dict[int, Points]]:
    """Return the trainings with all samples of each method, by their iterations.

    SOURCE is FILE,FILE,….
    """
    found = {}
    for name, points in _by_method(source).items():
        whole = max(point["n_train"] for point in points)
        curve = _grouped([p for p in points if p["n_train"] == whole], "iterations")
        found[name] = _with_core_seconds(curve)
    return found


def _with_core_seconds(curve: dict[int, Points]) -> dict[int, Points]:
    """Give trainings on a graphics processor core-seconds, in proportion to the iterations.

    The longest trainings on a processor set the proportion.
    """
    most = max(n for n, points in curve.items() if "core_s" in points[0])
    each = core_seconds(curve[most]) / most
    return {
        n: [{"core_s": n * each, "predicted": True, **p} if "gpu_s" in p else p for p in points]
        for n, points in curve.items()
    }


def error_of(points: Points, part: str = "test") -> float:
    """Return the median of e over trainings, in m, of the test or validation samples."""
    return float(median(point[part]["mean_dof_m"] for point in points))


def _cell(points: Points) -> str:
    """Return the median, and the range in the median's power of ten."""
    middle = f"{error_of(points):.1e}".replace("e-0", "e-")
    if len(points) == 1:
        return middle
    errors = sorted(point["test"]["mean_dof_m"] for point in points)
    unit = float("1e" + middle.partition("e")[2])
    return f"{middle} ({errors[0] / unit:.1f} to {errors[-1] / unit:.1f})"


def flatness(errors: Sequence[float]) -> list[str]:
    """Return how far validation errors fall by the last two doublings, in %, and the verdict.

    A curve is flat if both falls are below `FLAT`, and rises if the last error is larger by more
    than that.
    """
    falls = [1 - after / before for before, after in pairwise(errors)][-2:]
    if falls[-1] < -FLAT:
        verdict = "rises"
    else:
        verdict = "yes" if len(falls) == 2 and max(falls) < FLAT else "no"
    return [", ".join(f"{100 * fall:.1f}" for fall in falls), verdict]


def core_seconds(points: Points) -> float:
    """Return the least core-seconds of trainings that differ by their seeds."""
    return float(min(point["core_s"] for point in points))


def training_iterations(source: str) -> str:
    """Show e of test samples over the iterations, with all training samples, for each method.

    Shown are the fewest iterations, those with the least error on validation samples, and the most
    ones. SOURCE is FILE,FILE,…. The method with the least selected e comes first.
    """
    body = []
    for name, curve in curves_of(source).items():
        held_out = {n: error_of(part, "validation") for n, part in curve.items()}
        selected = min(held_out, key=lambda n: held_out[n])
        first, best = curve[min(curve)], curve[selected]
        relative = float(median(point["test"]["rel_l2_median"] for point in best))
        cells = [f"`{name}`", f"{min(curve):,}", _cell(first), f"{selected:,}", _cell(best)]
        seconds = "≈ " * ("predicted" in best[0]) + number(core_seconds(best))
        cells += [number(100 * relative), seconds, f"{max(curve):,}"]
        body.append((error_of(best), cells + flatness(list(held_out.values()))))
    headings = ["method", "fewest iterations", "e with them, m", "selected iterations"]
    headings += ["e with them, m", "median %", "core-s", "most iterations", *FLATNESS]
    return markdown(headings, [cells for _, cells in sorted(body, key=lambda row: row[0])])


def training_samples(source: str) -> str:
    """Show e of test samples over the training samples; iterations are those of the files.

    SOURCE is FILE,FILE,…. The method with the least e with all samples comes first.
    """
    body, sizes = [], []
    for name, points in _by_method(source).items():
        fewest = min(point["n_train"] for point in points)
        (usual,) = {point["iterations"] for point in points if point["n_train"] == fewest}
        curve = _grouped([point for point in points if point["iterations"] == usual], "n_train")
        sizes = list(curve)
        seconds = number(core_seconds(curve[sizes[-1]]))
        cells = [f"`{name}`", f"{usual:,}" if usual else "–", *map(_cell, curve.values())]
        body.append((error_of(curve[sizes[-1]]), [*cells, seconds]))
    headings = ["method", "iterations", *(f"e with {n:,} samples, m" for n in sizes)]
    rows = [cells for _, cells in sorted(body, key=lambda row: row[0])]
    return markdown([*headings, f"core-s with {sizes[-1]:,}"], rows)
