"""The plane of latency and error: its axes, cut at outliers, and the series of each method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.verdict import Requirements
from mor_bench.report.canvas import shortened, uncut
from mor_bench.report.entries import Entry
from mor_bench.report.method_styles import LINES, Line
from mor_bench.report.short_names import value_text, varied_keys

WORST_PERCENT = 150.0
"""Errors above it, worse than answering zero, lie beyond the axis if there are smaller ones."""

BELOW_NEEDS = 0.01
"""Errors below this part of the needed error lie beyond the axis."""


@dataclass(frozen=True)
class Series:
    """Configurations of a method that differ in their first swept parameter, joined by a line.

    If a second swept parameter varies, too, each of its values has a line of its own dash.
    """

    name: str
    members: Sequence[Entry]
    line: Line


@dataclass(frozen=True)
class Plane:
    """The shown range of latency in ms and of the error in percent, and the points on it.

    Attributes
    ----------
    x, y : (float, float)
        Ends of the axes.
    needs : Requirements
    mesh_percent : float or None
        Discretisation error of the dataset's mesh.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    needs: Requirements
    mesh_percent: float | None
    mesh_at_least: bool = False

    def place(self, entry: Entry) -> tuple[float, float]:
        """Latency in ms and error in percent; a point beyond the axes lies at their end."""
        (x0, x1), (y0, y1) = self.x, self.y
        x, y = entry.latency_ms, 100 * entry.error
        inset = (y1 / y0) ** 0.04
        return (
            min(x, x1 / (x1 / x0) ** 0.03) if x > x1 else x,
            y0 * inset if y < y0 else y1 / inset if y > y1 else y,
        )

    def direction(self, entry: Entry) -> tuple[int, int] | None:
        """Direction in which a point lies beyond the axes; None if it is shown."""
        y = 100 * entry.error
        found = (int(entry.latency_ms > self.x[1]), int(y > self.y[1]) - int(y < self.y[0]))
        return found if any(found) else None

    def bars(self, entry: Entry) -> NDArray[np.float64]:
        """Ends (2, 2) of the intervals of latency in ms and of the error in percent.

        They contain the point itself; an unknown or infinite end is at the point.
        """
        x, y = self.place(entry)
        if self.direction(entry):
            return np.array([[x, x], [y, y]])
        latency = entry.intervals.get("latency_ms", (x, x))
        error = np.multiply(100, entry.intervals.get("rel_l2_median", (y / 100, y / 100)))
        ends = np.array([latency, np.maximum(error, self.y[0])])
        ends = np.where(np.isfinite(ends), ends, np.array([[x], [y]]))
        return np.stack([np.minimum(ends[:, 0], [x, y]), np.maximum(ends[:, 1], [x, y])], axis=1)


def timed_and_scored(entries: Sequence[Entry]) -> list[Entry]:
    """Return the configurations with a finite median error and latency."""
    return [e for e in entries if e.ran and isfinite(e.error) and isfinite(e.latency_ms)]


def plane_of(shown: Sequence[Entry], needs: Requirements) -> Plane:
    """Choose axes that hold the points but for outliers, their bars, and the corner of the needs.

    Errors far below the needs are left out, such as those of references. The discretisation error
    is held if it is near.
    """
    known = ((e.row.discretisation_rel_l2 or 0.0, e.row.discretisation_at_least) for e in shown)
    mesh, at_least = next((pair for pair in known if pair[0] > 0), (None, False))
    errors = [100 * e.error for e in shown]
    needed = 100 * (needs.error or inf)
    floor = BELOW_NEEDS * needed if isfinite(needed) else 0.0
    useful = [error for error in errors if floor <= error <= WORST_PERCENT] or errors
    y0, y1 = uncut([*useful, needed])
    x0, x1 = uncut([e.latency_ms for e in shown])
    bars = Plane((0.0, inf), (y0, y1), needs, None)
    for entry in shown:
        if not bars.direction(entry) and entry.latency_ms <= x1:
            (near, far), (low, high) = bars.bars(entry)
            x0, x1 = min(x0, max(near, x0 / 2)), max(x1, min(far, 2 * x1))
            y0, y1 = min(y0, max(low, y0 / 2)), max(y1, min(high, 2 * y1))
    if mesh and y0 / 30 < 100 * mesh < 30 * y1:
        y0, y1 = min(y0, 100 * mesh), max(y1, 100 * mesh)
    if needs.latency_ms and needs.latency_ms < 30 * x1:
        x0, x1 = min(x0, needs.latency_ms), max(x1, needs.latency_ms)
    if isfinite(needed):
        y0, y1 = min(y0, needed), max(y1, needed)
    x_room, y_room = max(1.25, (x1 / x0) ** 0.07), max(1.3, (y1 / y0) ** 0.08)
    return Plane(
        (x0 / x_room, x1 * x_room),
        (y0 / y_room, y1 * y_room),
        needs,
        100 * mesh if mesh else None,
        at_least,
    )


def lines_of(mine: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Group a method's configurations by the values of all swept parameters but the first."""
    varied = varied_keys([e.row for e in mine])[1:]
    groups: dict[str, list[Entry]] = {}
    for entry in mine:
        text = value_text({key: entry.swept.get(key) for key in varied})
        groups.setdefault(text, []).append(entry)
    return groups


def series_of(shown: Sequence[Entry]) -> list[Series]:
    """Join the configurations of each method that differ in their first swept parameter."""
    found = []
    for method in dict.fromkeys(e.method for e in shown):
        groups = lines_of([e for e in shown if e.method == method])
        found += [
            Series(
                shortened(f"{method}, {text}" if text else method),
                members,
                LINES[i % len(LINES)][0],
            )
            for i, (text, members) in enumerate(groups.items())
        ]
    return found
