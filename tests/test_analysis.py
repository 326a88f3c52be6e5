"""Conclusions of a comparison, against hand-computed or simulated numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.break_even import break_even
from mor_bench.analysis.caveats import hidden, regimes, tuning
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
from mor_bench.analysis.performance_profile import profile, share_within
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import TrainingRecord
from mor_bench.results.row import Row, SetErrors
from tests.synthetic import (
    METHODS,
    N_PROCESSES,
    N_ROUNDS,
    a_row,
    add_configuration,
    changed,
    region_errors,
    synthetic_comparison,
    timings,
)

Record = dict[str, Any]
NO_EFFECTS = np.zeros(13)
STEADY = np.zeros((N_PROCESSES, N_ROUNDS))


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return synthetic_comparison(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def analysis(comparison: Comparison) -> Record:
    return analyse(comparison, n_resamples=300)


def empty(out: Path) -> tuple[Comparison, NDArray[np.int64]]:
    """Return a comparison without rows, and the load region of each of its test samples."""
    made = Comparison(out, {})
    regions = np.repeat(np.arange(13), 20)[:, None]
    needs = {"needs": {"error": 0.02, "latency_ms": 1.0}}
    made.add_dataset("beam-tiny", needs, {"test_regions": regions})
    return made, regions


def pair(analysis: Record, a: str, b: str, target: float) -> Record:
    """Return the record of an ordered pair of methods at an error."""
    wanted = (a, b, target)
    records = analysis["pairwise"]
    return next(r for r in records if (r["a"], r["b"], r["target_rel_l2_median"]) == wanted)


def at_error(analysis: Record, method: str, target: float) -> Record:
    """Return the record of a method's time at an error."""
    records, wanted = analysis["time_at_error"], (method, target)
    return next(r for r in records if (r["method"], r["target_rel_l2_median"]) == wanted)


@pytest.mark.parametrize("n_configurations", [1, 2, 5, 12])
def test_frontier_draws_are_the_frontier_points_of_each_resample(n_configurations: int) -> None:
    generator = np.random.default_rng(n_configurations)
    shape = (n_configurations, 60)
    latencies = generator.normal(0, 1.5, shape).round(1)  # rounded, so that there are ties
    errors = generator.normal(-3, 3, shape).round(1)  # some are worse than answering zero
    errors[generator.random(shape) < 0.1] = np.inf
    errors[generator.random(shape) < 0.05] = np.log(EXACT)
    found_times, found_errors = frontier_draws(latencies, errors, TARGET_ERRORS, TARGET_TIMES_MS)
    for i in range(60):
        both = zip(np.exp(latencies[:, i]), np.exp(errors[:, i]), strict=True)
        points = [Point(float(time), float(error), "") for time, error in both]
        times = [time_at_error(points, target)["latency_ms"] for target in TARGET_ERRORS]
        reached = [error_at_time(points, target)["error"] for target in TARGET_TIMES_MS]
        for found, expected in ((found_times, times), (found_errors, reached)):
            plain = [np.inf if x is None else x for x in expected]
            assert np.exp(found[:, i]) == pytest.approx(plain)


def test_the_analysis_is_valid_json_and_repeatable_and_keeps_the_frontier(
    comparison: Comparison, analysis: Record
) -> None:
    again = analyse(comparison, n_resamples=300)
    assert json.dumps(again, allow_nan=False) == json.dumps(analysis, allow_nan=False)
    assert analyse(comparison, n_resamples=300, seed=1)["rows"] != analysis["rows"]
    for kind, plain in compare(comparison.rows).items():
        for record, old in zip(analysis[kind], plain, strict=True):
            assert record.items() >= old.items()


def test_every_headline_has_an_interval_around_it(comparison: Comparison, analysis: Record) -> None:
    for record, row in zip(analysis["rows"], comparison.rows, strict=True):
        assert row.error is not None
        assert record["label"] == row.label
        assert record["rel_l2_median"]["value"] == row.error.rel_l2_median
        for name, least, most in (
            ("rel_l2_median", 1.05, 2.5),
            ("mean_dof_m", 1.05, 2.5),
            ("latency_ms", 1.02, 1.3),
        ):
            figure = record[name]
            assert figure["low"] < figure["value"] < figure["high"]
            assert least < figure["high"] / figure["low"] < most
    assert analysis["clusters"] == [{"dataset": "beam-coarse", "of": "load regions", "n": 13}]
    (timing,) = analysis["timing"]
    assert timing["n_processes"] == 5
    assert timing["specific"] == pytest.approx(0.014, rel=0.3)
    assert 0 < timing["common"] < 0.02


def test_a_stored_interval_of_the_latency_is_kept(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(0)
    errors = region_errors(generator, regions, 0.01, NO_EFFECTS)
    row = add_configuration(made, a_row("a"), errors, timings(generator, STEADY, 1.0))
    made.put(changed(row, latency_ms={"low": 0.5, "high": 2.0}))
    found = analyse(made, n_resamples=50)
    assert found["rows"][0]["latency_ms"]["low"] == 0.5
    assert found["rows"][0]["latency_ms"]["high"] == 2.0
    assert {r["target_rel_l2_median"] for r in found["time_at_error"]} == {*TARGET_ERRORS}


def test_target_intervals_contain_their_value_or_report_a_target_out_of_reach(
    analysis: Record,
) -> None:
    for record in analysis["time_at_error"]:
        assert (record["latency_ms"] is None) == (record["best"] is None)  # both by the test errors
        assert (record["high"] is None) == (record["not_reached"] > 0.025)
        if record["latency_ms"] is not None:
            assert record["low"] <= record["latency_ms"] <= (record["high"] or np.inf)
    far, near = (at_error(analysis, "linear-fem", target) for target in (0.01, 0.1))
    assert (far["not_reached"], far["low"], far["high"]) == (1.0, None, None)
    assert 0.025 < near["not_reached"] < 0.975  # its error is about 10.5 %
    assert near["latency_ms"] is None
    assert near["low"] is not None


def test_pairs_are_antisymmetric_and_name_the_faster_method(analysis: Record) -> None:
    opposite = {"faster": "slower", "slower": "faster"}
    n = len(METHODS)
    assert len(analysis["pairwise"]) == n * (n - 1) * len(TARGET_ERRORS)
    for record in analysis["pairwise"]:
        back = pair(analysis, record["b"], record["a"], record["target_rel_l2_median"])
        assert back["verdict"] == opposite.get(record["verdict"], record["verdict"])
        assert (record["verdict"] == "not reached") == bool(record["by"])
        faster = record["high"] is not None and record["high"] < 1
        assert (record["verdict"] == "faster") == faster
        for end, other in (("ratio", "ratio"), ("low", "high"), ("high", "low")):
            if record[end] is not None:
                assert record[end] * back[other] == pytest.approx(1)
    assert pair(analysis, "pca-regression", "fem", 0.03)["verdict"] == "faster"
    assert pair(analysis, "umesh", "hpod", 0.01)["by"] == ["umesh", "hpod"]


@pytest.mark.slow
def test_equal_methods_rarely_differ_and_a_difference_of_ten_percent_is_found(
    tmp_path: Path,
) -> None:
    wrong, right = [], []
    for trial in range(6):
        made, regions = empty(tmp_path / str(trial))
        generator = np.random.default_rng(trial)
        errors = region_errors(generator, regions, 0.01, 0.2 * generator.normal(size=13))
        speed = 0.05 * generator.normal(size=(N_PROCESSES, N_ROUNDS))
        names = [f"same-{i}" for i in range(8)]
        for name, latency in (*((name, 1.0) for name in names), ("slow", 1.1)):
            add_configuration(made, a_row(name), errors, timings(generator, speed, latency))
        found = analyse(made, n_resamples=500)
        pairs = [pair(found, a, b, 0.03)["verdict"] for a in names for b in names if a < b]
        wrong += [verdict != "undecided" for verdict in pairs]
        right += [pair(found, "slow", name, 0.03)["verdict"] == "slower" for name in names]
    assert np.mean(wrong) <= 0.05
    assert np.mean(right) >= 0.95


def test_noise_that_methods_share_cancels_in_their_ratio(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(1)
    speed = 0.1 * generator.normal(size=(N_PROCESSES, 1)) + STEADY
    effects = 0.5 * generator.normal(size=13)
    for rank, error, latency in ((5, 0.06, 0.5), (40, 0.01, 4.0)):
        errors = region_errors(generator, regions, error, effects)
        for method, factor in (("a", 1.0), ("b", 1.2)):
            timed = timings(generator, speed, factor * latency, spread=0.005)
            add_configuration(made, a_row(method, {"n_modes": rank}), errors, timed)
    found = analyse(made, n_resamples=500)
    alone, ratio = at_error(found, "a", 0.03), pair(found, "b", "a", 0.03)
    assert alone["high"] / alone["low"] > 1.4
    assert ratio["high"] / ratio["low"] < 1.1
    assert ratio["verdict"] == "slower"
    assert ratio["low"] < 1.2 < ratio["high"]
    targets = {record["target_rel_l2_median"] for record in found["pairwise"]}
    assert targets == {0.02, *TARGET_ERRORS}  # the error that the dataset needs is a target too


def test_other_training_seeds_widen_the_interval(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(2)
    errors = region_errors(generator, regions, 0.01, NO_EFFECTS)
    timed = timings(generator, STEADY, 1.0)
    seeds = np.array([0.6, 1.0, 1.6])[:, None] * errors.relative_l2
    add_configuration(made, a_row("one"), errors, timed)
    add_configuration(made, a_row("four"), errors, {**timed, "seeds_relative_l2": seeds})
    one, four = (row["rel_l2_median"] for row in analyse(made, n_resamples=500)["rows"])
    assert one["high"] / one["low"] < 1.3
    assert four["high"] / four["low"] > 2.5


def test_rows_without_samples_or_figures_have_no_interval(tmp_path: Path) -> None:
    made, regions = empty(tmp_path)
    generator = np.random.default_rng(3)
    errors = region_errors(generator, regions, 0.01, NO_EFFECTS)
    timed = timings(generator, np.zeros((1, 1)), 1.0)
    failing = replace(
        errors,
        relative_l2=np.where(np.arange(260) % 2, np.inf, errors.relative_l2),
        mean_dof_m=np.full(260, np.inf),
    )
    add_configuration(made, a_row("failing"), failing, timed)
    add_configuration(made, a_row("plain"), errors, {"latency_ms": timed["latency_ms"]})
    lost = add_configuration(made, a_row("lost"), errors, timed)
    made.samples_path(lost).unlink()
    made.rows += [a_row("bare"), a_row("broken", status="failed", reason="no memory")]
    found = analyse(made, n_resamples=100)
    json.dumps(found, allow_nan=False)
    by_label = {record["label"]: record for record in found["rows"]}
    nothing = {"value": None, "low": None, "high": None}
    assert by_label["failing"]["mean_dof_m"] == by_label["bare"]["latency_ms"] == nothing
    assert by_label["lost"]["rel_l2_median"]["low"] is None
    # With one process, a typical spread is assumed.
    assert by_label["plain"]["latency_ms"]["high"] > 1.05
    assert pair(found, "plain", "broken", 0.1)["by"] == ["broken"]
    assert pair(found, "plain", "lost", 0.1)["verdict"] == "undecided"


def scored(
    method: str, label: str, error: float, latency_ms: float, data: float | None = 30.0
) -> Row:
    """Return a row with only the figures that hand-computed checks need."""
    return a_row(
        method,
        label=label,
        error={"rel_l2_median": error},
        latency_ms={"median": latency_ms},
        offline_s={"data": data, "fit": 5.0, "fit_core_s": 10.0},
        n_dofs=600,
        n_train=1000,
        n_test=100,
    )


def test_break_even_matches_hand_computed_values() -> None:
    rows = [
        scored("fem", "loose", 0.005, 1.0, 0.0),
        scored("fem", "tight", 1e-9, 2.0, 0.0),
        scored("quick", "quick", 0.008, 0.6),
        scored("slow", "slow", 0.008, 1.0),
        scored("exact", "exact", 1e-12, 0.1),
        scored("bought", "bought", 1e-3, 1.5, None),
    ]
    records = compare(rows)["time_at_error"]
    records += compare([scored("far", "far", 0.5, 1.0)])["time_at_error"]
    at_one_percent = [r for r in records if r["target_rel_l2_median"] == 0.01]
    rows += [
        scored("quick", "other", 0.9, 0.1),
        a_row("quick", label="failed", status="failed", tuning_s=15.0),
        a_row("quick", label="skipped", status="skipped"),
    ]
    found = {record["method"]: record for record in break_even(rows, at_one_percent)}
    assert "fem" not in found
    assert found["quick"]["queries"] == 100_000  # 40 core-seconds over 0.4 ms
    # Data, two fits, and 15 s of a failed fit on two cores like the others: 80 core-seconds.
    assert found["quick"]["queries_with_tuning"] == 200_000
    assert found["quick"]["fem_label"] == "loose"
    assert found["slow"]["verdict"] == "never"
    assert found["exact"]["verdict"] == "unknown"  # no full-order configuration is as accurate
    assert found["bought"]["fem_label"] == "tight"
    assert found["bought"]["verdict"] == "unknown"  # the cost of its data is unknown
    assert found["far"]["verdict"] == "not reached"


def test_a_break_even_counts_all_threads_and_no_training_on_a_gpu() -> None:
    rows = [scored("fem", "fem", 0.005, 1.0, 0.0), scored("quick", "quick", 0.008, 0.6)]
    records = [r for r in compare(rows)["time_at_error"] if r["target_rel_l2_median"] == 0.01]
    two = [row.with_parts(threads=2) for row in rows]
    assert break_even(two, records)[0]["queries"] == 50_000
    on_gpu = [rows[0], rows[1].with_parts(training=TrainingRecord(device="cuda"))]
    found = break_even(on_gpu, records)[0]
    assert (found["verdict"], found["queries"]) == ("unknown", None)
    assert "its fit" in found["reason"]


def test_the_performance_profile_matches_hand_computed_values() -> None:
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
    shares = [share_within(found["factors"]["b"], tau) for tau in (1.0, 1.9, 2.0, np.inf)]
    assert shares == pytest.approx([1 / 3, 1 / 3, 2 / 3, 2 / 3])
    assert share_within([], 1.0) == 0.0


def test_tuning_reports_the_used_and_the_allowed_budget(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {}, settings={"budget": {"configurations": 2, "seconds": 15.0}})
    made.rows = [scored("a", f"a{i}", 0.1, 1.0) for i in range(2)]
    made.rows.append(a_row("a", label="a2", status="skipped"))
    assert tuning(made) == [
        {
            "dataset": "beam-tiny",
            "method": "a",
            "configurations": 2,
            "seconds": 10.0,
            "configurations_allowed": 2,
            "seconds_allowed": 15.0,
        }
    ]


@pytest.mark.parametrize(
    ("regime", "device", "lacks"),
    [
        ({"min_dofs": 600}, "cpu", ""),
        ({"min_dofs": 601}, "cpu", "600 of 601 degrees of freedom"),
        ({"min_train": 1001}, "cpu", "1,000 of 1,001 training samples"),
        ({"min_iterations": 5}, "cpu", "0 of 5 iterations"),
        ({"split": "sample"}, "cpu", "split by region"),
        ({"gpu": True}, "cpu", "no graphics processor"),
        ({"gpu": True}, "cuda", "trained on a graphics processor, but queried on the CPU"),
    ],
)
def test_a_method_is_in_its_regime_only_if_all_its_conditions_hold(
    tmp_path: Path, regime: Record, device: str, lacks: str
) -> None:
    made = Comparison(tmp_path, {}, settings={"device": device})
    made.rows = [scored(name, name, 0.1, 1.0) for name in "ab"]
    made.methods = {"a": {"regime": {"says": "large meshes", **regime}}, "b": {"regime": None}}
    verdict = f"not tested in its regime ({lacks}): large meshes" if lacks else "in its regime"
    assert [(record["in_regime"], record["verdict"]) for record in regimes(made)] == [
        (not lacks, verdict),
        (None, "its file names no regime"),
    ]


@pytest.mark.parametrize(
    ("shipped", "fresh", "interval", "expected"),
    [
        (0.01, 0.0135, (0.009, 0.011), {"worse": True, "ratio": 1.35}),
        (0.01, 0.0135, (0.008, 0.0125), {"worse": False, "limit": 1.25**2**0.5}),
        (0.01, 0.0115, None, {"worse": False, "limit": 1.2}),
        (0.01, np.inf, (0.009, 0.011), {"worse": True, "ratio": None, "limit": 1.2}),
        (0.0, 0.0, (0.0, 0.0), {"worse": False}),
    ],
)
def test_a_hidden_set_is_called_worse_only_beyond_its_sampling_error(
    shipped: float, fresh: float, interval: tuple[float, float] | None, expected: Record
) -> None:
    plain = scored("a", "a", shipped, 1.0)
    row = plain.with_parts(hidden=SetErrors(n=100, rel_l2_median=fresh))
    intervals = {"a": {"rel_l2_median": interval}} if interval else {}
    (record,) = hidden([row, plain], "beam-tiny", intervals)
    assert {key: record[key] for key in expected} == pytest.approx(expected)
