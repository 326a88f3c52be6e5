"""Trained weights that the suite ships: what binds them, and runs that use or refuse them."""

from __future__ import annotations

import io
import json
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import mor_bench
from mor_bench.digests import digest_of_file
from mor_bench.results.row import Row
from mor_bench.runs.cached_fit import RunEnvironment
from mor_bench.runs.code_digest import bare_code, learning_digest
from mor_bench.runs.configurations import configurations_of
from mor_bench.runs.plan import plan
from mor_bench.runs.shipped_models import Binding, SampleSketch, shipped_models
from mor_bench.runs.training_data import TrainingData
from mor_bench.snapshots.dataset import Snapshots, load_dataset
from mor_bench.specs import DatasetSpec, load_dataset_spec, load_method_spec
from tests.benchmarks.train_shipped import DATASET, ITERATIONS, ROOT, ship
from tests.small_runs import short_timing

RETRAIN = "run `python -m tests.benchmarks.train_shipped` and commit the folder `trained`"


def test_shipped_weights_agree_with_the_code_the_parameters_and_the_split() -> None:
    models = shipped_models()
    spec = load_dataset_spec(DATASET)
    assert isinstance(spec, DatasetSpec)
    assert {path.stem for path in models} == {f"{method}-{DATASET}" for method in ITERATIONS}
    for weights, model in models.items():
        configuration = configurations_of([load_method_spec(model.fit.method)], "quick")[0]
        assert Binding.of(configuration, spec) == model.binding, RETRAIN
        assert digest_of_file(weights) == model.fit.model_sha256
        assert weights.stat().st_size < 1.5e6


@pytest.mark.slow
def test_the_code_of_the_named_commit_trained_the_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for weights, model in shipped_models().items():
        assert model.fit.trained_elsewhere
        commit = model.fit.trained_elsewhere.commit
        tree = tmp_path / weights.stem
        tree.mkdir()
        asked = ["git", "-C", str(ROOT), "archive", str(commit), "mor_bench"]
        packed = subprocess.run(asked, capture_output=True, check=False)
        if packed.returncode:
            pytest.skip("the history is not here")
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
            archive.extractall(tree, filter="data")
        monkeypatch.setattr("mor_bench.runs.code_digest.SOURCES", tree)
        assert learning_digest(model.binding.surrogate) == model.binding.code


@pytest.mark.slow
def test_shipped_weights_agree_with_the_samples(cache: Path, tmp_path: Path) -> None:
    data = TrainingData.of(load_dataset(DATASET, cache=cache), tmp_path)
    assert all(model.agrees_with(data) for model in shipped_models().values()), RETRAIN


def test_comments_docstrings_and_blank_lines_are_no_code() -> None:
    plain = "def f(x):\n    return x + 1\n"
    explained = '"""Module."""\n\n# why\ndef f(x):\n    """Add."""\n    return x + 1  # one\n'
    assert bare_code(explained) == bare_code(plain)
    assert bare_code(plain.replace("1", "2")) != bare_code(plain)
    assert "# no comment" in bare_code('x = "# no comment"\n')


@pytest.fixture(scope="module")
def samples() -> Snapshots:
    return load_dataset("beam-tiny", 40).train


def test_a_sketch_ignores_rounding_and_sees_other_samples(samples: Snapshots) -> None:
    sketch = SampleSketch.of(samples)
    rounded = np.array(sketch.sums) * (1 + 1e-9)
    assert sketch.agrees(sketch.model_copy(update={"sums": rounded.tolist()}))
    for i in range(len(sketch.sums)):
        sums = list(sketch.sums)
        sums[i] *= 1.001
        assert not sketch.agrees(sketch.model_copy(update={"sums": sums}))
    assert not sketch.agrees(SampleSketch.of(samples[: len(samples) - 1]))
    swapped = np.arange(len(samples))
    swapped[:2] = 1, 0
    assert not sketch.agrees(SampleSketch.of(samples[swapped]))


@pytest.fixture
def trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Ship a network for beam-tiny that was trained for a moment; return its weights."""
    monkeypatch.setattr("mor_bench.runs.shipped_models.FOLDER", str(tmp_path / "trained"))
    environment = RunEnvironment(tmp_path / "cache")
    return ship("umesh-linear", "beam-tiny", 20, tmp_path / "trained", environment)


def _row(tmp_path: Path, out: str, **options: Any) -> Row:
    """Run the network on beam-tiny, with too little time to train it."""
    with short_timing():
        comparison = mor_bench.run(
            ["beam-tiny"],
            ["umesh-linear"],
            out=tmp_path / out,
            **{"cache": tmp_path / "cache", "time_limit_s": 2.0, **options},
        )
    return comparison.rows[0]


def _planned_as_shipped(tmp_path: Path) -> bool:
    planned = plan(["beam-tiny"], ["umesh-linear"], cache=tmp_path / "cache")
    return any("trained elsewhere" in step.label for step in planned.steps)


@pytest.mark.slow
def test_a_run_uses_shipped_weights_unless_it_shall_train(trained: Path, tmp_path: Path) -> None:
    row = _row(tmp_path, "out")
    assert row.ok, row.reason
    assert row.trained_elsewhere
    assert row.offline_s
    assert row.trained_elsewhere.iterations == row.parameters["iterations"] == 20
    assert row.offline_s.fit_core_s == row.trained_elsewhere.core_s > 0
    assert row.warnings == []
    others: list[dict[str, Any]] = [{"train": True}, {"split": "sample"}]
    for number, options in enumerate(others):
        other = _row(tmp_path, f"out{number}", **options)
        assert other.trained_elsewhere is None
        assert other.status == "failed"  # the training needs more than two seconds
        assert other.parameters["iterations"] == 4500


@pytest.mark.slow
def test_damaged_and_forged_weights_are_refused_with_a_warning(
    trained: Path, tmp_path: Path
) -> None:
    assert _planned_as_shipped(tmp_path)
    whole = trained.read_bytes()
    trained.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert not _planned_as_shipped(tmp_path)
    row = _row(tmp_path, "damaged")
    assert row.trained_elsewhere is None
    [warning] = row.warnings
    assert "checksum" in warning
    assert "trained here" in warning
    trained.write_bytes(whole)
    arrays = load_file(trained)
    name = next(name for name in arrays if name.startswith("network."))
    arrays[name] = np.full_like(arrays[name], np.nan)
    save_file(arrays, trained, {"format": "mor-bench surrogate"})
    record = trained.with_suffix(".json")
    content = json.loads(record.read_text())
    content["fit"]["model_sha256"] = digest_of_file(trained)
    record.write_text(json.dumps(content))
    row = _row(tmp_path, "forged")
    assert row.trained_elsewhere is None
    assert len(row.warnings) == 1
    record.write_text("{}")
    [warning] = _row(tmp_path, "broken").warnings
    assert "key `binding` is missing" in warning


def test_a_record_is_written_and_read_unchanged(tmp_path: Path) -> None:
    shipped = shipped_models()
    for weights, model in shipped.items():
        model.write(weights, tmp_path / weights.stem)
    again = shipped_models(tmp_path)
    assert {path.name: model for path, model in again.items()} == {
        path.name: model for path, model in shipped.items()
    }
