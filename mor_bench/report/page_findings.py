"""Titles and captions of the page's charts: each title states the finding."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mor_bench.analysis.selection_text import ERROR
from mor_bench.report.number_format import number, whole
from mor_bench.report.training_curves import still_falling

Data = Mapping[str, Any]


@dataclass(frozen=True)
class Chart:
    """A chart of the page: its kind for the scripts, a heading, the finding and how to read it."""

    kind: str
    heading: str
    finding: str
    reading: str


def charts(data: Data) -> list[Chart]:
    """List the charts of a dataset for which there is data, in reading order."""
    found = []
    for kind, (heading, key, finding, reading) in _CHARTS.items():
        if data[key]:
            found.append(Chart(kind, heading, finding(data), reading))
    return found


def frontier(data: Data, title: str) -> Chart:
    """Return the chart of error against latency."""
    reading = (
        "Left and down is better. Lines join the configurations of a method. Bars are 95 % "
        "intervals, for medians only. Open markers: the timing was not stable. A dagger (†): not "
        "tested where the method is built for, see the table. A label with a "
        "value belongs to a marker beyond the axis, drawn at its edge. On a phone, the list below "
        "names the numbers. The dashed steps are the Pareto front; they also run through "
        "references, which get no mark in the tables. References solve the full equations on "
        "the dataset's own mesh. Click on the legend to hide a method, double-click to isolate "
        "it. By keyboard: Tab to the legend, arrow keys to an entry, then Enter or Shift+Enter."
    )
    return Chart("frontier", "Error against time", title, reading)


def _row(data: Data, label: str) -> Data:
    return next(row for row in data["rows"] if row["label"] == label)


def _first(data: Data, lines: Sequence[Data]) -> Data:
    """Return the winner's method among some lines, or the first one."""
    rows = {row["label"]: row["method"] for row in data["rows"]}
    method = rows.get(data["winner"])
    return next((line for line in lines if rows.get(line["label"]) == method), lines[0])


def _name(data: Data, line: Data) -> str:
    return str(_row(data, line["label"])["name"])


def _ecdf(data: Data) -> str:
    drawn = [line for line in data["distributions"] if line["error"]["x"]]
    if not drawn:
        return "Latencies of single queries"
    line = _first(data, drawn)
    error = _row(data, line["label"])["error"]
    return (
        f"{_name(data, line)}: 95 % of the test loads have a {ERROR} below "
        f"{number(error['p95'])} %, the largest is {number(error['max'])} %"
    )


def _deformation(data: Data) -> str:
    line = _first(data, data["deformations"])
    low, high = line["median_y"][0], line["median_y"][-1]
    return (
        f"{_name(data, line)}: the median error e is {number(low)} mm at the smallest "
        f"deformations and {number(high)} mm at the largest"
    )


def _position(data: Data) -> str:
    maps = [m for m in data["positions"]["maps"] if any(m["error"])]
    line = _first(data, maps)
    known = [value for value in line["error"] if value is not None]
    place = data["positions"]["centres"][line["error"].index(max(known))]
    where = ", ".join(f"{x:.3g}" for x in place)
    return (
        f"{_name(data, line)}: median {ERROR} {number(min(known))} to {number(max(known))} %, "
        f"largest where the load acts around ({where}) m"
    )


def _singular(data: Data) -> str:
    return str(data["singular"]["finding"])


def _learning(data: Data) -> str:
    line = data["learning"][0]
    (n0, e0), (n1, e1) = line["points"][0], line["points"][-1]
    return (
        f"{line['name']}: {number(e0)} % with {whole(n0)} training samples, "
        f"{number(e1)} % with {whole(n1)}"
    )


def _losses(data: Data) -> str:
    methods = {row["label"]: row["method"] for row in data["rows"]}
    return still_falling(
        [
            (methods[curves["label"]], np.array(curves.get("validation") or curves["loss"]))
            for curves in data["losses"]
        ]
    )


def _costs(data: Data) -> str:
    return str(data["costs"]["finding"])


def _bodies(data: Data) -> str:
    line = _first(data, data["bodies"]["samples"])
    return f"{_name(data, line)}, {line['said']}"


_CHARTS: dict[str, tuple[str, str, Callable[[Data], str], str]] = {
    "bodies": (
        "Deformed bodies",
        "bodies",
        _bodies,
        "Coloured: the prediction, by its error in mm. Blue lines: the full-order reference. "
        "Grey lines: the body at rest. The arrow shows place and direction of the force. "
        "Above each view: the largest error at a node and the relative L2 error of the drawn load. "
        "The load with the largest mean error e is each method's own, and the largest relative "
        "error may be at another load. That with the median deformation is the same for all. "
        "Drag to turn, scroll to zoom; both views turn together. By keyboard: Tab to a view, then "
        "arrow keys, + and −, or Home. Errors beyond half the body's size are cut.",
    ),
    "positions": (
        "Error over the position of the load",
        "positions",
        _position,
        "Each dot is a load patch on the body. Its colour is the median relative L2 error of the "
        "test loads there. Hollow dots are patches without a test load: those of the training "
        "and the validation part.",
    ),
    "deformations": (
        "Error against deformation",
        "deformations",
        _deformation,
        "Lines: medians in ten groups of test loads, by the largest displacement of the reference. "
        "e: mean absolute error over all degrees of freedom, those of the supports too. "
        "Dots: the test loads of one method.",
    ),
    "distributions": (
        "Distribution of errors and latencies",
        "distributions",
        _ecdf,
        "Height: the share of test loads (or queries) with at most this error (or latency). A "
        "curve that ends below 100 % has loads without a prediction.",
    ),
    "costs": (
        "Whole cost and break-even",
        "costs",
        _costs,
        "Core-seconds of training data, fit and queries, for the fastest configuration of each "
        "method that is accurate enough. First chart: total over the number of queries; a "
        "diamond marks the break-even with the full-order model. Second: its parts for one number "
        "of queries, at first near the first break-even, in core-seconds or as shares.",
    ),
    "singular": (
        "Singular values of the training snapshots",
        "singular",
        _singular,
        "Tail: the relative root-mean-square error of the best linear basis of r modes on the "
        "training snapshots. No method with a linear basis of r modes can be more accurate "
        "there. It is a mean over the training loads: single loads need more modes. Markers: the "
        "ranks that were tried.",
    ),
    "learning": (
        "Learning curves",
        "learning",
        _learning,
        "Median error on the test set of the same configuration, fitted to more and more "
        "training samples.",
    ),
    "losses": (
        "Training losses",
        "losses",
        _losses,
        "Each method minimises its own loss, so compare only curves of one method. Dashed: "
        "loss on samples of the training part that the method holds out.",
    ),
}
"""By kind: heading, key of the data, function of the finding, and how to read the chart."""
