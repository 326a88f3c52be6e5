"""Trained methods in a comparison: seconds to fill, seeds, checkpoints, loss curves, and flags beside large errors."""

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
from typing import Any

import numpy as np
import pytest
from mor_bench.run import fit_cache as fits
from mor_bench.runs.fit_cache import Entry, Job, Material, fit
from rich.console import Console

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.measure.range_flags import flags_of
from mor_bench.report.console_tables import print_tables
from mor_bench.report.page import render
from mor_bench.results.comparison import Comparison
from mor_bench.runs.dataset_run import place_of
from mor_bench.runs.plan import plan
from mor_bench.sandbox.process import MethodFailedError
from mor_bench.specs import load_method_spec
from mor_bench.training_options import TrainingOptions
from tests.test_fit_command import LIMIT, descent_file, wait_for


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of this module alone, since kept fits are counted."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a method that is swept over channels and steps, large ones of which are out of time, and whose seed 1 fails."""
    folder = tmp_path_factory.mktemp("descent")
    descent_file(folder, "[parameters]\nfails = 1\n[sweep]\nchannels = [1, 100]\nsteps = [1, 2]")
    return folder


@pytest.fixture(scope="module")
def comparison(folder: Path, cache: Path) -> Comparison:
    """Trained for 0.7 s, which comes to 70 iterations, with three seeds."""
    methods: list[str | Path] = [folder / "descent.toml", "linear-fem"]
    return mor_bench.run(
        ["beam-tiny"],
        methods,
        out=folder / "run",
        cache=cache,
        limit=LIMIT,
        fit_seconds=0.7,
        seeds=3,
    )


def test_seconds_come_to_iterations_that_can_be_repeated(
    comparison: Comparison, folder: Path, cache: Path
) -> None:
    row = comparison.rows[0]
    assert (
        row["training"].items() >= {"device": "cpu", "fit_seconds": 0.7, "iterations": 70}.items()
    )
    assert comparison.settings["fit_seconds"] == 0.7
    kept = [
        json.loads(path.read_bytes())["parameters"]
        for path in cache.glob("fits/descent-*/fit.json")
    ]
    assert {
        knobs["iterations"] for knobs in kept if knobs["seed"] == 2 and knobs["fails"] == 1
    } == {70}  # the other seeds are not timed
    path = folder / "again.toml"
    path.write_text(
        (folder / "descent.toml").read_text().partition("[sweep]")[0] + "iterations = 70\n"
    )
    again = mor_bench.run(
        ["beam-tiny"], [path, "linear-fem"], out=folder / "again", cache=cache, limit=LIMIT
    )
    assert again.rows[0]["error"] == row["error"]
    assert again.rows[0]["training"]["fit_seconds"] is None
    unlike = mor_bench.run(
        ["beam-tiny"], [folder / "descent.toml"], out=folder / "unlike", cache=cache, limit=LIMIT
    )
    assert unlike.rows[0]["training"]["iterations"] == 40
    assert unlike.rows[0]["error"] != row["error"]
    assert len(list(cache.glob("fits/linear-fem-*"))) == len(
        {r["label"] for r in comparison.rows if r["method"] == "linear-fem"}
    )


def test_a_seed_that_fails_is_shown_everywhere(comparison: Comparison) -> None:
    row = comparison.rows[0]
    found = row["seeds"]
    assert (found["n"], found["asked"]) == (2, 3)
    assert found["failed"] == [
        "seed 1: OutOfTimeError: all iterations would take 7 h; the limit is 9 s."
    ]
    errors = [training["mean_dof_m"] for training in found["trainings"]]
    assert errors[0] == row["error"]["mean_dof_m"]
    assert errors[1] == inf
    assert errors[2] not in (errors[0], inf)
    assert found["mean_dof_m"] == {
        "median": max(errors[0], errors[2]),
        "min": min(errors),
        "max": inf,
        "std": inf,
    }
    assert len(comparison.samples(row)["seeds_relative_l2"]) == 1
    assert comparison.rows[-1]["method"] == "linear-fem"
    assert comparison.rows[-1]["seeds"] is None
    assert Comparison.read(comparison.out).rows == json.loads(json.dumps(comparison.rows))
    assert comparison.table.loc[0, "seeds.mean_dof_m.max"] == inf
    assert (
        "seeds.rel_l2_median.std"
        in (comparison.out / "results.csv").read_text(encoding="utf-8").partition("\n")[0]
    )
    text = tables_of(comparison)
    assert "–inf" in text
    assert "seed 1: OutOfTimeError: all iterations would take 7 h" in text
    paths = render(comparison)
    page = unescape(paths[-1].read_text(encoding="utf-8"))
    assert "<h3>Training seeds</h3>" in page
    assert "2 of 3" in page
    assert comparison.out / "figures" / "beam-tiny--loss-curves.png" in paths
    assert "Dashed: of the samples that were held out" in page


def tables_of(comparison: Comparison) -> str:
    stream = io.StringIO()
    print_tables(comparison, Console(file=stream, width=220))
    return stream.getvalue()


def test_what_is_out_of_time_says_how_long_it_would_take(comparison: Comparison) -> None:
    rows = {row["label"]: row for row in comparison.rows}
    text, page = tables_of(comparison), unescape(render(comparison)[-1].read_text(encoding="utf-8"))
    for channels, steps, hours in ((1, 1, ""), (1, 2, ""), (100, 1, "1.67"), (100, 2, "3.33")):
        label = f"descent [channels={channels}, steps={steps}]"
        assert rows[label]["status"] == ("failed" if hours else "ok")
        if hours:
            said = f"OutOfTimeError: all iterations would take {hours} h; the limit is "
            assert rows[label]["reason"].startswith(said)
            assert f"{label}: failed: {said}" in text
            assert said in page


def test_curves_are_kept_with_the_samples(comparison: Comparison) -> None:
    samples = comparison.samples(comparison.rows[0])
    assert len(samples["loss_curve"]) == 7
    assert (np.diff(samples["loss_curve"]) < 0).all()
    np.testing.assert_allclose(samples["validation_curve"], 1.5 * samples["loss_curve"])
    assert comparison.rows[0]["training"]["loss"] == samples["loss_curve"][-1]


def test_a_killed_comparison_goes_on_in_the_middle_of_a_training(
    folder: Path, cache: Path, tmp_path: Path
) -> None:
    knobs = "[parameters]\niterations = 300\n"
    path, out = descent_file(tmp_path, knobs), tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "mor_bench",
        "run",
        "beam-tiny",
        "-m",
        str(path),
        "--limit",
        str(LIMIT),
        "--out",
        str(out),
        "--cache",
        str(cache),
    ]
    before = set(cache.glob("fits/*/training/checkpoint"))

    def checkpoints() -> set[Path]:
        return set(cache.glob("fits/*/training/checkpoint")) - before

    slow = {**os.environ, "DESCENT_NAP_S": "0.05"}
    with subprocess.Popen(
        command,
        env=slow,
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
    resumed = mor_bench.run(["beam-tiny"], [path], out=out, cache=cache, limit=LIMIT).rows[0]
    assert resumed["warnings"][0].startswith("goes on from iteration ")
    assert resumed["offline_s"]["fit"] > 0.7
    assert not left.exists()
    whole = mor_bench.fit(
        "beam-tiny", path, out=tmp_path / "whole.safetensors", cache=cache, limit=LIMIT, threads=1
    )
    assert whole.error["mean_dof_m"] == pytest.approx(resumed["error"]["mean_dof_m"], rel=1e-12)
    assert (left.parents[1] / "model.safetensors").read_bytes() == whole.out.read_bytes()


def test_a_damaged_checkpoint_is_left_and_the_time_before_a_stop_counts(
    folder: Path, cache: Path, tmp_path: Path
) -> None:
    data = mor_bench.load_dataset("beam-tiny", LIMIT, cache=cache, workers=1)
    material = Material(data.scene, data.train, {"test": fits.TestSet.of(data.test)}, tmp_path)
    spec, place = (
        load_method_spec(folder / "descent.toml"),
        place_of(tmp_path, [tmp_path / "fits"], 1, 1, float("inf")),
    )

    def entry(seed: int) -> Entry:
        made = Entry(
            Job(spec, {"iterations": 20, "seed": seed, "fails": -1}, "descent", TrainingOptions()),
            material,
            place,
        )
        made.begin_training()
        made.checkpoint.write_bytes(b"damaged")
        return made

    damaged = entry(0)
    assert fit(damaged, 100.0)["warnings"] == []
    assert not damaged.checkpoint.exists()
    stopped = entry(1)
    began = stopped.checkpoint.stat().st_mtime - 100.0
    (stopped.folder / "training.json").write_text(json.dumps({"taken_s": 30.0, "began": began}))
    with pytest.raises(
        MethodFailedError,
        match="fitting took longer than the limit of 120 s: 130 s until it was stopped",
    ):
        fit(stopped, 120.0)
    assert stopped.checkpoint.exists()
    assert (
        fit(stopped, 200.0)["fit_s"] < 70.0
    )  # the checkpoint was damaged, and with it went the time that it had taken


STOPPED = """
import os
import warnings

from mor_bench.surrogates.{module} import {base}


class Stopped({base}):
    def _trained(self, networks, loss, data, generator):
        calls = []
        known = super()._trained(networks, lambda rows: calls.append(1) or loss(rows), data, generator)
        if "STOPPED" in os.environ:
            raise RuntimeError("stopped")
        warnings.warn(f"{{len(calls)}} steps")
        return known
"""


@pytest.mark.parametrize(("module", "base"), [("pod_nn", "PODNN"), ("autoencoder", "Autoencoder")])
def test_a_comparison_that_is_stopped_after_a_training_goes_on_after_it(
    module: str, base: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    (tmp_path / "stopped.py").write_text(STOPPED.format(module=module, base=base))
    (tmp_path / "stopped.toml").write_text(
        'title = "t"\nsource = "s"\nsurrogate = "stopped:Stopped"\n'
    )
    data = mor_bench.load_dataset("beam-tiny", LIMIT, cache=cache, workers=1)
    material = Material(data.scene, data.train, {"test": fits.TestSet.of(data.test)}, tmp_path)
    spec = load_method_spec(tmp_path / "stopped.toml")

    def entry(name: str) -> Entry:
        place = place_of(tmp_path / name, [tmp_path / name / "fits"], 1, 1, float("inf"))
        return Entry(Job(spec, {"iterations": 70}, "stopped", TrainingOptions()), material, place)

    with monkeypatch.context() as patch:
        patch.setenv("STOPPED", "")
        with pytest.raises(MethodFailedError, match="crashed with RuntimeError: stopped"):
            fit(entry("a"), 100.0)
    assert entry("a").checkpoint.exists()
    resumed, whole = fit(entry("a"), 100.0), fit(entry("b"), 100.0)
    assert (resumed["warnings"], whole["warnings"]) == (["0 steps"], ["70 steps"])
    assert resumed["training"] == whole["training"]
    assert resumed["model_sha256"] == whole["model_sha256"] is not None
    assert not list(tmp_path.glob("*/fits/*/training/*"))


def test_options_of_trainings_are_checked_and_planned(
    folder: Path, cache: Path, tmp_path: Path
) -> None:
    bad: list[tuple[dict[str, Any], str]] = [
        ({"seeds": 0}, "`seeds` must be an integer in"),
        ({"fit_seconds": -1.0}, "`fit_seconds` must be above 0 and below 1200"),
        ({"fit_seconds": 60.0, "time_limit_s": 50.0}, "`fit_seconds` must be above 0 and below 50"),
        ({"device": "gpu"}, "`device` must be one of"),
    ]
    for arguments, message in bad:
        with pytest.raises(InvalidInputError, match=message):
            mor_bench.run(
                ["beam-tiny"], ["linear-fem"], out=tmp_path / "out", cache=cache, **arguments
            )
    assert not list(tmp_path.iterdir())
    one, three = (
        plan(
            ["beam-tiny"],
            ["umesh"],
            cache=tmp_path / "cache",
            limit=LIMIT,
            fit_seconds=50.0,
            seeds=seeds,
        )
        for seeds in (1, 3)
    )
    assert [step.label for step in one.steps[1:]] == ["umesh [channels=16, steps=2]"]
    assert [step.label for step in three.steps[2:]] == ["umesh: other seeds"]
    trees = plan(
        ["beam-tiny"],
        ["pca-extra-trees", "pca-ridge"],
        cache=tmp_path / "cache",
        limit=LIMIT,
        seeds=3,
    )
    assert [step.label for step in trees.steps if "seeds" in step.label] == [
        "pca-extra-trees: other seeds"
    ]
    assert one.steps[1].seconds == 50.0
    assert three.seconds - one.seconds == pytest.approx(
        100.0, abs=5.0
    )  # generation is estimated by solving


def test_of_a_sealed_cache_only_the_folder_of_the_own_checkpoint_is_open(tmp_path: Path) -> None:
    own = tmp_path / "fits" / "mine" / "training"
    own.mkdir(parents=True)
    (own.parent / "score.h5").write_text("errors")
    (own / "link").symlink_to(own.parent / "score.h5")
    code = f"""
from pathlib import Path
from mor_bench.sandbox.seal import seal
from mor_bench.snapshots.store import write_atomically
own = Path({str(own)!r})
seal([{str(tmp_path / "fits")!r}], str(own))
write_atomically(own / "checkpoint", b"weights")
print((own / "checkpoint").read_bytes())
for path in (own.parent / "score.h5", own / ".." / "score.h5", own / "link", Path(str(own) + "-of-another")):
    try:
        path.read_bytes()
    except PermissionError:
        print("refused")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["b'weights'", *["refused"] * 4], done.stderr


def test_the_recall_of_flags_by_hand() -> None:
    usual = {"relative_l2": np.linspace(0.01, 0.2, 20), "flagged": np.arange(20) == 3}
    far = {
        "relative_l2": np.array([0.3, 0.25, 0.1, inf, 0.195]),
        "flagged": np.array([True, False, True, True, True]),
    }
    flags = flags_of({"test": far, "in-range": usual})
    assert flags is not None
    assert flags.usual_rel_l2 == pytest.approx(0.2)
    assert flags.of(far) == {"n_unusual": 3, "n_unusual_flagged": 2, "recall": 2 / 3}
    assert flags.as_dict(far)["false_alarms"] == 1 / 20
    assert flags.as_dict(far)["test"] == {
        "n": 5,
        "n_flagged": 4,
        "n_unusual": 3,
        "n_unusual_flagged": 2,
        "recall": 2 / 3,
    }
    assert flags.of(usual)["recall"] is None
    assert flags_of({"test": far, "in-range": {"relative_l2": far["relative_l2"]}}) is None
    main_only = flags_of({"test": far})
    assert main_only is not None
    assert (main_only.in_range, main_only.usual_rel_l2, main_only.of(far)["n_unusual"]) == (
        "test",
        inf,
        0,
    )
