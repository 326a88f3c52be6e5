"""Shared parts of all figures: size, heading, fonts, ticks, cut axes, saving."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mor_bench.report import line_wrapping
from mor_bench.report.line_wrapping import KEPT
from mor_bench.report.number_format import joined_units
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import make_own_folder, write_atomically

DPI = 200
WIDTH_IN = 7.05
"""Width in inches, equal to 1,410 pixels, the width of a README."""

TITLE, LABEL, TICK, NOTE = 13.0, 11.0, 10.0, 9.5
"""Sizes of fonts in typographic points; the smallest is legible at a third of the pixels."""

LONGEST_NAME = 60
"""Most characters of a configuration's name; those of the suite have up to 49."""

INK, GREY, LIGHT = "#222222", "#6e6e6e", "#d9d9d9"

HASH_SALT = "mor-bench"
"""Replaces the random part of names in SVG files, so that equal figures give equal files."""


@dataclass(frozen=True)
class Picture:
    """A figure that is drawn but not saved.

    `kind` is a part of its file name, such as ``learning-curves``. `title` and `caption` describe
    the figure and explain how to read it. `finding` says what it shows; it is the figure's heading
    and its text for readers who cannot see it.
    """

    kind: str
    title: str
    caption: str
    figure: Figure
    finding: str = ""


@dataclass(frozen=True)
class Drawn:
    """A figure on disk: its dataset, PNG file, title, a caption that explains it, and a finding.

    The same figure as SVG lies beside the PNG file.
    """

    dataset: str
    path: Path
    title: str
    caption: str
    finding: str = ""

    @property
    def svg(self) -> Path:
        return self.path.with_suffix(".svg")


def new_figure(height_in: float, finding: str, subject: str) -> Figure:
    """Make an empty figure of the common width, outside matplotlib's global state.

    Parameters
    ----------
    height_in : float
        Height below the heading, in inches.
    finding : str
        What the figure shows: its heading.
    subject : str
        Dataset and kind of figure, in small letters below the heading.
    """
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    room = 0.98 * WIDTH_IN * DPI
    parts = []
    for text, size, weight, colour in (
        (finding, TITLE, "bold", INK),
        (subject, NOTE + 0.5, "normal", GREY),
    ):
        font = FontProperties(size=size, weight=weight)

        def width(words: str, font: FontProperties = font) -> float:
            return float(renderer.get_text_width_height_descent(words, font, False)[0])

        lines = balanced(text, room, width)
        parts.append((lines, size, weight, colour))
    heading = 0.07 + sum(1.3 * size * len(lines) for lines, size, _, _ in parts) / 72
    whole = height_in + heading
    figure.set_size_inches(WIDTH_IN, whole)
    top = whole - 0.05
    for lines, size, weight, colour in parts:
        where = {"x": 0.01, "y": top / whole, "ha": "left", "va": "top", "linespacing": 1.2}
        figure.text(s=plain("\n".join(lines)), fontsize=size, color=colour, weight=weight, **where)  # type: ignore[arg-type]
        top -= 1.3 * size * len(lines) / 72
    below = (0.005, 0.03 / whole, 0.99, (height_in - 0.06) / whole)
    figure.set_layout_engine(ConstrainedLayoutEngine(rect=below))
    return figure


def add_note(figure: Figure, note: str) -> None:
    """Make a figure of `new_figure` higher, and write a note in small letters below its heading."""
    renderer = lay_out(figure)
    font = FontProperties(size=NOTE)

    def width(words: str) -> float:
        return float(renderer.get_text_width_height_descent(words, font, False)[0])

    lines = wrapped(note, 0.98 * WIDTH_IN * DPI, width)
    before = float(figure.get_size_inches()[1])
    more = 1.3 * NOTE * len(lines) / 72
    whole = before + more
    for text in figure.texts:
        if (
            text.get_verticalalignment() == "top"
        ):  # a line of the heading; the layout places all others
            text.set_y((text.get_position()[1] * before + more) / whole)
    engine = figure.get_layout_engine()
    assert engine is not None
    left, bottom, wide, tall = engine.get()["rect"]
    figure.set_size_inches(WIDTH_IN, whole)
    below = (left, bottom * before / whole, wide, tall * before / whole)
    figure.set_layout_engine(ConstrainedLayoutEngine(rect=below))
    top = ((bottom + tall) * before + more + 0.05) / whole
    where = {"x": 0.01, "y": top, "ha": "left", "va": "top", "linespacing": 1.2}
    figure.text(s=plain("\n".join(lines)), fontsize=NOTE, color=GREY, **where)


def lay_out(figure: Figure) -> Any:
    """Draw a figure, so that its layout is final; return the renderer, which measures artists."""
    shown = figure.canvas  # of a notebook, perhaps
    # matplotlib's type of a figure's canvas lacks the methods of this class.
    canvas: Any = FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    figure.set_canvas(shown)
    return canvas.get_renderer()


def balanced(text: str, room: float, width: Callable[[str], float]) -> list[str]:
    """Break a text into as few lines as fit a width, of about the same length."""
    lines = wrapped(text, room, width)
    for part in (0.55, 0.65, 0.75, 0.85):
        if len(shorter := wrapped(text, part * room, width)) == len(lines):
            return shorter
    return lines


def wrapped(text: str, room: float, width: Callable[[str], float]) -> list[str]:
    """Break a text into lines of at most a width; a longer word stands alone.

    No line breaks between a number and its unit, nor within a name such as ``hpod · r5``.
    """
    lines, text = [""], joined_units(text).replace(" · ", f"{KEPT}·{KEPT}")
    for word in re.split("[ \n]+", text.strip()):
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and width(longer) > room:
            lines.append(word)
        else:
            lines[-1] = longer
    return [line.replace(KEPT, " ") for line in lines]


def dress(axes: Axes) -> None:
    """Give plots their common style: light grid, no box."""
    axes.grid(True, which="major", color="#e6e6e6", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=TICK, colors=INK, which="both")
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(fontsize=LABEL, color=INK)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GREY)


def log_ticks(axis: Axis, values: Sequence[float] = (1.0,), unit: str = "") -> None:
    """Label a logarithmic axis with plain numbers, fewer where the values span a wide range."""
    subs = (1.0, 2.0, 5.0) if max(values) / min(values) < 300 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.7g}{unit}"))
    axis.set_minor_formatter(NullFormatter())


def uncut(values: Iterable[float]) -> tuple[float, float]:
    """Return the smallest and largest value that a logarithmic axis should hold.

    Up to a quarter of the values at either end are outliers if a gap separates them that is wider
    than a decade and than half the range of the others. Values of zero are never held.
    """
    logs = np.sort(np.log10([value for value in values if 0 < value < np.inf]))
    if not len(logs):
        return 1.0, 1.0
    most = len(logs) // 4
    first, end = 0, len(logs)
    for n in range(1, most + 1):
        if logs[n] - logs[n - 1] > max(1.0, 0.5 * (logs[-1] - logs[n])):
            first = n
    for n in range(1, most + 1):
        if logs[-n] - logs[-n - 1] > max(1.0, 0.5 * (logs[-n - 1] - logs[first])):
            end = len(logs) - n
    return float(10 ** logs[first]), float(10 ** logs[end - 1])


def length_unit(largest_m: float) -> tuple[str, float]:
    """Return a unit in which a length in metres has few digits, and its number per metre."""
    if largest_m >= 1:
        return "m", 1.0
    return ("mm", 1e3) if largest_m >= 1e-3 else ("µm", 1e6)


def save(picture: Picture, comparison: Comparison, dataset: str) -> Drawn:
    """Write a figure as PNG and SVG to OUT/figures/, each atomically."""
    folder = comparison.out / "figures"
    make_own_folder(folder)
    name = re.sub(r"[^\w.=-]+", "-", dataset).strip("-")
    drawn = Drawn(
        dataset,
        folder / f"{name}--{picture.kind}.png",
        picture.title,
        picture.caption,
        picture.finding,
    )
    write_atomically(drawn.path, as_png(picture.figure, {"Software": None}))
    picture.figure.set_layout_engine("none")  # a second layout would take as long as the first
    write_atomically(drawn.svg, as_svg(picture))
    return drawn


def as_png(figure: Figure, metadata: dict[str, str | None]) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata=metadata)
    return buffer.getvalue()


def as_svg(picture: Picture) -> bytes:
    """Return a figure as SVG; equal figures give equal bytes."""
    buffer = io.BytesIO()
    metadata = {"Date": None, "Creator": None, "Title": picture.finding or picture.title}
    with matplotlib.rc_context({"svg.hashsalt": HASH_SALT, "svg.fonttype": "path"}):
        picture.figure.savefig(buffer, format="svg", dpi=DPI, metadata=metadata)
    return buffer.getvalue()


def plain(text: str) -> str:
    """Escape a text so that matplotlib does not read it as a formula."""
    return text.replace("$", r"\$")


def shortened(name: str) -> str:
    """Cut a name that is longer than any of the suite, with an ellipsis."""
    return name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"


def folded(name: str, width: int) -> str:
    """Break the name of a configuration into lines, between its values where possible."""
    name = shortened(name)
    return "\n".join(line_wrapping.wrapped(name, width, names=re.split(" · |, ", name)))
