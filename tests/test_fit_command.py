"""`mor-bench fit`: a training that is killed goes on to the same last bit, and what cannot be done is refused before it begins."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open

import mor_bench
from mor_bench.cli.fit_command import parse_hyperparameters
from mor_bench.errors import InvalidInputError, MorBenchError, SpecError
from mor_bench.runs.listener import Listener
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots, load_dataset
from mor_bench.specs import load_generated_spec
from tests.third_party import Descent

LIMIT = 60


def descent_file(folder: Path, more: str = "") -> Path:
    path = folder / "descent.toml"
    path.write_text(f'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Descent"\n{more}')
    return path


def wait_for(done: Any, process: subprocess.Popen[str], within_s: float = 120.0) -> None:
    until = time.monotonic() + within_s
    while not done():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < until
        time.sleep(0.01)


def test_a_killed_fit_goes_on_and_ends_with_the_same_bytes(cache: Path, tmp_path: Path) -> None:
    load_dataset("beam-tiny", LIMIT, cache=cache, workers=1)
    path, out = descent_file(tmp_path), tmp_path / "model.safetensors"
    options = [
        "--set",
        "iterations=400",
        "--seed",
        "3",
        "--limit",
        str(LIMIT),
        "--cache",
        str(cache),
        "--threads",
        "1",
    ]
    command = [
        sys.executable,
        "-m",
        "mor_bench",
        "fit",
        "beam-tiny",
        "-m",
        str(path),
        "--out",
        str(out),
        *options,
    ]
    checkpoint = tmp_path / ".model.safetensors.checkpoint"
    slow = {**os.environ, "DESCENT_NAP_S": "0.02"}
    seen: float = 0.0
    for how in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        heeding = partial(
            signal.signal, signal.SIGINT, signal.SIG_DFL
        )  # a job in the background of a shell ignores it, and so would its children
        with subprocess.Popen(
            command,
            env=slow,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=heeding,
        ) as process:
            wait_for(
                lambda seen=seen: checkpoint.exists() and checkpoint.stat().st_mtime > seen, process
            )
            process.send_signal(how)
            said = process.communicate()[1]
        assert process.returncode == (130 if how == signal.SIGINT else -how), said
        assert not out.exists()
        seen = checkpoint.stat().st_mtime
    last = subprocess.run(command, capture_output=True, text=True, check=False)
    assert last.returncode == 0, last.stderr
    assert "goes on from iteration " in last.stderr
    assert "400 iterations, " in last.stdout
    assert not checkpoint.exists()
    whole = mor_bench.fit(
        "beam-tiny",
        path,
        {"iterations": 400, "seed": 3},
        out=tmp_path / "whole.safetensors",
        limit=LIMIT,
        cache=cache,
        threads=1,
    )
    assert out.read_bytes() == whole.out.read_bytes()
    assert f"ē {whole.error['mean_dof_m']:.2e} m" in last.stdout
    other = mor_bench.fit(
        "beam-tiny",
        path,
        {"iterations": 400, "seed": 4},
        out=tmp_path / "b.safetensors",
        limit=LIMIT,
        cache=cache,
        threads=1,
    )
    assert other.out.read_bytes() != whole.out.read_bytes()


def test_a_killed_training_of_u_mesh_goes_on_too(cache: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    load_dataset("beam-tiny", LIMIT, cache=cache, workers=1)
    knobs = {
        "channels": 1,
        "steps": 1,
        "iterations": 300,
        "batch_size": 4,
        "inference": "packed",
    }  # "auto" keeps the times it measured
    out, checkpoint = tmp_path / "model.safetensors", tmp_path / "kept"
    options = [
        "--limit",
        str(LIMIT),
        "--cache",
        str(cache),
        "--threads",
        "1",
        "--out",
        str(out),
        "--checkpoint",
        str(checkpoint),
    ]
    often = "import mor_bench.learning.training as t; t.CHECKPOINT_EVERY_S = 0.0; from mor_bench.cli.app import app; app()"
    command = [sys.executable, "-c", often, "fit", "beam-tiny", "-m", "umesh-small", *options]
    command += [f"--set={name}={value}" for name, value in knobs.items()]

    def iteration() -> int:
        if not checkpoint.exists():
            return 0
        with safe_open(str(checkpoint), framework="numpy") as file:
            return int(json.loads(file.metadata()["numbers"])["iteration"])

    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        wait_for(lambda: iteration() > 60, process)
        process.kill()
        process.communicate()
    assert 60 < iteration() < 300
    told: list[int] = []
    listener = Listener(training=lambda done, total, loss: told.append(done))
    arguments: dict[str, Any] = {"limit": LIMIT, "cache": cache, "threads": 1}
    with pytest.raises(InvalidInputError, match="the checkpoint of another training"):
        mor_bench.fit(
            "beam-tiny",
            "umesh-small",
            {**knobs, "seed": 1},
            out=out,
            checkpoint=checkpoint,
            **arguments,
        )
    mor_bench.fit(
        "beam-tiny",
        "umesh-small",
        knobs,
        out=out,
        checkpoint=checkpoint,
        listener=listener,
        **arguments,
    )
    assert told[0] >= 100
    assert told[-1] == 300
    whole = mor_bench.fit(
        "beam-tiny", "umesh-small", knobs, out=tmp_path / "whole.safetensors", **arguments
    )
    assert out.read_bytes() == whole.out.read_bytes()
    with pytest.raises(
        InvalidInputError, match="must be a model with `channels` 2; got one with `channels` 1"
    ):
        mor_bench.fit(
            "beam-tiny",
            "umesh-small",
            {**knobs, "channels": 2},
            out=tmp_path / "b.safetensors",
            start_from=out,
            **arguments,
        )
    assert not (tmp_path / "b.safetensors").exists()


def test_a_fit_that_is_stopped_after_its_training_goes_on_after_it(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    from mor_bench.surrogates.umesh.method import UMesh

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    told: list[int] = []
    listener = Listener(training=lambda done, total, loss: told.append(done))
    arguments: dict[str, Any] = {"limit": LIMIT, "cache": cache, "threads": 1, "listener": listener}
    knobs = {
        "channels": 1,
        "steps": 1,
        "iterations": 60,
        "batch_size": 4,
        "inference": "packed",
        "validation_fraction": 0.0,
    }
    out, checkpoint = tmp_path / "model.safetensors", tmp_path / ".model.safetensors.checkpoint"
    for name in ("_choose_inference", "save"):
        with monkeypatch.context() as patch:
            patch.setattr(UMesh, name, stop)
            with pytest.raises(KeyboardInterrupt):
                mor_bench.fit("beam-tiny", "umesh-small", knobs, out=out, **arguments)
        assert checkpoint.exists()
    assert mor_bench.fit("beam-tiny", "umesh-small", knobs, out=out, **arguments).iterations == 60
    assert told == [50, 60], "it trained once"
    assert not checkpoint.exists()
    whole = mor_bench.fit(
        "beam-tiny", "umesh-small", knobs, out=tmp_path / "whole.safetensors", **arguments
    )
    assert out.read_bytes() == whole.out.read_bytes()
    assert {item.name for item in tmp_path.iterdir()} == {"model.safetensors", "whole.safetensors"}


def test_what_cannot_be_done_is_refused_before_anything_runs(tmp_path: Path) -> None:
    path, cache = descent_file(tmp_path), tmp_path / "cache"
    other = tmp_path / "other.safetensors"
    mor_bench.load_method("linear-fem").fit(mor_bench.load_scene("beam-tiny"), None).save(other)
    (tmp_path / "text").write_text("no model")
    refused: list[tuple[str | Path, dict[str, Any], dict[str, Any], type[MorBenchError], str]] = [
        (path, {"iteration": 3}, {}, SpecError, "unknown key `iteration`"),
        (path, {"iterations": 0}, {}, SpecError, "iterations"),
        ("linear-fem", {"seed": 1}, {}, SpecError, "unknown key `seed`"),
        (
            "linear-fem",
            {},
            {"device": "cuda"},
            InvalidInputError,
            "LinearFEM has no training that `device` could act on",
        ),
        (
            "pod",
            {},
            {"fit_seconds": 3.0, "start_from": other},
            InvalidInputError,
            "no training that `fit_seconds`, `start_from` could act on",
        ),
        (path, {}, {"fit_seconds": 0.0}, InvalidInputError, "`fit_seconds` must be above 0; got 0"),
        (
            path,
            {},
            {"fit_seconds": float("nan")},
            InvalidInputError,
            "`fit_seconds` must be above 0",
        ),
        (path, {}, {"threads": 0}, InvalidInputError, "`threads` must be an integer in"),
        (
            path,
            {},
            {"device": "gpu"},
            InvalidInputError,
            "`device` must be one of auto, cpu, cuda; got 'gpu'",
        ),
        (
            path,
            {},
            {"start_from": other},
            InvalidInputError,
            "`start_from` must be a model of class 'tests.third_party:Descent'; got",
        ),
        (
            path,
            {},
            {"start_from": tmp_path / "text"},
            MorBenchError,
            "not a readable safetensors file",
        ),
        (
            path,
            {},
            {"out": tmp_path / "nowhere" / "a.safetensors"},
            InvalidInputError,
            "`out`: .* cannot be written: No such file",
        ),
        (path, {}, {"out": tmp_path}, InvalidInputError, "is a folder"),
        (
            path,
            {},
            {"checkpoint": tmp_path / "a.safetensors"},
            InvalidInputError,
            "`checkpoint` must be another file than `out`; got",
        ),
        (
            path,
            {},
            {"checkpoint": tmp_path / "nowhere" / "c"},
            InvalidInputError,
            "`checkpoint`: .* cannot be written",
        ),
    ]
    for method, knobs, options, kind, message in refused:
        with pytest.raises(kind, match=message):
            mor_bench.fit(
                "beam-tiny",
                method,
                knobs,
                **{"out": tmp_path / "a.safetensors", "cache": cache, **options},
            )
    assert not cache.exists()
    assert {item.name for item in tmp_path.iterdir()} == {
        "descent.toml",
        "other.safetensors",
        "text",
    }


def test_cuda_is_refused_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        InvalidInputError, match="`device` is 'cuda', but PyTorch finds no CUDA device here"
    ):
        mor_bench.fit(
            "beam-tiny",
            "umesh-small",
            out=tmp_path / "a.safetensors",
            device="cuda",
            cache=tmp_path / "cache",
        )
    with pytest.raises(
        InvalidInputError, match="`device` is 'cuda', but PyTorch finds no CUDA device here"
    ):
        mor_bench.run(
            ["beam-tiny"],
            ["linear-fem"],
            out=tmp_path / "out",
            device="cuda",
            cache=tmp_path / "cache",
        )
    assert not list(tmp_path.iterdir())


def test_a_method_that_does_not_train_is_fitted_too_and_a_swept_knob_has_its_first_value(
    cache: Path, tmp_path: Path
) -> None:
    fitted = mor_bench.fit(
        "beam-tiny",
        "pca-regression",
        {"n_output_modes": 4},
        out=tmp_path / "a.safetensors",
        limit=LIMIT,
        cache=cache,
    )
    again = mor_bench.load_surrogate(fitted.out)
    assert again.parameters["n_input_modes"] == 5
    test = load_dataset("beam-tiny", LIMIT, cache=cache).test
    off = np.abs(again.predict(test.forces) - test.displacements).mean(axis=(1, 2))
    assert fitted.error["mean_dof_m"] == pytest.approx(off.mean())
    assert (fitted.n_train + fitted.n_test, fitted.iterations) == (LIMIT, None)


class Unheeding(Descent):
    """Trains as many iterations as its knob says, whatever the seconds."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Unheeding:
        self.training = replace(self.training, fit_seconds=None)
        super().fit(scene, snapshots)
        del self.iterations_
        return self


def test_seconds_that_were_not_heeded_are_told(cache: Path, tmp_path: Path) -> None:
    path = tmp_path / "unheeding.toml"
    path.write_text('title = "t"\nsource = "s"\nsurrogate = "tests.test_fit_command:Unheeding"\n')
    with pytest.warns(
        UserWarning,
        match="Unheeding did not size its training to seconds: its knob `iterations` counted",
    ):
        fitted = mor_bench.fit(
            "beam-tiny",
            path,
            out=tmp_path / "a.safetensors",
            fit_seconds=5.0,
            limit=LIMIT,
            cache=cache,
        )
    assert fitted.out.exists()


def test_where_displacements_are_observed_the_error_is_that_of_answers_to_them(
    cache: Path, tmp_path: Path
) -> None:
    dataset = {
        **load_generated_spec("beam-tiny").model_dump(mode="json"),
        "observed": {"region": "z-max"},
    }
    fitted = mor_bench.fit(
        dataset, "gappy-pod", out=tmp_path / "a.safetensors", limit=LIMIT, cache=cache
    )
    test = load_dataset(dataset, LIMIT, cache=cache).test
    off = np.abs(fitted.method.predict(test.given.query) - test.displacements).mean(axis=(1, 2))
    assert fitted.error["mean_dof_m"] == pytest.approx(off.mean())


def test_knobs_of_the_command_line() -> None:
    given = ["n=3", "rate=1e-3", "schedule=one-cycle", 'name="3"', "on=true", "sizes=[1, 2]"]
    assert parse_hyperparameters(given) == {
        "n": 3,
        "rate": 1e-3,
        "schedule": "one-cycle",
        "name": "3",
        "on": True,
        "sizes": [1, 2],
    }
    with pytest.raises(InvalidInputError, match="`--set` takes PARAMETER=VALUE; got 'n'"):
        parse_hyperparameters(["n"])
