"""Direct labels: short texts on free space beside the points that they name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from mor_bench.report.canvas import GREY, INK, NOTE, lay_out, plain

Point = tuple[float, float]

BESIDE: tuple[Point, ...] = (
    *((7, 4), (7, -4), (-7, 4), (-7, -4), (0, 8), (0, -8), (11, 0), (-11, 0), (0, 14), (0, -14)),
    *((20, 14), (20, -14), (-20, 14), (-20, -14), (30, 0), (-30, 0), (0, 26), (0, -26)),
    *((36, 24), (36, -24), (-36, 24), (-36, -24)),
)
"""Offsets from a point, in typographic points, best first; far ones get a line to the point."""

FAR = 16.0
"""Least distance of a text that gets a line to its point, in typographic points."""


@dataclass(frozen=True)
class Note:
    """A short text beside one of several places, given in data coordinates.

    Attributes
    ----------
    text : str
    places : sequence of (float, float)
        Best first.
    colour, weight : str
    offsets : sequence of (float, float)
        Offsets of the text from a place, in typographic points, best first.
    must : bool
        Write it even where it covers something.
    leader : bool
        Draw a line to the place if the text is far from it.
    """

    text: str
    places: Sequence[Point]
    colour: str = INK
    weight: str = "normal"
    offsets: Sequence[Point] = BESIDE
    must: bool = False
    leader: bool = True


@dataclass(frozen=True)
class _Spot:
    """A possible position of a note: its place, its offset, and its box in pixels."""

    cost: float
    place: Point
    offset: Point
    box: Bbox


def annotate(
    axes: Axes,
    notes: Sequence[Note],
    marks: Iterable[Point] = (),
    lines: Sequence[NDArray[np.float64]] = (),
    keep_free: Sequence[Artist] = (),
    radius: float = 5.0,
) -> list[Note]:
    """Write notes on free space; return those that have no room.

    Parameters
    ----------
    axes : Axes
        With its final limits and size.
    notes : sequence of Note
        The most important first.
    marks : iterable of (float, float)
        Markers in data coordinates, which stay free.
    lines : sequence of (n, 2) arrays
        Polylines in data coordinates that notes avoid if possible.
    keep_free : sequence of Artist
        Texts that must not be covered.
    radius : float
        Radius of the markers, in typographic points.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    renderer = lay_out(figure)
    half = radius * figure.dpi / 72.0
    points = axes.transData.transform(np.array([*marks], dtype=float).reshape(-1, 2))
    taken = [Bbox.from_bounds(x - half, y - half, 2 * half, 2 * half) for x, y in points]
    taken += [artist.get_window_extent(renderer) for artist in keep_free]
    crossing = np.concatenate(
        [np.zeros((0, 2)), *(_dense(axes.transData.transform(line)) for line in lines)]
    )
    frame = axes.get_window_extent(renderer)
    unplaced = []
    for note in notes:
        spots = list(_spots(axes, note, renderer, (frame, taken, crossing)))
        if spots:
            best = min(spots, key=lambda spot: spot.cost)
            _write(axes, note, best)
            taken.append(best.box)
        else:
            unplaced.append(note)
    return unplaced


def _spots(
    axes: Axes,
    note: Note,
    renderer: Any,
    room: tuple[Bbox, list[Bbox], NDArray[np.float64]],
) -> Iterable[_Spot]:
    """Yield the positions inside the frame, those on free space unless the note is a must."""
    frame, taken, crossing = room
    scale = renderer.points_to_pixels(1.0)
    font = FontProperties(size=NOTE, weight=note.weight)
    width, height, _ = renderer.get_text_width_height_descent(note.text, font, False)
    # matplotlib gives every line at least the height of these letters.
    height = max(height, renderer.get_text_width_height_descent("lp", font, False)[1])
    for rank, place in enumerate(note.places):
        px, py = axes.transData.transform(place)
        for far, (dx, dy) in enumerate(note.offsets):
            x, y = px + scale * dx, py + scale * dy
            left = x - (0.0 if dx > 0 else width if dx < 0 else width / 2)
            low = y - (height / 2 if abs(dy) <= 5 else 0.0 if dy > 0 else height)
            box = Bbox.from_bounds(left, low, width, height).padded(2.0)
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1
            if not (inside and frame.y0 <= box.y0 and box.y1 <= frame.y1):
                continue
            covered = sum(box.overlaps(other) for other in taken)
            if covered and not note.must:
                continue
            crossed = ((crossing >= box.min) & (crossing <= box.max)).all(axis=1).sum()
            cost = 2.0 * rank + 2.0 * far + float(crossed) + 1000.0 * covered
            yield _Spot(cost, place, (dx, dy), box)


def _write(axes: Axes, note: Note, spot: _Spot) -> None:
    dx, dy = spot.offset
    line = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4}
    text = axes.annotate(
        plain(note.text),
        spot.place,
        xytext=spot.offset,
        textcoords="offset points",
        fontsize=NOTE,
        fontweight=note.weight,
        color=note.colour,
        zorder=7,
        ha="left" if dx > 0 else "right" if dx < 0 else "center",
        va="center" if abs(dy) <= 5 else "bottom" if dy > 0 else "top",
        arrowprops=line if note.leader and np.hypot(dx, dy) > FAR else None,
    )
    text.set_in_layout(False)
    text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along a polyline, about every three pixels."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.append(0.0, np.cumsum(steps))
    if not along[-1] > 0:
        return line
    at = np.linspace(0.0, along[-1], max(2, int(along[-1] / 3)))
    return np.column_stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)])
