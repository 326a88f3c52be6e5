"""Metrics against hand-made numbers, the frontier's rules, and a whole comparison."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import mor_bench
from mor_bench.analysis.frontier import Point, compare, error_at_time, non_dominated, time_at_error
from mor_bench.errors import InvalidInputError, SpecError, StoreError
from mor_bench.machine import pinned_threads
from mor_bench.measure import latency as clock
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.measure.latency import LEAST_QUERIES, MOST_TURN_S
from mor_bench.results.comparison import Comparison
from mor_bench.runs.listener import Listener
from mor_bench.snapshots.generate import generation_seconds
from mor_bench.specs import list_suite, load_generated_spec


def test_metrics_by_hand() -> None:
    reference = np.zeros((2, 2, 3))
    reference[:, 1] = [[3.0, 0.0, 4.0], [0.0, 0.0, 10.0]]
    predicted = reference.copy()
    predicted[0, 1] += [0.0, 3.0, 4.0]
    predicted[1, 0] += [0.0, 0.0, -1.0]
    errors = sample_errors(predicted, reference)
    np.testing.assert_allclose(errors.mean_dof_m, [7 / 6, 1 / 6])
    np.testing.assert_allclose(errors.relative_l2, [1.0, 0.1])
    np.testing.assert_allclose(errors.max_nodal_m, [5.0, 1.0])
    np.testing.assert_allclose(errors.amplitude_m, [5.0, 10.0])
    row = summary(errors)
    assert row["mean_dof_m"] == pytest.approx(4 / 6)
    assert row["std_dof_m"] == pytest.approx(math.sqrt(2 * 0.5**2))
    assert row["max_dof_m"] == pytest.approx(7 / 6)
    assert row["rel_l2_median"] == pytest.approx(0.55)
    assert row["rel_l2_p95"] == row["rel_l2_max"] == pytest.approx(1.0)
    assert row["slope"] == pytest.approx((5 * 7 / 6 + 10 / 6) / 125)


def test_a_missing_prediction_is_an_infinite_error() -> None:
    reference = np.ones((30, 4, 3))
    predicted = reference.copy()
    predicted[7, 2, 1] = np.nan
    row = summary(sample_errors(predicted, reference))
    assert (
        row["mean_dof_m"] == row["max_dof_m"] == row["rel_l2_max"] == row["std_dof_m"] == math.inf
    )
    assert row["rel_l2_median"] == 0.0


POINTS = [
    Point(1.0, 0.1, "a"),
    Point(10.0, 0.01, "b"),
    Point(5.0, 0.2, "dominated"),
    Point(100.0, 0.001, "c"),
    Point(0.5, math.inf, "failed"),
]


def test_frontier_interpolates_in_log_log_and_never_extrapolates() -> None:
    assert [p.label for p in non_dominated(POINTS)] == ["a", "b", "c"]
    middle = time_at_error(POINTS, math.sqrt(0.1 * 0.01))
    assert middle["latency_ms"] == pytest.approx(math.sqrt(10.0))
    assert middle["best"] == {"label": "b", "latency_ms": 10.0, "error": 0.01}
    assert time_at_error(POINTS, 0.5)["latency_ms"] == 1.0
    assert time_at_error(POINTS, 0.0005) == {"latency_ms": None, "best": None}
    assert error_at_time(POINTS, 0.7) == {"error": None, "best": None}
    assert error_at_time(POINTS, math.sqrt(10.0))["error"] == pytest.approx(math.sqrt(0.1 * 0.01))
    assert error_at_time(POINTS, math.sqrt(10.0))["best"]["label"] == "a"
    assert error_at_time(POINTS, 1e6)["error"] == 0.001


@example([(1.0, 1.0000000000000002e-06), (2.0, 1e-06)], 1e-06, 1.0)
@given(
    st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-6, 1.0)), min_size=1, max_size=12),
    st.floats(1e-6, 1.0),
    st.floats(1e-3, 1e3),
)
def test_frontier_stays_between_its_points(
    points: list[tuple[float, float]], error: float, time: float
) -> None:
    cloud = [Point(t, e, str(i)) for i, (t, e) in enumerate(points)]
    front = non_dominated(cloud)
    assert all(
        any(q.latency_ms <= p.latency_ms and q.error <= p.error for q in front) for p in cloud
    )
    at_error = time_at_error(cloud, error)
    if at_error["best"] is None:
        assert min(p.error for p in cloud) > error
    else:
        assert (
            front[0].latency_ms * (1 - 1e-9)
            <= at_error["latency_ms"]
            <= at_error["best"]["latency_ms"] * (1 + 1e-9)
        )
    at_time = error_at_time(cloud, time)
    if at_time["best"] is None:
        assert min(p.latency_ms for p in cloud) > time
    else:
        assert (
            front[-1].error * (1 - 1e-9)
            <= at_time["error"]
            <= at_time["best"]["error"] * (1 + 1e-9)
        )


def test_threads_are_pinned_and_given_back() -> None:
    from threadpoolctl import threadpool_info

    before = [pool["num_threads"] for pool in threadpool_info()]
    with pinned_threads(1):
        assert {pool["num_threads"] for pool in threadpool_info()} == {1}
    assert [pool["num_threads"] for pool in threadpool_info()] == before


@pytest.mark.parametrize("spoil", ["test", "train", "exit"])
def test_a_method_trains_on_the_training_set_and_spoils_only_its_own_row(
    spoil: str, cache: Path, tmp_path: Path
) -> None:
    path, notes = tmp_path / "recorder.toml", tmp_path / "notes.json"
    knobs = f'spoil = "{spoil}"\nnotes = "{notes.as_posix()}"'
    path.write_text(
        f'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Recorder"\n[parameters]\n{knobs}'
    )
    comparison = mor_bench.run(
        ["beam-tiny"], [path, "linear-fem"], out=tmp_path / "out", cache=cache
    )
    alone = mor_bench.run(
        ["beam-tiny"], ["linear-fem"], out=tmp_path / "alone", cache=tmp_path / "another"
    )
    assert comparison.rows[0]["status"] == ("ok" if spoil == "test" else "failed"), comparison.rows[
        0
    ]["reason"]
    assert comparison.rows[1]["error"] == alone.rows[0]["error"]
    data = mor_bench.load_dataset("beam-tiny", cache=cache)
    seen = json.loads(notes.read_text())
    np.testing.assert_array_equal(seen["vectors"], data.train.loads.vectors)
    assert not set(seen["regions"]) & set(data.test.regions)


def test_data_costs_what_its_generation_took_and_only_those_who_learn_from_it(
    cache: Path, tmp_path: Path
) -> None:
    comparison = mor_bench.run(
        ["beam-tiny"], ["linear-fem", "pca-regression"], out=tmp_path / "out", cache=cache
    )
    seconds = generation_seconds(load_generated_spec("beam-tiny"), cache, 170)
    assert seconds is not None
    assert [row["offline_s"]["data"] for row in comparison.rows] == [0.0, seconds, seconds, seconds]


def test_a_stopped_run_goes_on_and_another_run_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        clock, "SAME_SPEED", float("inf")
    )  # timings of a machine that is busy otherwise hold no longer

    class StopError(Exception):
        pass

    def stop(row: dict[str, Any]) -> None:
        if row["label"] == "pod [n_modes=3]":
            raise StopError

    out, cache = tmp_path / "out", tmp_path / "cache"
    arguments: dict[str, Any] = {
        "datasets": ["beam-tiny"],
        "methods": ["linear-fem", "pod"],
        "out": out,
        "cache": cache,
    }
    with pytest.raises(StopError):
        mor_bench.run(**arguments, listener=Listener(fitted=stop))
    begun = Comparison.read(out).rows
    assert [row["label"] for row in begun] == ["linear-fem", "pod [n_modes=1]", "pod [n_modes=3]"]
    fits = {path: path.stat().st_mtime_ns for path in (cache / "fits").glob("*/fit.json")}
    assert len(fits) == 8  # all of a method are fitted before the first of them is scored
    whole = mor_bench.run(**arguments)
    assert len(whole.rows) == 8
    assert all(path.stat().st_mtime_ns == changed for path, changed in fits.items())
    assert [row["error"] for row in whole.rows[:3]] == [row["error"] for row in begun]
    timed = [row["latency_ms"] for row in whole.rows]
    assert [row["latency_ms"] for row in mor_bench.run(**arguments).rows] == timed
    with pytest.raises(InvalidInputError, match="holds a run with other settings"):
        mor_bench.run(**{**arguments, "split": "sample"})
    assert len(Comparison.read(out).rows) == 8


def test_everything_is_checked_before_anything_runs(cache: Path, tmp_path: Path) -> None:
    mine = tmp_path / "pod.toml"
    mine.write_text(
        'title = "t"\nsource = "s"\nsurrogate = "mor_bench.surrogates.pod:PODGalerkin"\n[parameters]\nn_mode = 3'
    )
    out = tmp_path / "out"
    with pytest.raises(SpecError, match="unknown key `n_mode`"):
        mor_bench.run(["beam-tiny"], ["fem", mine], out=out, cache=cache)
    with pytest.raises(InvalidInputError, match="two methods are called 'pod'"):
        mor_bench.run(["beam-tiny"], ["pod", mine], out=out, cache=cache)
    with pytest.raises(InvalidInputError, match="two datasets are called 'beam-tiny'"):
        mor_bench.run(["beam-tiny", "beam-tiny"], ["fem"], out=out, cache=cache)
    assert not out.exists()
    out.write_text("a file")
    with pytest.raises(InvalidInputError, match=r"`out`: .* cannot be written"):
        mor_bench.run(["beam-tiny"], ["fem"], out=out, cache=cache)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Comparison:
    folder = tmp_path_factory.mktemp("methods")
    methods: list[str | Path] = ["fem", "pod"]
    for how in ("crash", "shape", "nan"):
        path = folder / f"broken-{how}.toml"
        path.write_text(
            f'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Broken"\n[parameters]\nhow = "{how}"'
        )
        methods.append(path)
    return mor_bench.run(
        ["beam-tiny"], methods, out=tmp_path_factory.mktemp("out") / "run", cache=cache, threads=1
    )


def test_every_configuration_has_a_row(comparison: Comparison) -> None:
    assert [row["label"] for row in comparison.rows] == [
        *(f"fem [tolerance={t}]" for t in (0.1, 0.01, 0.0001, 1e-08)),
        *(f"pod [n_modes={r}]" for r in (1, 3, 5, 10, 20, 40, 80)),
        "broken-crash",
        "broken-shape",
        "broken-nan",
    ]
    crash, shape, nan = comparison.rows[-3:]
    assert crash["status"] == shape["status"] == "failed"
    assert crash["reason"] == "crashed with ZeroDivisionError: on purpose"
    assert "must return floats of shape" in shape["reason"]
    assert nan["status"] == "ok"
    assert 0 < nan["n_failed"] < nan["n_test"]
    assert nan["error"]["mean_dof_m"] == math.inf


def test_rows_hold_what_the_schema_promises(comparison: Comparison) -> None:
    row = comparison.rows[5]
    assert row["status"] == "ok"
    assert (row["dataset"], row["method"], row["parameters"]["n_modes"]) == ("beam-tiny", "pod", 3)
    assert (row["n_train"], row["n_test"], row["threads"], row["split"]) == (170, 40, 1, "region")
    assert set(row["error"]) == {
        "mean_dof_m",
        "std_dof_m",
        "max_dof_m",
        "rel_l2_median",
        "rel_l2_p95",
        "rel_l2_max",
        "max_nodal_m",
        "slope",
    }
    assert set(row["latency_ms"]) == {
        "median",
        "p95",
        "p99",
        "low",
        "high",
        "gc",
        "n_queries",
        "n_processes",
        "stable",
        "unstable_because",
    }
    assert 0 < row["latency_ms"]["low"] <= row["latency_ms"]["median"] <= row["latency_ms"]["high"]
    assert row["all_threads_ms"]["median"] > 0
    assert set(row["throughput"]) == {"8", "64", "512"}
    assert min(row["memory_bytes"].values()) > 5e7
    assert row["cost"]["element_evaluations"] >= 24
    assert row["offline_s"]["fit"] > 0
    assert row["offline_s"]["data"] > 0
    assert row["model_bytes"] > 8 * 3 * 162
    samples = comparison.samples(row)
    assert len(samples["latency_ms"]) == len(samples["process"]) == len(samples["round"])
    assert len(samples["latency_ms"]) >= LEAST_QUERIES or samples["used"][:, 0].max() > MOST_TURN_S
    assert set(samples["process"]) == {0, 1}
    assert samples["mean_dof_m"].mean() == pytest.approx(row["error"]["mean_dof_m"])
    worst = np.abs(samples["worst_prediction"] - samples["worst_reference"]).mean()
    assert worst == pytest.approx(row["error"]["max_dof_m"])
    assert len(comparison.table) == len(comparison.rows)


def test_more_modes_are_more_accurate(comparison: Comparison) -> None:
    pods = [row["error"]["mean_dof_m"] for row in comparison.rows if row["method"] == "pod"]
    assert pods == sorted(pods, reverse=True)


def test_it_reads_back_as_it_was(comparison: Comparison) -> None:
    again = Comparison.read(comparison.out)
    assert again.rows == json.loads(json.dumps(comparison.rows))
    assert compare(again.rows) == compare(comparison.rows)
    text = (comparison.out / "results.json").read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    reached = {
        (row["method"], row["target_rel_l2_median"]): row["best"]
        for row in compare(comparison.rows)["time_at_error"]
    }
    assert reached["fem", 0.001] is not None
    assert reached["broken-crash", 0.1] is None


def test_the_same_run_gives_the_same_errors_to_the_last_digit(
    comparison: Comparison, cache: Path, tmp_path: Path
) -> None:
    again = mor_bench.run(
        ["beam-tiny"], ["fem", "pod"], out=tmp_path / "again", cache=cache, threads=1
    )
    assert [row["error"] for row in again.rows] == [row["error"] for row in comparison.rows[:11]]


def test_listener_hears_of_every_row(cache: Path, tmp_path: Path) -> None:
    heard: list[str] = []
    listener = Listener(
        starting=lambda dataset, label, number, total: heard.append(f"{number}/{total} {label}"),
        fitted=lambda row: heard.append(f"{row['status']} {row['latency_ms']}"),
        finished=lambda row: heard.append("timed" if row["latency_ms"] else "not"),
    )
    mor_bench.run(
        ["beam-tiny"], ["linear-fem"], out=tmp_path / "out", cache=cache, listener=listener
    )
    assert heard == ["1/1 linear-fem", "ok None", "timed"]


def test_bad_arguments_are_refused_before_anything_runs(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments: list[dict[str, Any]] = [
        {"profile": "fast"},
        {"threads": 0},
        {"threads": 10_000},
        {"jobs": 0},
        {"time_limit_s": 0.0},
        {"memory_limit_bytes": 1.0},
        {"test_seed": 0},
        {"methods": []},
        {"datasets": []},
    ]
    for bad in arguments:
        with pytest.raises(InvalidInputError):
            mor_bench.run(**{"datasets": ["beam-tiny"], "methods": ["fem"], "out": out, **bad})
    with pytest.raises(SpecError):
        mor_bench.run(["beam-tiny"], ["fem", "pood"], out=out)
    assert not out.exists()


def test_reading_a_folder_that_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        Comparison.read(tmp_path)
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(StoreError, match="not a results file"):
        Comparison.read(tmp_path)
    (tmp_path / "results.json").write_text('{"schema_version": 99}')
    with pytest.raises(StoreError, match="schema version 99"):
        Comparison.read(tmp_path)


@pytest.fixture(scope="module")
def tip_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """beam-tiny, of which only the tip's displacements are wanted."""
    path = tmp_path_factory.mktemp("datasets") / "tip.toml"
    path.write_text(
        list_suite("datasets")["beam-tiny"]
        .read_text()
        .replace('outputs    = "all"', 'outputs = "x-max"')
    )
    return path


def test_errors_count_the_wanted_nodes_alone(tip_only: Path, cache: Path, tmp_path: Path) -> None:
    comparison = mor_bench.run(
        [tip_only],
        ["fem", "pod-tensor"],
        out=tmp_path / "run",
        cache=cache,
        threads=1,
        profile="quick",
    )
    data = mor_bench.load_dataset(tip_only, cache=cache)
    tip = data.scene.output_nodes
    assert (data.scene.mesh.points[tip, 0] == data.scene.mesh.points[:, 0].max()).all()
    row = next(row for row in comparison.rows if row["label"] == "pod-tensor [n_modes=10]")
    method = mor_bench.load_method("pod-tensor", n_modes=10).fit(data.scene, data.train)
    predicted, reference = method.predict(data.test.forces), data.test.displacements
    assert np.isnan(np.delete(predicted, tip, axis=1)).all()
    errors = np.abs(predicted[:, tip] - reference[:, tip]).mean(axis=(1, 2))
    assert row["error"]["mean_dof_m"] == pytest.approx(errors.mean(), rel=1e-6)
    assert row["indicator"] is None
    hybrid = (
        mor_bench.load_method("hybrid", steps=2)
        .fit(data.scene, data.train)
        .predict(data.test.forces[:3])
    )
    assert np.isfinite(hybrid).all()


def test_indicated_errors_stand_in_the_row(cache: Path, tmp_path: Path) -> None:
    comparison = mor_bench.run(
        ["beam-tiny"], ["fem", "pod-tensor"], out=tmp_path / "run", cache=cache, threads=1
    )
    for row in comparison.rows:
        if row["method"] == "pod-tensor":
            assert row["indicator"]["n"] > 30
            assert 0.8 < row["indicator"]["ratio_median"] < 1.25
            assert row["indicator"]["rank_correlation"] > 0.8
    assert comparison.rows[3]["label"] == "fem [tolerance=1e-08]"
    assert comparison.rows[3]["indicator"] is None


def test_a_region_of_outputs_without_nodes_is_an_error_of_the_dataset(
    tip_only: Path, tmp_path: Path
) -> None:
    path = tmp_path / "none.toml"
    path.write_text(
        tip_only.read_text().replace(
            '"x-max"\nerror', "{ sphere_m = [[90.0, 0.0, 0.0], 1.0] }\nerror"
        )
    )
    with pytest.raises(SpecError, match="holds no node"):
        mor_bench.load_scene(path)


def test_a_method_without_an_answer_to_some_loads_is_timed_on_all(
    cache: Path, tmp_path: Path
) -> None:
    path = tmp_path / "sometimes.toml"
    path.write_text(
        'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Broken"\n[parameters]\nhow = "sometimes"'
    )
    row = mor_bench.run(["beam-tiny"], [path], out=tmp_path / "run", cache=cache, threads=1).rows[0]
    assert row["status"] == "ok"
    assert 0 < row["n_failed"] < row["n_test"]
    assert row["error"]["rel_l2_max"] == math.inf
    assert row["latency_ms"]["median"] > 0
    assert row["throughput"]["64"] is None
