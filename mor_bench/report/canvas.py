"""What all figures share: size, colours and markers of methods, writing, and labels that do not overlap."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically

DPI = 150
WIDTH_IN = 9.4
"""Inches; 1,410 pixels, what a README shows without scaling up."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
"""Okabe and Ito's palette, distinct for the common kinds of colour blindness (its yellow, illegible on white, replaced by a brown)."""

MARKERS = ("o", "s", "^", "D", "P", "X", "v", "*", "<", ">", "h")

INK, GREY, LIGHT = "#222222", "#8a8a8a", "#d9d9d9"


@dataclass(frozen=True)
class Drawn:
    """A figure on disk.

    Attributes
    ----------
    dataset : str
    path : Path
        PNG file.
    title : str
    caption : str
        How to read it.
    """

    dataset: str
    path: Path
    title: str
    caption: str


@dataclass(frozen=True)
class Style:
    """How a method looks in every figure."""

    colour: str
    marker: str


def styles_of(comparison: Comparison) -> dict[str, Style]:
    """A colour and a marker for each method, in the order in which they ran."""
    methods = dict.fromkeys(row["method"] for row in comparison.rows)
    return {
        method: Style(COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)])
        for i, method in enumerate(methods)
    }


def new_figure(height_in: float) -> Figure:
    """An empty figure of the common width that belongs to no global state."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes) -> None:
    """The common look of plots: light grid, no box."""
    axes.grid(True, which="major", color="#e6e6e6", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=INK, which="both")
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GREY)


def save(figure: Figure, comparison: Comparison, dataset: str, kind: str) -> Path:
    """Write a figure to OUT/figures/ atomically."""
    folder = comparison.out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w.=-]+", "-", dataset).strip("-")
    path = folder / f"{name}--{kind}.png"
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())
    return path


def plain(text: str) -> str:
    """Text in which matplotlib sees no formula."""
    return text.replace("$", r"\$")


def shortened(text: str, length: int) -> str:
    """At most so many characters, with an ellipsis where some were lost."""
    return text if len(text) <= length else text[: length - 1] + "…"


_OFFSETS = (
    (7, 5),
    (7, -5),
    (-7, 5),
    (-7, -5),
    (0, 9),
    (0, -9),
    (11, 0),
    (-11, 0),
    (0, 14),
    (0, -14),
)
"""Places around a point, in points, the best first."""


@dataclass(frozen=True)
class Note:
    """A short text beside a point, given in data coordinates."""

    x: float
    y: float
    text: str
    colour: str = INK


def annotate(
    axes: Axes,
    notes: Sequence[Note],
    lines: Sequence[NDArray[np.float64]],
    keep_free: Sequence[Artist] = (),
    radius: float = 5.0,
) -> None:
    """Write notes where nothing else stands; one for which there is no room is left out.

    Parameters
    ----------
    axes : Axes
        With its final limits.
    notes : sequence of Note
        The most important first.
    lines : sequence of (n, 2) arrays
        Polylines in data coordinates that texts should rather not cross.
    keep_free : sequence of Artist
        Texts that must not be covered.
    radius : float
        Of the markers, in typographic points.
    """
    canvas: Any = FigureCanvasAgg(
        axes.get_figure(root=True)
    )  # matplotlib's annotations lack this class's methods
    canvas.draw()
    renderer = canvas.get_renderer()
    half, further = radius * DPI / 72.0, radius - 5.0
    points = axes.transData.transform(np.array([(note.x, note.y) for note in notes]).reshape(-1, 2))
    markers = [Bbox.from_bounds(x - half, y - half, 2 * half, 2 * half) for x, y in points]
    taken = [artist.get_window_extent(renderer) for artist in keep_free]
    on_lines = np.concatenate(
        [np.zeros((0, 2)), *(_dense(axes.transData.transform(line)) for line in lines)]
    )
    frame = axes.get_window_extent(renderer)
    for note in notes:
        best: tuple[float, Annotation, Bbox] | None = None
        for rank, (dx, dy) in enumerate(_OFFSETS):
            away = (dx + further * np.sign(dx), dy + further * np.sign(dy))
            text = axes.annotate(
                plain(note.text),
                (note.x, note.y),
                xytext=away,
                textcoords="offset points",
                **_look(note, dx, dy),
            )
            text.set_in_layout(False)
            text.set_path_effects([withStroke(linewidth=2, foreground="white")])
            box = text.get_window_extent(renderer).padded(1.5)
            inside = (
                frame.x0 <= box.x0
                and box.x1 <= frame.x1
                and frame.y0 <= box.y0
                and box.y1 <= frame.y1
            )
            free = inside and not any(box.overlaps(other) for other in [*taken, *markers])
            cost = 2.0 * rank + float(
                ((on_lines >= box.min) & (on_lines <= box.max)).all(axis=1).sum()
            )
            if free and (best is None or cost < best[0]):
                if best is not None:
                    best[1].remove()
                best = (cost, text, box)
            else:
                text.remove()
        if best is not None:
            taken.append(best[2])


def _look(note: Note, dx: int, dy: int) -> dict[str, Any]:
    horizontal = "left" if dx > 0 else "right" if dx < 0 else "center"
    vertical = "center" if abs(dy) <= 5 else "bottom" if dy > 0 else "top"
    return {"fontsize": 7.5, "color": note.colour, "zorder": 6, "ha": horizontal, "va": vertical}


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points every three pixels or so along a polyline."""
    pieces = [np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / 3))) for a, b in pairwise(line)]
    return np.concatenate(pieces) if pieces else line
