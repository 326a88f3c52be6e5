"""The picture of errors of networks over the time of their training."""

from __future__ import annotations

import numpy as np

from mor_bench.report.canvas import GREY, LABEL, Picture, dress, log_ticks, new_figure
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.specs import load_method_spec
from tests.benchmarks.learning_curves import METHODS
from tests.published.stored import content_of
from tests.published.training_curve_tables import core_seconds, curves_of, error_of, flatness

BASELINE = "reports/learned/region/results.json"
"""A run with the linear response alone on the same test samples."""

CAPTION = (
    "Mean error of test samples over the core-seconds of a training, a line per network. "
    "Each point is a training of its own: the median error of three seeds, and the time of the "
    "fastest. Trainings on a graphics processor stand at the time that shorter ones predict for a "
    "core."
)


def training_curves(source: str) -> Picture:
    """Draw e of test samples over core-seconds; the last point is filled if the curve is flat.

    SOURCE is FILE,FILE,….
    """
    lines, notes, flat = [], [], []
    for name, curve in curves_of(source).items():
        points = [(core_seconds(part), error_of(part)) for part in curve.values()]
        lines.append((name, np.array(points)))
        if flatness([error_of(part, "validation") for part in curve.values()])[-1] == "yes":
            flat.append(name)
    finding = f"{len(flat)} of {len(lines)} curves are flat at their end"
    subject = "beam-coarse: error over the training. Last point filled: flat; open: not flat"
    figure = new_figure(6.2, finding, subject)
    axes = figure.subplots()
    dress(axes)
    for name, course in lines:
        style = style_of(name)
        axes.loglog(*course.T, color=style.colour, linestyle=style.line, linewidth=1.4)
        face = style.colour if name in flat else "white"
        look = {"color": style.colour, "markersize": 7, "markerfacecolor": face}
        axes.loglog(*course[-1], style.marker, **look)
        spec = load_method_spec(name)
        told = spec.told_with(spec.parameters | METHODS[name])
        text = f"{name}, force only" if told == "input" else name
        places = [(float(x), float(y)) for x, y in course[:-4:-1]]
        notes.append(Note(text, places, readable(style.colour), "bold", must=True))
    (linear,) = (row for row in content_of(BASELINE)["rows"] if row["label"] == "linear-fem")
    level = float(linear["error"]["mean_dof_m"])
    axes.axhline(level, color=GREY, linestyle="--", linewidth=1.0)
    start = min(float(course[0, 0]) for _, course in lines)
    notes.append(Note("linear-fem", [(start, level)], GREY, must=True))
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    axes.margins(x=0.2, y=0.06)
    axes.set_xlabel("core-seconds of the training", fontsize=LABEL)
    axes.set_ylabel("e of test samples (m)", fontsize=LABEL)
    ends = [(float(course[-1, 0]), float(course[-1, 1])) for _, course in lines]
    annotate(axes, notes, ends, [course for _, course in lines])
    return Picture("training-curves", "Errors over the training", CAPTION, figure, finding)
