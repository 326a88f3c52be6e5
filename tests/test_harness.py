"""Comparisons from end to end: rows, errors, resuming, and isolation of methods."""

from __future__ import annotations

import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError, StoreError
from mor_bench.options import FitOptions, Options, RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import ErrorSummary
from mor_bench.results.row import Latency, Row
from mor_bench.runs.listener import Listener
from mor_bench.snapshots.generate import generation_seconds
from mor_bench.specs import list_suite, load_generated_spec
from tests.dask_cluster import Cluster
from tests.small_runs import LIMIT, PLAIN, Heard, method_file, run_small, short_timing

GUIDE = Path(__file__).parents[1] / "docs" / "comparison.md"


def row_of(comparison: Comparison, label: str) -> Row:
    return comparison.row("beam-tiny", label)


def test_every_configuration_has_a_row_and_a_broken_one_gives_its_reason(
    small_run: Comparison,
) -> None:
    assert [row.label for row in small_run.rows] == [
        "linear-fem",
        "pod-swept [n_modes=3]",
        "pod-swept [n_modes=20]",
        *(f"broken-{how}" for how in ("crash", "shape", "sometimes")),
    ]
    crash, shape, sometimes = small_run.rows[-3:]
    assert (crash.status, shape.status) == ("failed", "failed")
    assert str(crash.reason).startswith(
        "crashed with ZeroDivisionError: on purpose (third_party.py"
    )
    assert "must return floats of shape" in str(shape.reason)
    assert sometimes.ok  # a load without a prediction only has an infinite error
    assert 0 < (sometimes.n_failed or 0) < sometimes.n_test
    assert sometimes.error is not None
    assert sometimes.error.mean_dof_m == sometimes.error.rel_l2_max == math.inf
    assert sometimes.latency_ms is not None
    assert sometimes.throughput is not None
    assert sometimes.throughput["64"] is None


def test_a_row_holds_every_figure(small_run: Comparison, cache: Path) -> None:
    row = row_of(small_run, "pod-swept [n_modes=3]")
    assert row.n_train + row.n_validation + row.n_test == LIMIT
    assert (row.threads, row.split) == (1, "region")
    assert row.swept == {"n_modes": 3}
    assert (row.told, row.snapshots, row.reference) == (None, True, False)
    other = row_of(small_run, "linear-fem")
    assert (other.told, other.snapshots, other.reference) == ("linear-response", False, False)
    assert row.error is not None
    not_asked = {
        name
        for name in ErrorSummary.model_fields
        if any(part in name for part in ("reaction", "stress", "tension"))
    }
    assert row.error.model_fields_set == ErrorSummary.model_fields.keys() - not_asked
    assert row.latency_ms is not None
    assert row.latency_ms.model_fields_set == Latency.model_fields.keys()
    assert 0 < (row.latency_ms.low or 0) <= row.latency_ms.median <= (row.latency_ms.high or 0)
    assert row.all_threads_ms is not None
    assert row.all_threads_ms.median > 0
    assert row.throughput is not None
    assert set(row.throughput) == {"8", "64", "512"}
    assert row.memory_bytes is not None
    assert min(row.memory_bytes.fit, row.memory_bytes.predict or 0) > 5e7
    assert row.cost is not None
    assert row.cost["element_evaluations"] >= 24
    assert row.offline_s is not None
    assert row.offline_s.fit > 0
    assert (row.model_bytes or 0) > 8 * 3 * 162
    assert row.offline_s.data == generation_seconds(
        load_generated_spec("beam-tiny"), cache, row.n_train + row.n_validation
    )
    linear = row_of(small_run, "linear-fem").offline_s
    assert linear is not None
    assert linear.data == 0.0  # it does not learn from data


def test_the_figures_of_a_row_follow_from_its_raw_samples(small_run: Comparison) -> None:
    row = row_of(small_run, "pod-swept [n_modes=3]")
    assert row.error is not None
    samples = small_run.samples(row)
    assert len(samples["latency_ms"]) == len(samples["process"]) == len(samples["round"])
    assert set(samples["round"]) == {0, 1, 2}
    assert samples["mean_dof_m"].mean() == pytest.approx(row.error.mean_dof_m)
    assert row.validation is not None
    held = samples["validation_relative_l2"]
    assert len(held) == row.n_validation > 0
    assert np.median(held) == pytest.approx(row.validation.rel_l2_median)
    arrays = small_run.dataset_arrays("beam-tiny")
    assert len(arrays["validation_regions"]) == row.n_validation
    assert not set(arrays["validation_regions"].ravel()) & set(arrays["test_regions"].ravel())
    worst = np.abs(samples["worst_prediction"] - samples["worst_reference"]).mean()
    assert worst == pytest.approx(row.error.max_dof_m)
    middle = int(np.argsort(samples["amplitude_m"])[(row.n_test - 1) // 2])
    found = np.abs(samples["middle_prediction"] - samples["middle_reference"]).mean()
    assert found == pytest.approx(samples["mean_dof_m"][middle])


def test_errors_estimated_from_the_residual_agree_with_measured_ones(small_run: Comparison) -> None:
    errors = []
    for n_modes in (3, 20):
        row = row_of(small_run, f"pod-swept [n_modes={n_modes}]")
        assert row.indicator is not None
        assert 0.8 < row.indicator.ratio_median < 1.25
        assert row.indicator.rank_correlation > 0.8
        assert row.error is not None
        errors.append(row.error.mean_dof_m)
    assert errors[0] > errors[1]


def test_results_of_a_run_read_back_as_they_were(small_run: Comparison) -> None:
    again = Comparison.read(small_run.out)
    assert again.rows == small_run.rows
    assert len(again.table) == len(again.rows)
    text = (small_run.out / "results.json").read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (small_run.out / "comparison.json").exists()


def test_a_listener_receives_every_row(small_run: Comparison, heard: Heard) -> None:
    label = "pod-swept [n_modes=3]"
    mine = [event for event in heard.events if label in event]
    assert mine == [f"start 2/6 {label}", f"fitted {label} None", f"timed {label} True"]


BAD: list[tuple[dict[str, Any], str]] = [
    ({"profile": "fast"}, "`profile` must be 'quick' or 'full'; got 'fast'"),
    ({"threads": 0}, r"`threads` must be an integer in \[1, "),
    ({"threads": 10_000}, r"`threads` must be an integer in \[1, "),
    ({"jobs": 0}, "`jobs` must be an integer"),
    ({"seeds": 0}, r"`seeds` must be an integer in \[1, 100\]; got 0"),
    ({"device": "gpu"}, "`device` must be 'auto' or 'cpu' or 'cuda'; got 'gpu'"),
    ({"fit_seconds": -1.0}, "`fit_seconds` must be a number above 0; got -1.0"),
    ({"fit_seconds": 60.0, "time_limit_s": 50.0}, "`fit_seconds` must be below the 50 s"),
    ({"time_limit_s": 0.0}, "`time_limit_s` must be a number above 0"),
    ({"memory_limit_bytes": 1.0}, "`memory_limit_bytes` must be a number of at least 1e"),
    ({"test_seed": 0}, "`test_seed` must differ from the seed of beam-tiny"),
    ({"sed": 3}, "unknown option `sed`; did you mean 'seeds'?"),
    ({"seeds": True}, r"`seeds` must be an integer in \[1, 100\]; got True"),
    ({"retime": "yes"}, "`retime` must be true or false; got 'yes'"),
    ({"time_limit_s": float("inf")}, "`time_limit_s` must be a number above 0; got inf"),
    ({"methods": "pod"}, "`methods` must be a list of names, such as .'pod'.; got 'pod'"),
    ({"methods": []}, "must each hold at least one name"),
    ({"datasets": []}, "must each hold at least one name"),
    ({"datasets": ["beam-tiny"] * 2}, "two datasets are called 'beam-tiny'"),
]


@pytest.mark.parametrize(("bad", "message"), BAD)
def test_a_bad_option_is_refused_before_anything_runs(
    bad: dict[str, Any], message: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(InvalidInputError, match=message):
        mor_bench.run(**{"datasets": ["beam-tiny"], "methods": ["fem"], "out": out, **bad})
    assert not out.exists()


@pytest.mark.parametrize(
    ("function", "options"), [(mor_bench.run, RunOptions), (mor_bench.fit, FitOptions)]
)
def test_the_docstring_names_every_option(function: Any, options: type[Options]) -> None:
    words = set(re.findall(r"\w+", function.__doc__))
    assert words >= options.model_fields.keys()


def test_method_files_and_the_folder_are_checked_before_anything_runs(
    cache: Path, tmp_path: Path
) -> None:
    mine = method_file(tmp_path, "pod", "mor_bench.surrogates.pod:PODGalerkin", n_mode=3)
    out = tmp_path / "out"
    with pytest.raises(SpecError, match="unknown key `n_mode`"):
        mor_bench.run(["beam-tiny"], ["fem", mine], out=out, cache=cache)
    with pytest.raises(InvalidInputError, match="two methods are called 'pod'"):
        mor_bench.run(["beam-tiny"], ["pod", mine], out=out, cache=cache)
    with pytest.raises(SpecError, match="unknown method 'pood'"):
        mor_bench.run(["beam-tiny"], ["fem", "pood"], out=out)
    assert not out.exists()
    out.write_text("a file")
    with pytest.raises(InvalidInputError, match=r"`out`: .* cannot be written"):
        mor_bench.run(["beam-tiny"], ["fem"], out=out, cache=cache)


@pytest.mark.parametrize("name", ["results.csv", "comparison.json", "report.html", "samples"])
def test_a_folder_with_files_of_someone_else_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(InvalidInputError, match=f"but has a '{name}', which would be overwritten"):
        run_small(["linear-fem"], tmp_path, tmp_path / "cache")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_folder_that_holds_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        Comparison.read(tmp_path)
    for text, message in (("{}", "not a results file"), ('{"schema_version": 99}', "version 99")):
        (tmp_path / "results.json").write_text(text)
        with pytest.raises(StoreError, match=message):
            Comparison.read(tmp_path)


@pytest.mark.slow
def test_a_broken_method_spoils_only_its_row_and_other_errors_keep_every_digit(
    small_run: Comparison, tmp_path: Path
) -> None:
    notes = tmp_path / "__pycache__"  # methods can write here
    notes.mkdir()
    recorders = [
        method_file(
            tmp_path,
            f"recorder-{spoil}",
            "tests.third_party:Recorder",
            spoil=spoil,
            notes=str(notes / f"{spoil}.json"),
        )
        for spoil in ("test", "train", "exit")
    ]
    cache = tmp_path / "cache"
    found = run_small([*recorders, "linear-fem"], tmp_path / "out", cache)
    assert [row.status for row in found.rows] == ["ok", "failed", "failed", "ok"]
    assert found.rows[-1].error == row_of(small_run, "linear-fem").error
    data = mor_bench.load_dataset("beam-tiny", LIMIT, cache=cache)
    for spoil in ("test", "train", "exit"):
        seen = json.loads((notes / f"{spoil}.json").read_text())
        np.testing.assert_array_equal(seen["vectors"], data.train.loads.vectors)
        assert not set(seen["regions"]) & set(data.test.regions)


@pytest.mark.slow
def test_a_stopped_run_resumes_and_another_run_is_refused(tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    def stop(row: Row) -> None:
        if row.label == "pod [n_modes=3]":
            raise StopError

    out, cache = tmp_path / "out", tmp_path / "cache"
    pod = method_file(
        tmp_path, "pod", "mor_bench.surrogates.pod:PODGalerkin", sweep={"n_modes": [1, 3, 5]}
    )
    methods: list[str | Path] = ["linear-fem", pod]
    with pytest.raises(StopError):
        run_small(methods, out, cache, listener=Listener(fitted=stop))
    begun = Comparison.read(out).rows
    assert [row.label for row in begun] == ["linear-fem", "pod [n_modes=1]", "pod [n_modes=3]"]
    fits = {path: path.stat().st_mtime_ns for path in (cache / "fits").glob("*/fit.json")}
    assert len(fits) == 4  # all fits of a method come before its first score
    whole = run_small(methods, out, cache).rows
    assert len(whole) == 4
    assert all(path.stat().st_mtime_ns == changed for path, changed in fits.items())
    assert [row.error for row in whole[:3]] == [row.error for row in begun]
    again = run_small(methods, out, cache).rows
    assert [row.latency_ms for row in again] == [row.latency_ms for row in whole]
    with pytest.raises(
        InvalidInputError, match="holds another run, with `split` = None instead of 'sample'"
    ):
        run_small(methods, out, cache, split="sample")
    assert len(Comparison.read(out).rows) == 4


@pytest.fixture(scope="module")
def tip_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """beam-tiny with outputs at the tip only."""
    path = tmp_path_factory.mktemp("datasets") / "tip.toml"
    text = list_suite("datasets")["beam-tiny"].read_text()
    path.write_text(text.replace('outputs    = "all"', 'outputs = "x-max"'))
    return path


def test_a_region_of_outputs_without_nodes_is_an_error_of_the_dataset(
    tip_only: Path, tmp_path: Path
) -> None:
    path, nowhere = tmp_path / "none.toml", "{ sphere_m = [[90.0, 0.0, 0.0], 1.0] }\nerror"
    path.write_text(tip_only.read_text().replace('"x-max"\nerror', nowhere))
    with pytest.raises(SpecError, match="holds no node"):
        mor_bench.load_scene(path)


@pytest.mark.slow
def test_errors_count_only_the_requested_nodes(tip_only: Path, cache: Path, tmp_path: Path) -> None:
    tensor = "mor_bench.surrogates.pod_tensor:TensorPOD"
    path = method_file(tmp_path, "tensor", tensor, n_modes=10)
    with short_timing():
        run = mor_bench.run([tip_only], [path], out=tmp_path / "run", cache=cache, limit=LIMIT)
    data = mor_bench.load_dataset(tip_only, LIMIT, cache=cache)
    tip = data.scene.output_nodes
    assert (data.scene.mesh.points[tip, 0] == data.scene.mesh.points[:, 0].max()).all()
    method = mor_bench.load_method(path).fit(data.scene, data.train)
    predicted, reference = method.predict(data.test.forces), data.test.displacements
    assert np.isnan(np.delete(predicted, tip, axis=1)).all()
    errors = np.abs(predicted[:, tip] - reference[:, tip]).mean(axis=(1, 2))
    row = run.rows[0]
    assert row.error is not None
    assert row.error.mean_dof_m == pytest.approx(errors.mean(), rel=1e-6)
    assert row.indicator is None
    hybrid = mor_bench.load_method("hybrid", steps=2).fit(data.scene, data.train)
    assert np.isfinite(hybrid.predict(data.test.forces[:3])).all()


@pytest.mark.slow
def test_the_method_of_the_comparison_guide_competes(cache: Path, tmp_path: Path) -> None:
    guide = GUIDE.read_text(encoding="utf-8")
    (script,) = re.findall(r"```python\n# my_method.py\n(.*?)```", guide, re.DOTALL)
    (text,) = re.findall(r"```toml\n# mean.toml\n(.*?)```", guide, re.DOTALL)
    (tmp_path / "my_method.py").write_text(script, encoding="utf-8")
    (tmp_path / "mean.toml").write_text(text, encoding="utf-8")
    comparison = run_small([tmp_path / "mean.toml"], tmp_path / "out", cache)
    labels = [(row.label, row.status) for row in comparison.rows]
    assert labels == [("mean [power=0.5]", "ok"), ("mean [power=1.0]", "ok")]
    assert (comparison.rows[0].model_bytes or 0) > 1000
    assert comparison.rows[0].error is not None
    assert comparison.rows[0].error.rel_l2_median > 0.3


def check_same_errors(rows: list[Row], others: list[Row]) -> None:
    for row, other in zip(rows, others, strict=True):
        assert other.label == row.label
        assert row.error is not None
        assert other.error is not None
        expected = pytest.approx(row.error.rel_l2_median, rel=1e-9)
        assert other.error.rel_l2_median == expected
        assert other.latency_ms is not None


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_several_fits_at_once_give_the_same_errors(plain_run: Comparison, tmp_path: Path) -> None:
    two = run_small(PLAIN, tmp_path / "two", tmp_path / "cache", jobs=2).rows
    check_same_errors(plain_run.rows, two)


@pytest.mark.slow
def test_a_cluster_fits_and_this_machine_times(tmp_path: Path, plain_run: Comparison) -> None:
    with Cluster(tmp_path / "cluster", ("only",)) as cluster:
        options = {"cluster": cluster.address}
        there = run_small(PLAIN, tmp_path / "there", tmp_path / "cache", **options).rows
    check_same_errors(plain_run.rows, there)
