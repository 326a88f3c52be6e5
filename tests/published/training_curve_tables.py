"""Tables in Markdown of errors over iterations and training samples of networks."""

from __future__ import annotations

from statistics import median
from typing import Any

from mor_bench.report.number_format import number
from tests.benchmarks.learning_curves import FLAT
from tests.published.run_tables import markdown
from tests.published.stored import content_of

Points = list[dict[str, Any]]


def _by_method(source: str) -> dict[str, Points]:
    points: Points = content_of(source)["points"]
    return {
        name: [point for point in points if point["method"] == name]
        for name in dict.fromkeys(point["method"] for point in points)
    }


def _grouped(points: Points, key: str) -> dict[int, Points]:
    """Return the trainings of several seeds by a number, smallest first."""
    return {n: [p for p in points if p[key] == n] for n in sorted({p[key] for p in points})}


def _error(points: Points, part: str = "test") -> float:
    return float(median(point[part]["mean_dof_m"] for point in points))


def _cell(points: Points) -> str:
    errors = sorted(point["test"]["mean_dof_m"] for point in points)
    low, high = (f"{value:.1e}".replace("e-0", "e-") for value in (errors[0], errors[-1]))
    return f"{_error(points):.1e} ({low} to {high})".replace("e-0", "e-")


def training_iterations(source: str) -> str:
    """Show e of test samples over the iterations, with all training samples."""
    body, most = [], 0
    for name, points in _by_method(source).items():
        whole = max(point["n_train"] for point in points)
        curve = _grouped([point for point in points if point["n_train"] == whole], "iterations")
        numbers, sets = list(curve), list(curve.values())
        most = max(most, len(numbers))
        before, last = (_error(part, "validation") for part in sets[-2:])
        relative = median(point["test"]["rel_l2_median"] for point in sets[-1])
        body.append(
            (
                [f"`{name}`", f"{numbers[0]:,}", *map(_cell, sets)],
                [
                    number(100 * float(relative)),
                    number(float(median(point["core_s"] for point in sets[-1]))),
                    f"{100 * (1 - last / before):.0f}",
                    "yes" if last > (1 - FLAT) * before else "no",
                ],
            )
        )
    headings = ["method", "first number of iterations", "e with it, m"]
    headings += [f"with {2**i} times as many" for i in range(1, most)]
    headings += ["median % of the last", "core-s of the last"]
    headings += ["fall of the validation error by the last doubling, %"]
    rows = [first + ["–"] * (most + 2 - len(first)) + rest for first, rest in body]
    return markdown([*headings, f"flat (< {100 * FLAT:.0f} %)"], rows)


def training_samples(source: str) -> str:
    """Show e of test samples over the training samples; iterations are those of the files."""
    body, sizes = [], []
    for name, points in _by_method(source).items():
        fewest = min(point["n_train"] for point in points)
        (usual,) = {point["iterations"] for point in points if point["n_train"] == fewest}
        curve = _grouped([point for point in points if point["iterations"] == usual], "n_train")
        sizes = list(curve)
        seconds = median(point["core_s"] for point in curve[sizes[-1]])
        body.append(
            [f"`{name}`", f"{usual:,}", *map(_cell, curve.values()), number(float(seconds))]
        )
    headings = ["method", "iterations", *(f"e with {n:,} samples, m" for n in sizes)]
    return markdown([*headings, f"core-s with {sizes[-1]:,}"], body)
