"""Error metrics, range flags and frontiers against hand-computed numbers."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_info

from mor_bench.analysis.frontier import Point, error_at_time, non_dominated, time_at_error
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.measure.range_flags import flags_of


def test_error_metrics_match_hand_computed_values() -> None:
    reference = np.zeros((2, 2, 3))
    reference[:, 1] = [[3.0, 0.0, 4.0], [0.0, 0.0, 10.0]]
    predicted = reference.copy()
    predicted[0, 1] += [0.0, 3.0, 4.0]
    predicted[1, 0] += [0.0, 0.0, -1.0]
    errors = sample_errors(predicted, reference, fixed_nodes=np.array([0]))
    np.testing.assert_allclose(errors.mean_dof_m, [7 / 6, 1 / 6])
    np.testing.assert_allclose(errors.mean_free_dof_m, [7 / 3, 0.0])
    np.testing.assert_allclose(errors.relative_l2, [1.0, 0.1])
    np.testing.assert_allclose(errors.max_nodal_m, [5.0, 1.0])
    np.testing.assert_allclose(errors.amplitude_m, [5.0, 10.0])
    np.testing.assert_allclose(errors.tip_m, [5.0, 0.0])
    np.testing.assert_allclose(errors.tip_relative, [1.0, 0.0])
    assert summary(errors) == pytest.approx(
        {
            "mean_dof_m": 4 / 6,
            "std_dof_m": math.sqrt(2 * 0.5**2),
            "max_dof_m": 7 / 6,
            "mean_free_dof_m": 7 / 6,
            "rel_l2_median": 0.55,
            "rel_l2_p95": 1.0,
            "rel_l2_max": 1.0,
            "max_nodal_m": 5.0,
            "slope": (5 * 7 / 6 + 10 / 6) / 125,
            "amplitude_m": 10.0,
            "tip_max_m": 5.0,
            "tip_rel_median": 0.5,
            "tip_rel_p95": 1.0,
            "tip_rel_max": 1.0,
            "tip_rel_at_max_e": 1.0,
            "tip_rel_at_largest": 0.0,
        }
    )


def test_the_tip_and_the_free_dofs_are_among_the_wanted_nodes() -> None:
    """Node 2 moves most of all, node 1 most of the wanted ones, and node 0 is a support."""
    reference, predicted = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    reference[0, :, 0] = 0.0, 2.0, 8.0
    predicted[0, :, 0] = 0.3, 2.5, 9.0
    supports, wanted = np.array([0]), np.array([0, 1])
    errors = sample_errors(predicted, reference, wanted, supports)
    assert (errors.amplitude_m[0], errors.tip_m[0]) == (2.0, 0.5)
    assert errors.tip_relative[0] == 0.25
    assert errors.mean_dof_m[0] == pytest.approx(0.8 / 6)
    assert errors.mean_free_dof_m[0] == pytest.approx(0.5 / 3)
    assert sample_errors(predicted, reference, None, supports).tip_m[0] == 1.0


def test_a_missing_prediction_has_an_infinite_error() -> None:
    reference = np.ones((30, 4, 3))
    predicted = reference.copy()
    predicted[7, 2, 1] = np.nan
    found = summary(sample_errors(predicted, reference))
    infinite = {name for name, value in found.items() if value == math.inf}
    assert infinite >= {"mean_dof_m", "max_dof_m", "rel_l2_max", "std_dof_m"}
    assert infinite >= {"mean_free_dof_m", "tip_max_m", "tip_rel_max", "tip_rel_at_max_e"}
    assert found["rel_l2_median"] == 0.0


POINTS = [
    Point(1.0, 0.1, "a"),
    Point(10.0, 0.01, "b"),
    Point(5.0, 0.2, "dominated"),
    Point(100.0, 0.001, "c"),
    Point(0.5, math.inf, "failed"),
]


def test_the_selected_configuration_is_one_that_was_measured() -> None:
    assert [point.label for point in non_dominated(POINTS)] == ["a", "b", "c"]
    middle = time_at_error(POINTS, 0.03)
    best = {"label": "b", "latency_ms": 10.0, "error": 0.01, "bound": None}
    assert middle == {"latency_ms": 10.0, "best": best}
    assert time_at_error(POINTS, 0.5)["latency_ms"] == 1.0
    assert time_at_error(POINTS, 0.0005) == {"latency_ms": None, "best": None}
    assert error_at_time(POINTS, 0.7) == {"error": None, "best": None}
    between = error_at_time(POINTS, 3.0)
    assert (between["error"], between["best"]["label"]) == (0.1, "a")
    assert error_at_time(POINTS, 1e6)["error"] == 0.001


def test_answers_worse_than_zero_are_on_no_front() -> None:
    useless = [Point(0.1, 1.0, "zero"), Point(0.2, 40.0, "wild")]
    assert non_dominated([*useless, *POINTS]) == non_dominated(POINTS)
    assert time_at_error(useless, 100.0) == {"latency_ms": None, "best": None}
    assert error_at_time(useless, 1.0) == {"error": None, "best": None}


def test_of_errors_that_differ_in_round_off_the_faster_one_is_chosen() -> None:
    same = [Point(2.0, 0.01, "large", 0.02 - 1e-12), Point(1.0, 0.01, "small", 0.02)]
    for points in (same, same[::-1]):
        found = error_at_time(points, 3.0)["best"]
        assert found is not None
        assert found["label"] == "small"


def test_validation_selects_and_the_errors_are_those_of_the_test() -> None:
    points = [
        Point(1.0, 0.04, "fast", 0.02),
        Point(2.0, 0.012, "selected", 0.008),
        Point(2.5, 0.004, "lucky on the test", 0.009),
        Point(8.0, 0.003, "slow", 0.002),
    ]
    assert [p.label for p in non_dominated(points)] == ["fast", "selected", "slow"]
    assert time_at_error(points, 0.006)["latency_ms"] == 8.0
    best = {"label": "selected", "latency_ms": 2.0, "error": 0.012, "bound": 0.008}
    assert time_at_error(points, 0.01) == {"latency_ms": 2.0, "best": best}
    assert error_at_time(points, 4.0) == {"error": 0.012, "best": best}
    assert time_at_error([points[0]], 0.01) == {"latency_ms": None, "best": None}


@given(
    st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-6, 0.99)), min_size=1, max_size=12),
    st.floats(1e-6, 1.0),
    st.floats(1e-3, 1e3),
)
def test_no_other_configuration_is_better_for_a_target(
    points: list[tuple[float, float]], error: float, latency: float
) -> None:
    cloud = [Point(t, e, str(i)) for i, (t, e) in enumerate(points)]
    times = [t for t, e in points if e <= error]
    errors = [e for t, e in points if t <= latency]
    assert time_at_error(cloud, error)["latency_ms"] == min(times, default=None)
    assert error_at_time(cloud, latency)["error"] == min(errors, default=None)


def test_threads_are_pinned_and_then_restored() -> None:
    before = [pool["num_threads"] for pool in threadpool_info()]
    with pinned_threads(1):
        assert {pool["num_threads"] for pool in threadpool_info()} == {1}
    assert [pool["num_threads"] for pool in threadpool_info()] == before


def test_torch_has_the_pinned_number_of_threads_even_if_it_is_imported_later() -> None:
    pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    program = """
import os
from mor_bench.machine import pinned_threads, usable_cores
with pinned_threads(1):
    import torch
    print(torch.get_num_threads())
print(torch.get_num_threads() - usable_cores(), os.environ.get("OMP_NUM_THREADS"))
"""
    usual = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env=usual, check=True, capture_output=True, text=True).stdout
    assert said.split() == ["1", "0", "None"]


def test_the_recall_of_range_flags_matches_hand_computed_values() -> None:
    usual = {"relative_l2": np.linspace(0.01, 0.2, 20), "flagged": np.arange(20) == 3}
    far = {
        "relative_l2": np.array([0.3, 0.25, 0.1, math.inf, 0.195]),
        "flagged": np.array([True, False, True, True, True]),
    }
    flags = flags_of({"test": far, "in-range": usual})
    assert flags is not None
    assert flags.usual_rel_l2 == pytest.approx(0.2)
    counts = {"n_unusual": 3, "n_unusual_flagged": 2, "recall": 2 / 3}
    assert flags.of(far) == counts
    assert flags.as_dict(far)["false_alarms"] == 1 / 20
    assert flags.as_dict(far)["test"] == {"n": 5, "n_flagged": 4, **counts}
    assert flags.of(usual)["recall"] is None
    assert flags_of({"test": far, "in-range": {"relative_l2": far["relative_l2"]}}) is None
    main_only = flags_of({"test": far})
    assert main_only is not None
    assert (main_only.in_range, main_only.usual_rel_l2) == ("test", math.inf)
    assert main_only.of(far)["n_unusual"] == 0
