"""Pictures: findings as headings, cut axes, legible and unclipped texts, equal files, rendering."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.verdict import Requirements
from mor_bench.report import rendering
from mor_bench.report.canvas import (
    HASH_SALT,
    NOTE,
    Picture,
    as_png,
    as_svg,
    balanced,
    lay_out,
    length_unit,
    uncut,
    wrapped,
)
from mor_bench.report.entries import entries_of
from mor_bench.report.error_against_deformation import error_against_deformation
from mor_bench.report.error_against_time import error_against_time, fastest
from mor_bench.report.figures import explain_names, pictures_of
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import style_of
from mor_bench.report.notebook import Comparison as Drawing
from mor_bench.report.projection import View
from mor_bench.report.rendering import Look, Shot, render_shots
from mor_bench.report.training_curves import loss_curves
from mor_bench.report.worst_samples import worst_samples
from mor_bench.results.comparison import Comparison
from tests.synthetic import MESH, a_row, changed, synthetic_comparison

BEAM = "beam-coarse"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    made = synthetic_comparison(tmp_path_factory.mktemp("run"), BEAM)
    made.finish(analyse(made, n_resamples=50))
    return made


@pytest.fixture(scope="module")
def pictures(made: Comparison) -> dict[str, Picture]:
    found = pictures_of(made, BEAM, made.analysis or {})
    return {picture.kind: picture for picture in found}


def frontier(rows: Comparison) -> Axes:
    picture = error_against_time(rows, "beam", {})
    assert picture is not None
    return picture.figure.axes[0]


def a_frontier(*points: tuple[str, float, float], mesh: float | None = None) -> Comparison:
    """A comparison with a row per method, error and latency in ms, that needs 1 % and 3 ms."""
    needs = {"needs": {"error": 0.01, "latency_ms": 3.0}}
    rows = [
        a_row(
            method,
            dataset="beam",
            error={"rel_l2_median": error, "mean_dof_m": error},
            latency_ms={"median": latency},
            discretisation_rel_l2=mesh,
        )
        for method, error, latency in points
    ]
    return Comparison(Path(), {}, rows, {"beam": needs})


def test_every_kind_is_drawn_with_its_finding_as_heading(pictures: dict[str, Picture]) -> None:
    assert len(pictures) == 8
    for picture in pictures.values():
        heading = picture.figure.texts[0].get_text().replace("\n", " ")
        assert heading == picture.finding
        assert any(sign.isdigit() for sign in heading)


def test_no_text_is_small_or_clipped(pictures: dict[str, Picture]) -> None:
    for kind, picture in pictures.items():
        figure = picture.figure
        drawn = figure.get_tightbbox(lay_out(figure))  # in inches
        width, height = figure.get_size_inches()
        assert min(drawn.x0, drawn.y0) >= -0.01, kind
        assert drawn.x1 <= width + 0.01, kind
        assert drawn.y1 <= height + 0.01, kind
        texts = [text for text in figure.findobj(Text) if isinstance(text, Text)]
        small = [t.get_text() for t in texts if t.get_text() and float(t.get_fontsize()) < NOTE]
        assert not small, kind


def test_short_names_are_explained_in_the_picture(pictures: dict[str, Picture]) -> None:
    for kind in ("error-against-time", "distributions", "error-against-deformation"):
        figure = pictures[kind].figure
        renderer = lay_out(figure)
        *others, note = figure.texts
        assert "r: number of modes" in note.get_text(), kind
        assert float(note.get_fontsize()) >= NOTE
        place = note.get_window_extent(renderer)
        for text in (*others, *figure.legends):
            assert not place.overlaps(text.get_window_extent(renderer)), kind
        for axes in figure.axes:
            box = axes.get_tightbbox(renderer)
            assert box is None or not place.overlaps(box), kind
    learning = pictures["learning-curves"].figure
    assert not any("r: number" in text.get_text() for text in learning.texts)


PLOTS = {
    "plot_frontier": "error-against-time",
    "plot_error_distribution": "distributions",
    "plot_whole_cost": "whole-cost",
    "plot_learning_curves": "learning-curves",
    "plot_singular_values": "singular-values",
}
"""Each function that draws, and the file that shows the same."""


@pytest.mark.parametrize("name", PLOTS)
def test_the_axes_of_a_notebook_show_what_the_file_shows(
    made: Comparison, pictures: dict[str, Picture], name: str
) -> None:
    ax = Figure().subplots()
    canvas = ax.figure.canvas
    assert getattr(Drawing.of(made), name)(ax) is ax
    assert ax.figure.canvas is canvas
    file = pictures[PLOTS[name]].figure.axes[0]
    drawn, written = ([line.get_xydata() for line in axes.lines] for axes in (ax, file))
    assert drawn
    for mine, other in zip(drawn, written, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_equal_data_give_equal_files(made: Comparison, pictures: dict[str, Picture]) -> None:
    again = error_against_time(made, BEAM, made.analysis or {})
    assert again is not None
    explain_names(again, made, BEAM)
    first = pictures["error-against-time"]
    assert as_svg(again) == as_svg(first)
    assert as_png(again.figure, {}) == as_png(first.figure, {})
    assert HASH_SALT.encode() not in as_svg(again)


def test_colours_belong_to_methods(made: Comparison, pictures: dict[str, Picture]) -> None:
    (axes,) = pictures["error-against-time"].figure.axes
    colours = {to_hex(str(line.get_markerfacecolor())).upper() for line in axes.lines}
    for row in made.rows:
        assert style_of(row.method).colour.upper() in colours or row.method == "linear-fem"


def test_an_outlier_is_cut_off_and_its_value_is_written() -> None:
    made = a_frontier(
        ("wild", 406.0, 1.0), *((f"m{i}", 0.002 * 2**i, 0.1 * 1.5**i) for i in range(6))
    )
    axes = frontier(made)
    assert axes.get_ylim()[1] < 100
    assert any("wild: 40600 %" in text.get_text() for text in axes.texts)
    exact = frontier(a_frontier(("fem", 0.0, 1.0), ("pod", 0.01, 0.5), ("pca", 0.02, 0.1)))
    assert exact.get_ylim()[0] > 0.1
    assert any("fem: 0 %" in text.get_text() for text in exact.texts)


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([1, 2, 3, 4, 5], (1, 5)),
        ([1, 2, 3, 4, 50_000], (1, 4)),
        ([1e-5, 1, 2, 3, 4], (1, 4)),
        ([1, 10, 100, 1000, 10_000], (1, 10_000)),
        ([1, 1e6], (1, 1e6)),
        ([0, 2, np.inf], (2, 2)),
        ([], (1, 1)),
    ],
)
def test_only_lone_values_are_cut_off(values: list[float], ends: tuple[float, float]) -> None:
    assert uncut(values) == pytest.approx(ends)


def test_the_discretisation_error_is_a_band_with_its_value() -> None:
    axes = frontier(a_frontier(("pod", 0.02, 0.5), ("pca", 0.03, 0.1), mesh=0.11))
    assert any("mesh: 11 %" in text.get_text() for text in axes.texts)
    tops = [patch.get_extents().transformed(axes.transData.inverted()).y1 for patch in axes.patches]
    assert pytest.approx(11.0) in tops
    axes = frontier(a_frontier(("pod", 0.02, 0.5), ("pca", 0.03, 0.1)))
    assert not any("mesh" in text.get_text() for text in axes.texts)


def test_unstable_points_are_open() -> None:
    made = a_frontier(("pod", 0.02, 0.5), ("hpod", 0.03, 0.1))
    made.rows[0] = changed(made.rows[0], latency_ms={"stable": False})
    faces = {
        (line.get_marker(), *xy): to_hex(str(line.get_markerfacecolor()))
        for line in frontier(made).lines
        for xy in np.column_stack(line.get_data()).tolist()
    }
    assert faces[style_of("pod").marker, 0.5, 2.0] == "#ffffff"
    assert faces[style_of("hpod").marker, 0.1, 3.0] == style_of("hpod").colour.lower()


def test_the_heading_names_the_choice_of_the_verdict() -> None:
    made = a_frontier(("fem", 0.001, 1.0), ("pca", 0.009, 0.1), ("pod", 0.02, 0.05))
    entries = entries_of(made, "beam")
    needs = Requirements(0.01, 3.0)
    verdict = {"choice": "pca", "runner_up": "fem", "undecided": []}
    said = "pca is fastest below 1 %: 0.1 ms"
    assert fastest(entries, needs, verdict) == f"{said}, 10 times as fast as fem"
    assert fastest(entries, needs, {**verdict, "undecided": ["fem"]}) == (
        f"{said}, not surely faster than fem"
    )
    assert fastest(entries, needs, {}) == said
    assert fastest(entries, needs, {"choice": None}).startswith("No configuration is surely below")
    assert fastest(entries, Requirements(), {}) == "pod is fastest: 0.05 ms"


def test_headings_have_few_lines_of_about_the_same_length() -> None:
    text = "a heading whose last word would stand alone"
    assert balanced(text, 40, len) == ["a heading whose last", "word would stand alone"]
    assert balanced("one line", 40, len) == ["one line"]
    assert balanced("x" * 50 + " y", 40, len) == ["x" * 50, "y"]


def test_no_heading_breaks_between_a_number_and_its_unit(pictures: dict[str, Picture]) -> None:
    text = "Where its mean error is largest, pod errs by up to 1.47 mm, hpod by 20 % in 3 ms"
    for room in range(8, len(text)):
        lines = wrapped(text, room, len)
        assert " ".join(lines) == text
        assert not any(re.match("(mm|%|ms)", line) for line in lines), lines
    heading = pictures["worst-samples"].figure.texts[0].get_text()
    assert re.search(r"\d (mm|µm|m)\b", heading)
    assert not re.search(r"\d\n", heading)


def test_worst_samples_say_which_worst_they_show(pictures: dict[str, Picture]) -> None:
    picture = pictures["worst-samples"]
    assert picture.finding.startswith("Where its mean error e is largest, ")
    assert "the test load with its largest mean error e" in picture.figure.texts[
        1
    ].get_text().replace("\n", " ")
    titles = [axes.get_title(loc="left").split("\n") for axes in picture.figure.axes]
    for _, nodal, relative in (title for title in titles if len(title) == 3):
        assert re.fullmatch(r"up to [\d.e+-]+ (mm|µm|m)", nodal)
        assert re.fullmatch(r"relative L2 error [\d.e+-]+ %", relative)


def test_lengths_are_given_in_units_with_few_digits() -> None:
    assert [length_unit(x)[0] for x in (8.9, 0.46, 0.002, 3e-5)] == ["m", "mm", "mm", "µm"]


def test_labels_cover_neither_marks_nor_each_other() -> None:
    axes = frontier(a_frontier(("pod", 0.02, 0.5), ("hpod", 0.03, 0.1)))
    for text in axes.texts[:]:
        text.remove()
    left_out = annotate(axes, [Note(f"label {i}", [(0.5, 2.0)]) for i in range(60)], [(0.5, 2.0)])
    assert 0 < len(left_out) < 60
    figure = axes.get_figure(root=True)
    assert figure is not None
    renderer = lay_out(figure)
    boxes = [Text.get_window_extent(text, renderer) for text in axes.texts]
    assert len(boxes) == 60 - len(left_out)
    mark = axes.transData.transform((0.5, 2.0))
    for i, box in enumerate(boxes):
        assert not box.contains(*mark)
        assert not any(box.overlaps(other) for other in boxes[:i])


def test_loss_curves_tell_whether_the_loss_still_falls(tmp_path: Path) -> None:
    rows = Comparison(tmp_path, {})
    training = {"seed": 0, "iterations": 100, "loss": 1.0, "device": "cpu"}
    row = a_row("umesh", dataset="beam", training=training)
    rows.put(row, {"loss_curve": np.geomspace(1.0, 1e-4, 100), "validation_curve": np.ones(20)})
    picture = loss_curves(rows, "beam")
    assert picture is not None
    assert picture.finding == "No loss falls by more than 5 % in the last tenth of its training"
    rows.put(row, {"loss_curve": np.geomspace(1.0, 1e-4, 100)})
    picture = loss_curves(rows, "beam")
    assert picture is not None
    assert picture.finding == "The loss of umesh still falls by 61 % at the end"


VIEW = View(-68.0, 20.0)
SHOT = Shot(MESH.points, MESH.points[:, 0], MESH.points, MESH.points)
FRAME = np.array(
    [VIEW.project(MESH.points)[0].min(axis=0), VIEW.project(MESH.points)[0].max(axis=0)]
)
LOOK = Look(MESH.boundary_facets, VIEW, FRAME, (0.1, 4.0), "viridis", 200)


def test_without_pyvista_the_reason_is_given(
    made: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "find_spec", lambda _: None)
    assert render_shots([SHOT], LOOK) == ([], "the extra `viz` is not installed")
    picture = worst_samples(made, BEAM)
    assert picture is not None
    assert picture.caption.endswith("Drawn with matplotlib: the extra `viz` is not installed.")


@pytest.mark.slow
def test_a_renderer_that_hangs_or_fails_gives_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "find_spec", lambda _: object())
    assert render_shots([SHOT], LOOK, 0.01) == ([], "PyVista took more than 0.01 s")
    monkeypatch.setattr(rendering, "PROCESS", "tests.no_such_module")
    images, reason = render_shots([SHOT], LOOK)
    assert not images
    assert "No module named" in reason


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends orphans on Linux only")
def test_a_renderer_ends_with_its_parent(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / rendering.JOB)  # the renderer waits for a job that never comes
    code = (
        "import os, subprocess, sys\n"
        f"job = [{rendering.PROCESS!r}, {str(tmp_path)!r}, str(os.getpid())]\n"
        "child = subprocess.Popen([sys.executable, '-m', *job])\n"
        "print(child.pid, flush=True)\n"
        "child.wait()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout
    child = psutil.Process(int(parent.stdout.readline()))
    time.sleep(3)
    assert child.is_running()
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    psutil.wait_procs([child], timeout=10)
    assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


@pytest.mark.slow
def test_pyvista_renders_what_matplotlib_draws() -> None:
    pytest.importorskip("pyvista", reason="needs the extra `viz`")
    images, reason = render_shots([SHOT, SHOT], LOOK, 300.0)
    assert reason == ""
    for image in images:
        assert image.shape[1] == 200
        colours = image[..., :3].reshape(-1, 3)
        assert len(np.unique(colours.round(1), axis=0)) > 10
        height, width = image.shape[:2]
        dark, light = image[height // 3, width // 8, :3], image[2 * height // 3, -width // 8, :3]
        assert dark[2] > dark[0]  # viridis begins with violet at x = 0 and ends with yellow
        assert light[2] < light[0]
    np.testing.assert_array_equal(images[0], images[1])


def test_pictures_of_errors_say_what_each_method_is_told(tmp_path: Path) -> None:
    made = synthetic_comparison(tmp_path, per_region=4)
    told = {"umesh": "input", "pca-regression-linear": "linear-response"}
    for row in list(made.rows):
        known = {"told": told.get(row.method, "equations")}
        made.put(row.with_parts(reference=row.method == "fem", **known))
    analysis = analyse(made, n_resamples=50)
    for draw in (error_against_time, error_against_deformation):
        picture = draw(made, "beam-coarse", analysis)
        assert picture is not None
        explain_names(picture, made, "beam-coarse")
        note = " ".join(" ".join(text.get_text().split()) for text in picture.figure.texts)
        assert "Told: force only (umesh); force and linear response (pca-regression-linear)" in note
        assert ("; equations, reference (fem)" in note) == (draw is error_against_time)
