"""Trained methods in a comparison: given seconds, seeds, checkpoints and loss curves."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from html import unescape
from math import inf
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import mor_bench
from mor_bench.report.console_tables import Detail, print_tables
from mor_bench.report.number_format import joined_units
from mor_bench.report.page import render
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.configurations import Configuration
from mor_bench.runs.fitting import fit_configuration
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.process import MethodFailedError
from mor_bench.specs import load_method_spec
from mor_bench.training_options import TrainingOptions
from tests.small_runs import COMMAND, LIMIT, descent_file, method_file, run_small, wait_for

OUT_OF_TIME = "OutOfTimeError: all iterations would take {} h; the limit is"


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of this module alone, because tests count cached fits."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory, own_cache: Path) -> Comparison:
    """Trainings of 0.7 s, or 70 iterations, with three seeds.

    Training with seed 1 fails. With 100 channels a training is out of time.
    """
    folder = tmp_path_factory.mktemp("descent")
    path = descent_file(folder, {"channels": [1, 100]}, fails=1)
    out = folder / "run"
    return run_small([path, "linear-fem"], out, own_cache, fit_seconds=0.7, seeds=3)


@pytest.fixture(scope="module")
def shown(comparison: Comparison) -> list[str]:
    """The console tables and the page of the comparison."""
    stream = io.StringIO()
    console, detail = Console(file=stream, width=220), Detail(verbose=True, wide=True)
    print_tables(comparison, console, detail=detail)
    return [stream.getvalue(), unescape(render(comparison)[-1].read_text(encoding="utf-8"))]


def training_of(row: Row) -> tuple[int | None, float | None]:
    assert row.training is not None
    return row.training.iterations, row.training.fit_seconds


@pytest.mark.slow
def test_given_seconds_become_a_repeatable_number_of_iterations(
    comparison: Comparison, own_cache: Path, tmp_path: Path
) -> None:
    row = comparison.rows[0]
    assert training_of(row) == (70, 0.7)
    assert comparison.settings["fit_seconds"] == 0.7
    records = [json.loads(path.read_bytes()) for path in own_cache.glob("fits/descent-*/fit.json")]
    other_seeds = [item["parameters"] for item in records if item["parameters"]["seed"] == 2]
    assert [item["iterations"] for item in other_seeds] == [70]
    again = run_small(
        [descent_file(tmp_path, channels=1, fails=1, iterations=70)], tmp_path / "again", own_cache
    ).rows[0]
    assert again.error == row.error
    assert training_of(again) == (70, None)


@pytest.mark.slow
def test_a_failed_seed_is_recorded_and_shown(comparison: Comparison, shown: list[str]) -> None:
    row = comparison.rows[0]
    assert row.seeds is not None
    assert row.error is not None
    assert (row.seeds.n, row.seeds.asked) == (2, 3)
    reason = "seed 1: OutOfTimeError: all iterations would take 7 h; the limit is 9 s."
    assert row.seeds.failed == [reason]
    errors = [training.mean_dof_m for training in row.seeds.trainings]
    assert errors[:2] == [row.error.mean_dof_m, inf]
    assert errors[2] not in (errors[0], inf)
    spread = row.seeds.mean_dof_m
    assert spread is not None
    assert spread.median == max(errors[0], errors[2])
    assert (spread.min, spread.max, spread.std) == (min(errors), inf, inf)
    samples = comparison.samples(row)
    assert samples["seeds_relative_l2"].shape == (1, row.n_test)
    assert samples["seeds_validation_relative_l2"].shape == (1, row.n_validation)
    assert comparison.rows[-1].seeds is None  # a method without a seed
    assert Comparison.read(comparison.out).rows == comparison.rows
    assert comparison.table.loc[0, "seeds.mean_dof_m.max"] == inf
    assert "–inf" in shown[0]
    assert reason in shown[0]
    assert "<caption>Training seeds</caption>" in shown[1]
    assert "2 of 3" in shown[1]
    assert (comparison.out / "figures" / "beam-tiny--loss-curves.png").exists()


@pytest.mark.slow
def test_a_training_out_of_time_reports_its_expected_duration(
    comparison: Comparison, shown: list[str]
) -> None:
    row = comparison.row("beam-tiny", "descent [channels=100]")
    assert row.status == "failed"
    reason = OUT_OF_TIME.format("1.67")
    assert str(row.reason).startswith(reason)
    assert f"descent · channels 100: failed: {reason}" in shown[0]
    assert joined_units(reason) in shown[1]


@pytest.mark.slow
def test_loss_curves_are_kept_with_the_samples(comparison: Comparison) -> None:
    row = comparison.rows[0]
    samples = comparison.samples(row)
    assert len(samples["loss_curve"]) == 7
    assert (np.diff(samples["loss_curve"]) < 0).all()
    np.testing.assert_allclose(samples["validation_curve"], 1.5 * samples["loss_curve"])
    assert row.training is not None
    assert row.training.loss == samples["loss_curve"][-1]


@pytest.mark.slow
def test_a_killed_comparison_resumes_in_the_middle_of_a_training(
    own_cache: Path, tmp_path: Path
) -> None:
    path, out = descent_file(tmp_path, iterations=300), tmp_path / "out"
    before = set(own_cache.glob("fits/*/training/checkpoint"))

    def checkpoints() -> set[Path]:
        return set(own_cache.glob("fits/*/training/checkpoint")) - before

    options = ["--limit", str(LIMIT), "--out", str(out), "--cache", str(own_cache)]
    with subprocess.Popen(
        [*COMMAND, "run", "beam-tiny", "-m", str(path), *options],
        env={**os.environ, "DESCENT_NAP_S": "0.05"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        wait_for(checkpoints, process)
        time.sleep(0.7)
        process.kill()
        process.communicate()
    (left,) = checkpoints()
    resumed = run_small([path], out, own_cache).rows[0]
    assert resumed.warnings[0].startswith("goes on from iteration ")
    assert resumed.offline_s is not None
    assert resumed.offline_s.fit > 0.7  # includes the time before the kill
    assert resumed.offline_s.fit_core_s is not None
    assert 0 < resumed.offline_s.fit_core_s < (os.cpu_count() or 1) * resumed.offline_s.fit
    assert not left.exists()
    model = tmp_path / "whole.safetensors"
    whole = mor_bench.fit("beam-tiny", path, out=model, cache=own_cache, limit=LIMIT, threads=1)
    assert resumed.error is not None
    assert whole.error["mean_dof_m"] == pytest.approx(resumed.error.mean_dof_m, rel=1e-12)
    assert (left.parents[1] / "model.safetensors").read_bytes() == model.read_bytes()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> TrainingData:
    tiny = mor_bench.load_dataset("beam-tiny", LIMIT, cache=cache)
    return TrainingData(
        tiny.scene, tiny.train, tiny.validation, {}, tmp_path_factory.mktemp("data")
    )


@pytest.mark.slow
def test_a_damaged_checkpoint_is_dropped_and_the_time_before_a_stop_counts(
    data: TrainingData, tmp_path: Path
) -> None:
    spec = load_method_spec(descent_file(tmp_path))
    environment = RunEnvironment(tmp_path, (tmp_path / "fits",))

    def with_damaged_checkpoint(seed: int) -> CachedFit:
        parameters = {"iterations": 20, "seed": seed}
        cached = CachedFit(
            Configuration(spec, parameters, training=TrainingOptions()), data, environment
        )
        cached.begin_training()
        cached.checkpoint.write_bytes(b"damaged")
        return cached

    damaged = with_damaged_checkpoint(0)
    assert fit_configuration(damaged, 100.0).warnings == []
    assert not damaged.checkpoint.exists()
    stopped = with_damaged_checkpoint(1)
    (stopped.folder / "training.json").write_text(json.dumps({"taken_s": 130.0}))
    os.utime(stopped.checkpoint, (4e9, 4e9))  # the system clock may have jumped
    with pytest.raises(MethodFailedError, match="the limit of 120 s; it was stopped after 130 s"):
        fit_configuration(stopped, 120.0)
    assert stopped.checkpoint.exists()
    # The checkpoint is damaged, so its training time is lost too.
    assert fit_configuration(stopped, 200.0).fit_s < 70.0


STOPPED = """
import os
import warnings

from mor_bench.surrogates.autoencoder import Autoencoder


class Stopped(Autoencoder):
    def train(self, networks, loss, data, generator):
        calls = []

        def counted(rows):
            calls.append(1)
            return loss(rows)

        known = super().train(networks, counted, data, generator)
        if "STOPPED" in os.environ:
            raise RuntimeError("stopped")
        warnings.warn(f"{len(calls)} steps")
        return known
"""


@pytest.mark.slow
def test_a_fit_that_is_stopped_after_its_training_does_not_train_again(
    data: TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    (tmp_path / "stopped.py").write_text(STOPPED)
    configuration = Configuration(
        load_method_spec(method_file(tmp_path, "stopped", "stopped:Stopped")),
        {"iterations": 20},
        training=TrainingOptions(),
    )

    def cached(name: str) -> CachedFit:
        folder = tmp_path / name
        return CachedFit(configuration, data, RunEnvironment(folder, (folder / "fits",)))

    with monkeypatch.context() as patch:
        patch.setenv("STOPPED", "")
        with pytest.raises(MethodFailedError, match="crashed with RuntimeError: stopped"):
            fit_configuration(cached("a"), 100.0)
    assert cached("a").checkpoint.exists()
    resumed, whole = fit_configuration(cached("a"), 100.0), fit_configuration(cached("b"), 100.0)
    steps = [[text for text in fit.warnings if "steps" in text] for fit in (resumed, whole)]
    assert steps == [["0 steps"], ["20 steps"]]
    assert resumed.training == whole.training
    assert resumed.model_sha256 == whole.model_sha256 is not None
    assert not list(tmp_path.glob("*/fits/*/training/*"))


def test_a_training_can_open_only_its_own_checkpoint_folder_in_a_sealed_cache(
    tmp_path: Path,
) -> None:
    own = tmp_path / "fits" / "mine" / "training"
    own.mkdir(parents=True)
    (own.parent / "score.h5").write_text("errors")
    (own / "link").symlink_to(own.parent / "score.h5")
    code = f"""
from pathlib import Path
from mor_bench.sandbox.seal import Restrictions, seal
from mor_bench.snapshots.store import write_atomically
own = Path({str(own)!r})
seal(Restrictions((Path({str(tmp_path / "fits")!r}),), own))
write_atomically(own / "checkpoint", b"weights")
print((own / "checkpoint").read_bytes())
others = "../score.h5", "../../mine/score.h5", "link", "../training-of-another"
for path in others:
    try:
        (own / path).read_bytes()
    except PermissionError:
        print("refused")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["b'weights'", *["refused"] * 4], done.stderr
