"""Figures, tables and headlines agree with the rows of a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.lines import AxLine
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from mor_bench.report.canvas import Picture, wrapped
from mor_bench.report.entries import entries_of
from mor_bench.report.error_against_deformation import error_against_deformation
from mor_bench.report.error_against_time import error_against_time
from mor_bench.report.error_over_position import error_over_position, median_per_patch
from mor_bench.report.singular_values import SIGMA, TAIL, singular_values, spectrum_of
from mor_bench.report.speed_tables import pairs_at
from mor_bench.results.comparison import Comparison
from tests.synthetic import MESH, a_row

LOW, HIGH = 0.8, 1.5
"""Ends of all intervals, relative to the value."""

SIGMAS = np.array([9.0, 3.0, 2.0, 1.0])


@pytest.fixture
def made(tmp_path: Path) -> Comparison:
    """Two methods on a dataset that needs 2 % within 3 ms."""
    made = Comparison(tmp_path, {})
    needs = {"needs": {"error": 0.02, "latency_ms": 3.0}}
    made.add_dataset("beam", needs, {"singular_values": SIGMAS})
    for rank, error, latency in ((2, 0.01, 1.0), (3, 0.005, 2.0)):
        errors = {"rel_l2_median": error, "rel_l2_p95": 4 * error, "rel_l2_max": 7 * error}
        row = a_row("pod", {"n_modes": rank}, dataset="beam", error=errors)
        made.put(row.model_validate({**row.as_dict(), "latency_ms": {"median": latency}}))
    return made


def intervals(made: Comparison) -> dict[str, object]:
    """Return an analysis that only has intervals."""
    rows = []
    for entry in entries_of(made, "beam"):
        values = {"rel_l2_median": entry.error, "latency_ms": entry.latency_ms, "mean_dof_m": 1e-3}
        ends = {k: {"value": v, "low": LOW * v, "high": HIGH * v} for k, v in values.items()}
        rows.append({"dataset": "beam", "label": entry.label, **ends})
    return {"rows": rows}


def axes_of(picture: Picture | None) -> Axes:
    assert picture is not None
    (axes,) = picture.figure.axes
    return axes


def test_points_bars_and_the_needs_box_are_in_percent_and_ms(made: Comparison) -> None:
    axes = axes_of(error_against_time(made, "beam", intervals(made)))
    rows = [(e.latency_ms, 100 * e.error) for e in entries_of(made, "beam")]
    points = {tuple(xy) for line in axes.lines for xy in np.column_stack(line.get_data())}
    assert points >= set(rows)
    bars = [c.get_segments() for c in axes.collections if isinstance(c, LineCollection)]
    horizontal, vertical = (np.array(segments) for segments in bars)
    for (x, y), flat, upright in zip(rows, horizontal, vertical, strict=True):
        assert flat == pytest.approx(np.array([[LOW * x, y], [HIGH * x, y]]))
        assert upright == pytest.approx(np.array([[x, LOW * y], [x, HIGH * y]]))
    (box,) = (patch for patch in axes.patches if isinstance(patch, Rectangle))
    assert box.get_corners()[2] == pytest.approx((3.0, 2.0))
    assert "≤ 3 ms, ≤ 2 %" in " ".join(text.get_text() for text in axes.texts)
    assert "(ms)" in axes.get_xlabel()
    assert "(%)" in axes.get_ylabel()


def test_singular_values_are_in_percent_and_ranks_stand_in_a_row(made: Comparison) -> None:
    picture = singular_values(made, "beam")
    axes = axes_of(picture)
    curves = {line.get_label(): np.column_stack(line.get_data()) for line in axes.lines}
    left_out = 100 * np.sqrt([(9 + 4 + 1) / 95, (4 + 1) / 95, 1 / 95])
    assert curves[SIGMA][:, 1] == pytest.approx(100 * SIGMAS / 9.0)
    assert curves[TAIL][:, 1] == pytest.approx(left_out)
    assert curves["pod"][:, 0].tolist() == [2, 3]
    assert len(set(curves["pod"][:, 1])) == 1  # in a row at the bottom, not beside a percentage
    assert curves["pod"][0, 1] == pytest.approx(axes.get_ylim()[0])
    assert picture is not None
    assert picture.finding.startswith("At least 4 modes are needed for 2 %")


def test_leading_singular_values_and_the_norm_give_the_whole_energy() -> None:
    values = 0.97 ** np.arange(900.0)
    tail = np.sqrt(1 - np.cumsum(values**2) / (values @ values))
    norm = np.array(np.linalg.norm(values))
    found = spectrum_of({"singular_values": values[:100], "snapshots_norm": norm})
    assert found is not None
    assert found.tail == pytest.approx(tail[:100])
    assert (
        found.finding(0.01)
        == "More than 100 modes are needed for 1 % on the training samples themselves"
    )
    assert (
        found.finding(0.1)
        == "At least 76 modes are needed for 10 % on the training samples themselves"
    )
    assert spectrum_of({"singular_values": values[:400]}) is None  # of an earlier version


def test_the_median_per_patch_counts_a_sample_at_each_of_its_patches() -> None:
    regions = np.array([[0, 2], [2, 4], [0, 4], [2, 4]])
    found = median_per_patch(np.array([1.0, 2.0, 3.0, np.inf]), regions, 6)
    np.testing.assert_array_equal(found, [2.0, np.nan, 2.0, np.nan, 3.0, np.nan])


def test_the_map_of_the_error_has_a_panel_for_the_best_of_each_class(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    centres = MESH.points[MESH.points[:, 2] == 1.0][:6]
    regions = np.array([[0], [0], [3], [4]])
    arrays = {"points": MESH.points, "cells": MESH.cells, "patch_centres": centres}
    made.add_dataset("beam", {}, {**arrays, "test_regions": regions})
    for method, told, e in (("a", "input", 0.2), ("b", "input", 0.1), ("c", "equations", 0.3)):
        row = a_row(method, dataset="beam", told=told, n_test=4, error={"rel_l2_median": e})
        made.put(row, {"relative_l2": 0.1 * e * np.array([1.0, 3.0, 20.0, np.inf])})
    full = a_row("fem", dataset="beam", told="equations", n_test=4, error={"mean_dof_m": 0.0})
    full = full.with_parts(reference=True)
    made.put(full, {"relative_l2": np.full(4, 1e-9)})
    picture = error_over_position(made, "beam")
    assert picture is not None
    assert picture.caption.startswith("b: 2 to 20 %, a factor of 10; most where the load acts")
    panels = [axes for axes in picture.figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left").split("\n")[0] for axes in panels] == ["b", "c"]
    dots, scales = zip(*(_dots(axes) for axes in panels), strict=True)
    assert dots[0] == pytest.approx(np.array([2.0, 20.0]))
    assert dots[1] == pytest.approx(np.array([6.0, 60.0]))
    assert scales[0] == scales[1] == pytest.approx((2.0, 60.0))
    made.add_dataset("beam", {"observed": {"region": "x-max"}}, {**arrays, "test_regions": regions})
    picture = error_over_position(made, "beam")
    assert picture is not None
    assert "told: observed displacements only" in picture.figure.axes[0].get_title(loc="left")
    made.add_dataset("beam", {}, {"test_regions": regions})
    assert error_over_position(made, "beam") is None


def _dots(axes: Axes) -> tuple[NDArray[np.float64], tuple[Any, Any]]:
    """Return the values of a panel's coloured dots in percent, and the ends of their scale."""
    (dots,) = (found for found in axes.collections if isinstance(found, PathCollection))
    return np.asarray(dots.get_array()), (dots.norm.vmin, dots.norm.vmax)


@pytest.mark.parametrize(("dataset", "n_lines"), [("beam-coarse-paper", 2), ("beam-tiny", 1)])
def test_the_slope_of_the_paper_is_drawn_on_its_scenes_only(
    tmp_path: Path, dataset: str, n_lines: int
) -> None:
    made = Comparison(tmp_path, {})
    row = a_row("pod", dataset=dataset, n_test=2, error={"mean_dof_m": 0.002})
    made.put(row, {"amplitude_m": np.array([0.1, 0.3]), "mean_dof_m": np.array([0.001, 0.003])})
    picture = error_against_deformation(made, dataset)
    assert picture is not None
    (axes,) = picture.figure.axes
    slopes = [line.get_slope() for line in axes.lines if isinstance(line, AxLine)]
    assert slopes == pytest.approx([0.01, 0.00352][:n_lines])
    assert ("up to 0.724 m" in picture.caption) == (n_lines == 2)


@pytest.mark.parametrize(
    ("verdict", "ratio", "low", "high", "cell", "interval"),
    [
        ("undecided", 0.8, 0.5, 1.25, "?+1.25", "0.8–2"),
        ("undecided", 0.8, 0.5, None, "?+1.25", "0–2"),
        ("undecided", 1.25, 0.8, 2.0, "?-1.25", "0.8–2"),
        ("undecided", 1.25, None, None, "?-1.25", "no interval"),
        ("faster", 0.5, 0.4, 0.8, "+2", "1.25–2.5"),
        ("faster", 0.5, None, 0.8, "+2", "1.25–∞"),
        ("slower", 2.0, 1.6, 2.5, "-2", "1.6–2.5"),
    ],
)
def test_inverting_a_pair_inverts_its_factor_and_its_interval(
    verdict: str, ratio: float, low: float | None, high: float | None, cell: str, interval: str
) -> None:
    made = Comparison(Path(), {}, rows=[a_row("a"), a_row("b")])
    record = {"dataset": "beam-tiny", "target_rel_l2_median": 0.01, "by": [], "verdict": verdict}
    record |= {"ratio": ratio, "low": low, "high": high}
    both = [{**record, "a": "a", "b": "b"}, {**record, "a": "b", "b": "a"}]
    pairs = pairs_at(made, "beam-tiny", 0.01, {"pairwise": both})
    assert (pairs.cells[0][1], pairs.intervals[0][1]) == (cell, interval)


def test_no_line_of_a_title_ends_within_a_name_or_before_a_unit() -> None:
    lines = wrapped("The error of pca-regression-linear · k10 is 5 %", 30, len)
    assert lines == ["The error of", "pca-regression-linear · k10 is", "5 %"]
