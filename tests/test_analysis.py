"""What a comparison says: intervals, pairs of methods, break-even, profiles, against numbers worked out by hand or simulated."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.analysis.analyse import (
    analyse,
    break_even,
    hidden,
    profile,
    regimes,
    share_within,
    tuning,
)
from mor_bench.analysis.frontier import (
    EXACT,
    TARGET_ERRORS,
    TARGET_TIMES_MS,
    Point,
    compare,
    error_at_time,
    frontier_draws,
    time_at_error,
)
from mor_bench.report.summary import entries_of
from mor_bench.results import row as results_row
from mor_bench.results.comparison import Comparison
from tests.synthetic import (
    METHODS,
    N_PROCESSES,
    N_ROUNDS,
    add_configuration,
    region_errors,
    synthetic_comparison,
    timings,
)

Row = dict[str, Any]


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return synthetic_comparison(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def analysis(comparison: Comparison) -> dict[str, Any]:
    return analyse(comparison, n_resamples=500)


def empty(
    out: Path, n_regions: int = 13, per_region: int = 20
) -> tuple[Comparison, np.ndarray[Any, np.dtype[np.int64]]]:
    """A comparison without rows, and the load region of each of its test samples."""
    made = Comparison(out, {})
    regions = np.repeat(np.arange(n_regions), per_region)[:, None]
    made.add_dataset("d", {"needs": {"error": 0.02, "latency_ms": 1.0}}, {"test_regions": regions})
    return made, regions


def pair(analysis: dict[str, Any], a: str, b: str, target: float) -> Row:
    """The record of an ordered pair of methods at an error."""
    return next(
        r
        for r in analysis["pairwise"]
        if (r["a"], r["b"], r["target_rel_l2_median"]) == (a, b, target)
    )


def test_draws_of_the_frontier_are_its_points_of_each_resample() -> None:
    generator = np.random.default_rng(0)
    for n_configurations in (1, 2, 5, 12):
        latencies = generator.normal(0, 1.5, (n_configurations, 60)).round(
            1
        )  # rounded, so that there are ties
        errors = generator.normal(-4, 2, (n_configurations, 60)).round(1)
        errors[generator.random(errors.shape) < 0.1] = np.inf
        errors[generator.random(errors.shape) < 0.05] = np.log(EXACT)
        at_error, at_time = frontier_draws(latencies, errors, TARGET_ERRORS, TARGET_TIMES_MS)
        for i in range(60):
            points = [
                Point(float(np.exp(t)), float(np.exp(e)), "")
                for t, e in zip(latencies[:, i], errors[:, i], strict=True)
            ]
            expected = [time_at_error(points, target)["latency_ms"] for target in TARGET_ERRORS]
            assert np.exp(at_error[:, i]) == pytest.approx(
                [np.inf if t is None else t for t in expected]
            )
            expected = [error_at_time(points, target)["error"] for target in TARGET_TIMES_MS]
            assert np.exp(at_time[:, i]) == pytest.approx(
                [np.inf if e is None else e for e in expected]
            )


def test_it_is_json_repeatable_and_leaves_its_input_alone(
    comparison: Comparison, analysis: dict[str, Any]
) -> None:
    rows = copy.deepcopy(comparison.rows)
    again = analyse(comparison, n_resamples=500)
    assert json.dumps(again, allow_nan=False) == json.dumps(analysis, allow_nan=False)
    assert comparison.rows == rows
    assert analyse(comparison, n_resamples=500, seed=1)["rows"] != analysis["rows"]
    plain = compare(comparison.rows)
    for kind in (
        "time_at_error",
        "error_at_time",
    ):  # the fields there were, with the values that they had
        assert [
            {key: record[key] for key in old}
            for record, old in zip(analysis[kind], plain[kind], strict=True)
        ] == plain[kind]


def test_every_headline_has_an_interval_around_it(
    comparison: Comparison, analysis: dict[str, Any]
) -> None:
    assert len(analysis["rows"]) == len(comparison.rows)
    for record, row in zip(analysis["rows"], comparison.rows, strict=True):
        assert record["label"] == row["label"]
        assert record["rel_l2_median"]["value"] == row["error"]["rel_l2_median"]
        for name in ("rel_l2_median", "mean_dof_m", "latency_ms"):
            assert record[name]["low"] < record[name]["value"] < record[name]["high"]
        assert 1.05 < record["rel_l2_median"]["high"] / record["rel_l2_median"]["low"] < 2.5
        assert 1.02 < record["latency_ms"]["high"] / record["latency_ms"]["low"] < 1.3
    assert analysis["clusters"] == [{"dataset": "beam-coarse", "of": "load regions", "n": 13}]
    assert analysis["timing"][0]["n_processes"] == 5
    assert analysis["timing"][0]["specific"] == pytest.approx(0.014, rel=0.3)
    assert 0 < analysis["timing"][0]["common"] < 0.02
    entries = entries_of(comparison, "beam-coarse", analysis)
    assert all(
        entry.intervals.keys() == {"rel_l2_median", "mean_dof_m", "latency_ms"} for entry in entries
    )


def test_a_measured_interval_of_the_latency_is_kept(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(0)
    errors = region_errors(generator, regions, 0.01, np.zeros(13))
    row = add_configuration(made, "d", "a", {}, errors, timings(generator, np.zeros((5, 4)), 1.0))
    latency = {**row["latency_ms"], "low": 0.5, "high": 2.0}
    made.rows[0] = results_row.Row(**{**row.as_dict(), "latency_ms": latency})
    found = analyse(made, n_resamples=50)["rows"][0]["latency_ms"]
    assert (found["low"], found["high"]) == (0.5, 2.0)


def test_intervals_of_targets(comparison: Comparison, analysis: dict[str, Any]) -> None:
    for record in analysis["time_at_error"]:
        assert record["exists"] == (record["best"] is not None)
        if record["latency_ms"] is not None:
            assert record["low"] <= record["latency_ms"] <= (record["high"] or np.inf)
        assert (record["high"] is None) == (record["not_reached"] > 0.025)
    far = [
        r
        for r in analysis["time_at_error"]
        if (r["method"], r["target_rel_l2_median"]) == ("linear-fem", 0.01)
    ]
    assert [(r["not_reached"], r["low"], r["high"]) for r in far] == [(1.0, None, None)]
    near = next(
        r
        for r in analysis["time_at_error"]
        if (r["method"], r["target_rel_l2_median"]) == ("linear-fem", 0.1)
    )
    assert 0.025 < near["not_reached"] < 0.975  # its error is 10.5 %, give or take 1.7
    assert near["latency_ms"] is None
    assert near["low"] is not None


def test_pairs_are_antisymmetric_and_tell_who_is_faster(
    comparison: Comparison, analysis: dict[str, Any]
) -> None:
    opposite = {
        "faster": "slower",
        "slower": "faster",
        "undecided": "undecided",
        "not reached": "not reached",
    }
    n = len(METHODS)
    assert len(analysis["pairwise"]) == n * (n - 1) * len(TARGET_ERRORS)
    for record in analysis["pairwise"]:
        back = pair(analysis, record["b"], record["a"], record["target_rel_l2_median"])
        assert back["verdict"] == opposite[record["verdict"]]
        if record["ratio"] is not None:
            assert record["ratio"] * back["ratio"] == pytest.approx(1)
            if record["low"] is not None:
                assert record["low"] <= record["ratio"]
        assert (record["verdict"] == "not reached") == bool(record["by"])
        assert (record["verdict"] == "faster") == (
            record["high"] is not None and record["high"] < 1
        )
    assert pair(analysis, "pca-regression", "fem", 0.03)["verdict"] == "faster"
    assert pair(analysis, "umesh", "hpod", 0.01)["by"] == ["umesh", "hpod"]


def test_the_needed_error_is_among_the_targets(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(0)
    for method in ("a", "b"):
        add_configuration(
            made,
            "d",
            method,
            {},
            region_errors(generator, regions, 0.01, np.zeros(13)),
            timings(generator, np.zeros((5, 4)), 1.0),
        )
    assert {r["target_rel_l2_median"] for r in analyse(made, n_resamples=50)["pairwise"]} == {
        0.02,
        *TARGET_ERRORS,
    }


def test_equal_methods_are_seldom_called_different_and_ten_percent_are_found(
    tmp_path: Path,
) -> None:
    wrong, right = [], []
    for trial in range(6):
        made, regions = empty(tmp_path / str(trial))
        generator = np.random.default_rng(trial)
        errors = region_errors(generator, regions, 0.01, 0.2 * generator.normal(size=13))
        speed = 0.05 * generator.normal(size=(N_PROCESSES, N_ROUNDS))
        for i in range(8):
            add_configuration(made, "d", f"same-{i}", {}, errors, timings(generator, speed, 1.0))
        add_configuration(made, "d", "slow", {}, errors, timings(generator, speed, 1.1))
        found = analyse(made, n_resamples=500)
        wrong += [
            pair(found, f"same-{i}", f"same-{j}", 0.03)["verdict"] != "undecided"
            for i in range(8)
            for j in range(i)
        ]
        right += [pair(found, "slow", f"same-{i}", 0.03)["verdict"] == "slower" for i in range(8)]
    assert np.mean(wrong) <= 0.05
    assert np.mean(right) >= 0.95


def test_what_methods_share_cancels_in_their_ratio(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(1)
    speed, effects = (
        0.1 * generator.normal(size=(N_PROCESSES, 1)) + np.zeros((N_PROCESSES, N_ROUNDS)),
        0.5 * generator.normal(size=13),
    )
    for rank, error, latency in ((5, 0.06, 0.5), (40, 0.01, 4.0)):
        errors = region_errors(generator, regions, error, effects)
        for method, factor in (("a", 1.0), ("b", 1.2)):
            timed = timings(generator, speed, factor * latency, spread=0.005)
            add_configuration(made, "d", method, {"n_modes": rank}, errors, timed)
    found = analyse(made, n_resamples=500)
    alone = next(
        r for r in found["time_at_error"] if (r["method"], r["target_rel_l2_median"]) == ("a", 0.03)
    )
    ratio = pair(found, "b", "a", 0.03)
    assert alone["high"] / alone["low"] > 1.4  # errors and times of each are uncertain ...
    assert (
        ratio["high"] / ratio["low"] < 1.1
    )  # ... but both methods meet the same load regions at the same time
    assert ratio["verdict"] == "slower"
    assert ratio["low"] < 1.2 < ratio["high"]


def test_other_training_seeds_widen_the_interval(tmp_path: Path) -> None:
    widths = []
    for seeds in (None, np.array([0.6, 1.0, 1.6])):
        made, regions = empty(tmp_path / str(seeds is None))
        generator = np.random.default_rng(2)
        errors = region_errors(generator, regions, 0.01, np.zeros(13))
        timed = timings(generator, np.zeros((5, 4)), 1.0)
        more = {} if seeds is None else {"seeds_relative_l2": seeds[:, None] * errors.relative_l2}
        add_configuration(made, "d", "a", {}, errors, {**timed, **more})
        found = analyse(made, n_resamples=500)["rows"][0]["rel_l2_median"]
        widths.append(found["high"] / found["low"])
    assert widths[0] < 1.3
    assert widths[1] > 2.5


def test_rows_without_samples_failed_samples_and_none_anywhere(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(3)
    errors = region_errors(generator, regions, 0.01, np.zeros(13))
    timed = timings(generator, np.zeros((1, 1)), 1.0)
    failing = replace(
        errors,
        relative_l2=np.where(np.arange(260) % 2, np.inf, errors.relative_l2),
        mean_dof_m=np.full(260, np.inf),
    )
    add_configuration(made, "d", "failing", {}, failing, timed)
    add_configuration(made, "d", "plain", {}, errors, {"latency_ms": timed["latency_ms"]})
    lost = add_configuration(made, "d", "lost", {}, errors, timed)
    made.samples_path(lost).unlink()
    bare = {
        **lost,
        "method": "bare",
        "label": "bare",
        "error": None,
        "latency_ms": None,
        "offline_s": None,
        "hidden": None,
    }
    broken = {"method": "broken", "label": "broken", "status": "failed", "reason": "no memory"}
    for row in (bare, {**bare, **broken}):
        made.put(results_row.Row.model_validate(row))
    found = analyse(made, n_resamples=100)
    json.dumps(found, allow_nan=False)
    by_label = {record["label"]: record for record in found["rows"]}
    assert by_label["failing"]["mean_dof_m"] == {"value": None, "low": None, "high": None}
    assert by_label["lost"]["rel_l2_median"]["low"] is None
    assert (
        by_label["plain"]["latency_ms"]["high"] > 1.05
    )  # one process: a typical spread is assumed
    assert by_label["bare"]["latency_ms"] == {"value": None, "low": None, "high": None}
    assert pair(found, "plain", "broken", 0.1)["by"] == ["broken"]
    assert pair(found, "plain", "lost", 0.1)["verdict"] == "undecided"


def _row(
    method: str,
    label: str,
    error: float,
    latency: float,
    data: float | None = 30.0,
    fit: float = 10.0,
) -> Row:
    return {
        "dataset": "d",
        "method": method,
        "label": label,
        "status": "ok",
        "error": {"rel_l2_median": error},
        "latency_ms": {"median": latency},
        "offline_s": {"data": data, "fit": fit},
        "n_dofs": 600,
        "n_train": 1000,
        "n_test": 100,
        "parameters": {},
        "split": "region",
    }


def test_break_even_by_hand() -> None:
    rows = [
        _row("fem", "loose", 0.005, 1.0, 0.0, 0.0),
        _row("fem", "tight", 1e-9, 2.0, 0.0, 0.0),
        _row("quick", "quick", 0.008, 0.6),
        _row("slow", "slow", 0.008, 1.0),
        _row("exact", "exact", 1e-12, 0.1),
        _row("bought", "bought", 1e-3, 1.5, None),
    ]

    def record(method: str, best: Row | None) -> Row:
        real = best and {
            "label": best["label"],
            "latency_ms": best["latency_ms"]["median"],
            "error": best["error"]["rel_l2_median"],
        }
        return {"dataset": "d", "method": method, "target_rel_l2_median": 0.01, "best": real}

    found = break_even(rows, [record(row["method"], row) for row in rows] + [record("far", None)])
    by_method = {record["method"]: record for record in found}
    assert "fem" not in by_method
    assert by_method["quick"]["queries"] == 100_000  # 40 s over 0.4 ms
    assert by_method["quick"]["fem_label"] == "loose"
    assert by_method["slow"]["verdict"] == "never"
    assert by_method["exact"]["verdict"] == "unknown"  # no full-order configuration is as accurate
    assert by_method["bought"]["fem_label"] == "tight"
    assert by_method["bought"]["verdict"] == "unknown"  # nobody knows what its data cost
    assert by_method["far"]["verdict"] == "not reached"


def test_performance_profile_by_hand() -> None:
    times = {
        ("x", 0.1): (1.0, 2.0),
        ("x", 0.01): (4.0, None),
        ("y", 0.1): (3.0, 1.0),
        ("y", 0.01): (None, None),
    }
    records = [
        {"dataset": dataset, "target_rel_l2_median": target, "method": method, "latency_ms": time}
        for (dataset, target), both in times.items()
        for method, time in zip("ab", both, strict=True)
    ]
    found = profile(records)
    assert (found["n_unsolved"], found["n_datasets"], len(found["problems"])) == (1, 2, 3)
    assert found["factors"] == {"a": [1.0, 1.0, 3.0], "b": [2.0, None, 1.0]}
    assert [
        share_within(found["factors"]["b"], tau) for tau in (1.0, 1.9, 2.0, np.inf)
    ] == pytest.approx([1 / 3, 1 / 3, 2 / 3, 2 / 3])
    assert share_within([], 1.0) == 0.0


def test_regimes_and_tuning(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {}, settings={"budget": {"configurations": 2, "seconds": 15.0}})
    made.rows = [
        _row("a", "a1", 0.1, 1.0),
        _row("a", "a2", 0.1, 1.0),
        {**_row("a", "a3", 0.1, 1.0), "status": "skipped"},
        _row("b", "b", 0.1, 1.0),
    ]
    assert tuning(made)[0] == {
        "dataset": "d",
        "method": "a",
        "configurations": 2,
        "seconds": 20.0,
        "seeds": 1,
        "configurations_allowed": 2,
        "seconds_allowed": 15.0,
    }
    wanted = {"says": "large meshes", "min_dofs": 600, "min_train": None, "gpu": False}
    for change, lacks in (
        ({}, ""),
        ({"min_dofs": 601}, "600 of 601 degrees of freedom"),
        ({"min_train": 1001}, "1,000 of 1,001 training samples"),
        ({"gpu": True}, "no graphics processor"),
        ({"split": "sample"}, "split by region"),
        ({"min_iterations": 5}, "0 of 5 iterations"),
    ):
        made.methods = {"a": {"regime": wanted | change}, "b": {"regime": None}}
        found = regimes(made)
        assert [(record["method"], record["in_regime"]) for record in found] == [
            ("a", not lacks),
            ("b", None),
        ]
        assert found[0]["verdict"] == (
            f"not tested in its regime ({lacks}): large meshes" if lacks else "in its regime"
        )
        assert found[1]["verdict"] == "its file names no regime"
    made.settings["device"] = "gpu"
    made.methods["a"] = {"regime": wanted | {"gpu": True}}
    assert regimes(made)[0]["in_regime"]


def test_a_hidden_set_is_worse_beyond_what_its_size_explains() -> None:
    row = {**_row("a", "a", 0.01, 1.0), "hidden": {"n": 100, "rel_l2_median": 0.0135}}
    sure, unsure = (
        {"a": {"rel_l2_median": (0.009, 0.011)}},
        {"a": {"rel_l2_median": (0.008, 0.0125)}},
    )
    assert hidden([row], "d", sure)[0] | {"limit": None} == {
        "dataset": "d",
        "label": "a",
        "ratio": pytest.approx(1.35),
        "limit": None,
        "worse": True,
    }
    assert hidden([row], "d", unsure)[0]["limit"] == pytest.approx(1.25**2**0.5)
    assert not hidden([row], "d", unsure)[0]["worse"]
    assert not hidden([{**row, "hidden": {"n": 100, "rel_l2_median": 0.0115}}], "d", {})[0]["worse"]
    assert hidden([{**row, "hidden": {"n": 100, "rel_l2_median": np.inf}}], "d", sure)[0] == {
        "dataset": "d",
        "label": "a",
        "ratio": None,
        "limit": pytest.approx(1.2),
        "worse": True,
    }
    exact = {**row, "error": {"rel_l2_median": 0.0}, "hidden": {"n": 100, "rel_l2_median": 0.0}}
    assert not hidden([exact], "d", {"a": {"rel_l2_median": (0.0, 0.0)}})[0]["worse"]
    assert hidden([{**row, "hidden": None}], "d", sure) == []
