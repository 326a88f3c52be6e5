"""Shared parts of all figures: size, colours, markers, ticks, saving, labels without overlap."""

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
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs.method_spec import Told

DPI = 150
WIDTH_IN = 9.4
"""Width in inches, equal to 1,410 pixels, the width of a README."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
"""Okabe and Ito's palette for colour-blind readers, with brown instead of its pale yellow."""

MARKERS: dict[Told | None, tuple[str, ...]] = {
    "input": ("o", "h", "8"),
    "linear-response": ("s", "D", "d"),
    "equations": ("^", ">", "<"),
    None: ("P", "X", "*"),
}
"""Markers by what a method is told: round ones for the force only, squares, triangles."""

INK, GREY, LIGHT = "#222222", "#8a8a8a", "#d9d9d9"


@dataclass(frozen=True)
class Picture:
    """A figure that is drawn but not saved.

    `kind` is a part of its file name, such as ``learning-curves``. `title` and `caption` describe
    the figure and explain how to read it. `finding` says what it shows, for readers who cannot see
    it.
    """

    kind: str
    title: str
    caption: str
    figure: Figure
    finding: str = ""


@dataclass(frozen=True)
class Drawn:
    """A figure on disk: its dataset, PNG file, title, a caption that explains it, and a finding."""

    dataset: str
    path: Path
    title: str
    caption: str
    finding: str = ""


@dataclass(frozen=True)
class Style:
    """Colour and marker of a method in every figure."""

    colour: str
    marker: str


def styles_of(comparison: Comparison) -> dict[str, Style]:
    """Choose a colour for each method, in the order of the run, and a marker by its class."""
    told: dict[str, Told | None] = {}
    for row in comparison.rows:
        told.setdefault(row.method, row.told)
    return {
        method: Style(
            COLOURS[i % len(COLOURS)], MARKERS[told[method]][i // len(COLOURS) % len(MARKERS[None])]
        )
        for i, method in enumerate(told)
    }


def new_figure(height_in: float, title: str) -> Figure:
    """Make an empty figure of the common width, outside matplotlib's global state."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(plain(title), x=0.01, ha="left", fontsize=13, color=INK)
    return figure


def dress(axes: Axes) -> None:
    """Give plots their common style: light grid, no box."""
    axes.grid(True, which="major", color="#e6e6e6", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=INK, which="both")
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GREY)


def log_ticks(axis: Axis, values: Sequence[float] = (1.0,), unit: str = "") -> None:
    """Label a logarithmic axis with plain numbers, fewer where the values span a wide range."""
    subs = (1.0, 2.0, 5.0) if max(values) / min(values) < 300 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}{unit}"))
    axis.set_minor_formatter(NullFormatter())


def save(picture: Picture, comparison: Comparison, dataset: str) -> Drawn:
    """Write a figure to OUT/figures/ atomically."""
    folder = comparison.out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w.=-]+", "-", dataset).strip("-")
    path = folder / f"{name}--{picture.kind}.png"
    buffer = io.BytesIO()
    picture.figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())
    return Drawn(dataset, path, picture.title, picture.caption, picture.finding)


def plain(text: str) -> str:
    """Escape a text so that matplotlib does not read it as a formula."""
    return text.replace("$", r"\$")


def shortened(text: str, length: int) -> str:
    """Cut a text to a number of characters, with an ellipsis if some are lost."""
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
"""Offsets from a point, in typographic points, best first."""


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
    """Write notes on free space; omit a note that has no room.

    Parameters
    ----------
    axes : Axes
        With its final limits.
    notes : sequence of Note
        The most important first.
    lines : sequence of (n, 2) arrays
        Polylines in data coordinates that notes avoid if possible.
    keep_free : sequence of Artist
        Texts that must not be covered.
    radius : float
        Radius of the markers, in typographic points.
    """
    # matplotlib's type of a figure's canvas lacks the methods of this class.
    canvas: Any = FigureCanvasAgg(axes.get_figure(root=True))
    canvas.draw()
    renderer = canvas.get_renderer()
    half = radius * DPI / 72.0
    points = axes.transData.transform(np.array([(note.x, note.y) for note in notes]).reshape(-1, 2))
    taken = [Bbox.from_bounds(x - half, y - half, 2 * half, 2 * half) for x, y in points]
    taken += [artist.get_window_extent(renderer) for artist in keep_free]
    on_lines = np.concatenate(
        [np.zeros((0, 2)), *(_dense(axes.transData.transform(line)) for line in lines)]
    )
    frame = axes.get_window_extent(renderer)
    for note in notes:
        best: tuple[float, Annotation, Bbox] | None = None
        for rank, offset in enumerate(_OFFSETS):
            text = _write(axes, note, offset, radius - 5.0)
            box = text.get_window_extent(renderer).padded(1.5)
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1
            inside = inside and frame.y0 <= box.y0 and box.y1 <= frame.y1
            free = inside and not any(box.overlaps(other) for other in taken)
            crossed = ((on_lines >= box.min) & (on_lines <= box.max)).all(axis=1).sum()
            cost = 2.0 * rank + float(crossed)
            if free and (best is None or cost < best[0]):
                if best is not None:
                    best[1].remove()
                best = (cost, text, box)
            else:
                text.remove()
        if best is not None:
            taken.append(best[2])


def _write(axes: Axes, note: Note, offset: tuple[int, int], further: float) -> Annotation:
    dx, dy = offset
    text = axes.annotate(
        plain(note.text),
        (note.x, note.y),
        xytext=(dx + further * np.sign(dx), dy + further * np.sign(dy)),
        textcoords="offset points",
        fontsize=7.5,
        color=note.colour,
        zorder=6,
        ha="left" if dx > 0 else "right" if dx < 0 else "center",
        va="center" if abs(dy) <= 5 else "bottom" if dy > 0 else "top",
    )
    text.set_in_layout(False)
    text.set_path_effects([withStroke(linewidth=2, foreground="white")])
    return text


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along a polyline, about every three pixels."""
    pieces = [np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / 3))) for a, b in pairwise(line)]
    return np.concatenate(pieces) if pieces else line
