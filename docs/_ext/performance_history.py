"""The directive `performance-history`: the package over its commits, from the results of asv.

It shows the picture `methods/performance-history.png`, drawn at each build, and a link to asv's
dashboard. The dashboard is left out of builds without asv or without the git history. Both are left
out if no quantity was measured on two commits.
"""

from __future__ import annotations

import itertools
import json
import statistics
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from docutils import nodes
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mor_bench.report.canvas import as_png, dress, log_ticks, new_figure
from mor_bench.report.method_styles import style_of
from tests.benchmarks.asv_history import RESULTS, ROOT
from tests.benchmarks.publish import publish_history

PICTURE = "methods/performance-history.png"
DASHBOARD = "_static/performance-dashboard"
"""Where the checks of the site's own pages do not look: asv's page has a layout of its own."""

SERVE = "python -m http.server --directory docs/_build/html"

LEAST_COMMITS = 2
"""Commits that a series needs to be shown: one value is no history."""


@dataclass
class Series:
    """Values of one quantity with one choice of parameters, by commit, oldest first."""

    benchmark: str
    parameters: tuple[str, ...]
    values: dict[str, float] = field(default_factory=dict)

    @property
    def worth_showing(self) -> bool:
        return len(self.values) >= LEAST_COMMITS


@dataclass(frozen=True)
class Panel:
    """One plot of the picture: the series of a benchmark, in a unit."""

    title: str
    benchmark: str
    factor: float
    unit: str


PANELS = (
    Panel("Full-order solve", "FullOrder.track_solve", 1e3, "CPU ms"),
    Panel("Residual and tangent", "FullOrder.track_residual_and_tangent", 1e3, "CPU ms"),
    Panel("Query on beam-coarse", "Query.track_predict", 1e6, "CPU µs"),
    Panel("Counted work of a solve", "FullOrder.track_multiply_adds", 1e-6, "10⁶ multiply-adds"),
    Panel("Peak memory of a solve", "FullOrder.track_peak_memory", 2.0**-20, "MiB"),
    Panel("Import", "Import.track_cpu_time", 1e3, "CPU ms"),
)
COLOURS = {"beam-coarse": ("#0072b2", "o"), "beam-fine": ("#d55e00", "s"), "": ("#222222", "o")}


def stored(folder: Path = RESULTS) -> list[dict[str, Any]]:
    """Read every result of a folder in asv's format, oldest commit first."""
    paths = [path for path in folder.glob("*/*.json") if path.name != "machine.json"]
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    return sorted(found, key=lambda content: (content["date"], content["commit_hash"]))


def read_series(results: list[dict[str, Any]]) -> dict[tuple[str, tuple[str, ...]], Series]:
    """Collect the series of results; what a commit could not do is missing in its series."""
    found: dict[tuple[str, tuple[str, ...]], Series] = {}
    for content in results:
        for name, row in content["results"].items():
            named = dict(zip(content["result_columns"], row, strict=False))
            choices = itertools.product(*named["params"])
            benchmark = name.partition(".")[2]
            for choice, value in zip(choices, named["result"] or (), strict=False):
                if value is not None and value == value:
                    parameters = tuple(text.strip("'") for text in choice)
                    series = Series(benchmark, parameters)
                    found.setdefault((benchmark, parameters), series).values[
                        content["commit_hash"]
                    ] = value
    return found


def shown(folder: Path = RESULTS) -> dict[tuple[str, tuple[str, ...]], Series]:
    """Return the series of a folder that have a history."""
    return {key: each for key, each in read_series(stored(folder)).items() if each.worth_showing}


def scatter(series: Series) -> float:
    """Return the median relative change between neighbouring commits: mostly noise."""
    pairs = itertools.pairwise(series.values.values())
    return statistics.median(abs(b - a) / max(a, b) for a, b in pairs)


def picture(folder: Path = RESULTS) -> Figure | None:
    """Draw the picture; None if no series has a history."""
    found = shown(folder)
    panels = [
        (panel, mine)
        for panel in PANELS
        if (mine := [each for each in found.values() if each.benchmark == panel.benchmark])
    ]
    if not panels:
        return None
    results = stored(folder)
    place = {content["commit_hash"]: i for i, content in enumerate(results)}
    rows = -(-len(panels) // 2)
    figure = new_figure(
        2.25 * rows,
        "Speed and counted work over the commits",
        f"{len(place)} commits of the main line, oldest at the left; gaps: not in the commit",
    )
    days = first_of_days(results)
    for i, (panel, mine) in enumerate(panels):
        axes = figure.add_subplot(rows, 2, i + 1)
        _plot(axes, panel, mine, place)
        axes.set_xticks(list(days), list(days.values()), fontsize=7)
    return figure


def first_of_days(results: list[dict[str, Any]]) -> dict[int, str]:
    """Return the place of the first commit of each day, and the day."""
    found: dict[str, int] = {}
    for i, content in enumerate(results):
        at = datetime.fromtimestamp(content["date"] / 1000, tz=UTC)
        found.setdefault(f"{at.day} {at:%b} {at.year}", i)
    apart = -(-len(results) // 6)  # places between two texts that do not touch
    chosen: dict[int, str] = {}
    for day, i in found.items():
        if not chosen or i - max(chosen) >= apart:
            chosen[i] = day.rpartition(" ")[0]
    return chosen


def _plot(axes: Axes, panel: Panel, mine: list[Series], place: Mapping[str, int]) -> None:
    every = []
    for series in mine:
        name = series.parameters[0] if series.parameters else ""
        colour, marker = COLOURS.get(name) or (style_of(name).colour, style_of(name).marker)
        values = [panel.factor * series.values.get(commit, float("nan")) for commit in place]
        axes.plot(list(place.values()), values, color=colour, marker=marker, ms=3, lw=1, label=name)
        every += [panel.factor * value for value in series.values.values()]
    if min(every) > 0:
        axes.set_yscale("log")
        span = (max(every) / min(every)) ** 0.35  # room for the legend above
        axes.set_ylim(min(every) / 1.3, max(every) * max(1.3, span))
        log_ticks(axes.yaxis, every)
    axes.set_xlim(-1, len(place))
    axes.set_title(panel.title, loc="left", fontsize=10)
    axes.set_ylabel(panel.unit)
    dress(axes)
    if len(mine) > 1:
        axes.legend(frameon=False, fontsize=7, ncols=2, loc="upper center", columnspacing=1)


def has_history(folder: Path = RESULTS) -> bool:
    """Return whether git knows every measured commit, as asv's dashboard needs."""
    known = [
        subprocess.run(
            ["git", "cat-file", "-e", f"{content['commit_hash']}^{{commit}}"],
            cwd=ROOT,
            capture_output=True,
            check=False,
        ).returncode
        == 0
        for content in stored(folder)
    ]
    return len(known) > 0 and all(known)


class PerformanceHistory(SphinxDirective):
    """Insert the picture and the link to the dashboard, if there is a history to show."""

    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(str(RESULTS))
        figure = picture()
        if figure is None:
            return [nodes.paragraph(text="Fewer than two commits are measured.")]
        path = Path(self.env.srcdir) / PICTURE
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(as_png(figure, {"Software": None}))
        found: list[nodes.Node] = [
            nodes.image(uri=PICTURE, alt="Speed and counted work over the commits"),
            nodes.paragraph(text=noise_sentence()),
        ]
        if dashboard_possible():
            paragraph = nodes.paragraph()
            target = f"{DASHBOARD}/index.html"
            paragraph += nodes.reference(text="Open the dashboard of asv", refuri=target)
            paragraph += nodes.Text(": every quantity, commit by commit. It reads files by ")
            paragraph += nodes.Text("script, which browsers refuse from disk. So serve the site: ")
            paragraph += nodes.literal(text=SERVE)
            paragraph += nodes.Text(f", then http://localhost:8000/{target}.")
            found.append(paragraph)
        return found


def noise_sentence(folder: Path = RESULTS) -> str:
    """State how much neighbouring commits differ in the times of the picture."""
    times = [panel.benchmark for panel in PANELS if panel.unit.startswith("CPU")]
    changes = [scatter(each) for each in shown(folder).values() if each.benchmark in times]
    if not changes:
        return "No times were measured on two commits."
    return (
        f"Times of neighbouring commits differ by {100 * statistics.median(changes):.0f} % "
        "in the median: smaller steps mean nothing."
    )


def dashboard_possible() -> bool:
    return find_spec("asv") is not None and has_history()


def _publish(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html" and shown() and dashboard_possible():
        publish_history(Path(app.outdir) / DASHBOARD)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("performance-history", PerformanceHistory)
    app.connect("build-finished", _publish)
    return {"parallel_read_safe": True}
