"""`mor-bench fit`: resuming gives the same bytes; impossible fits are refused first."""

from __future__ import annotations

import os
import signal
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, MorBenchError, SpecError
from mor_bench.runs.listener import Listener
from mor_bench.runs.single_fit import Fit
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots, load_dataset
from mor_bench.specs import load_generated_spec
from tests.commands import invoke
from tests.small_runs import COMMAND, LIMIT, descent_file, method_file, wait_for
from tests.third_party import Descent

NETWORK = {"channels": 1, "steps": 1, "batch_size": 4, "inference": "packed"}
"""A tiny U-Mesh; `inference = "auto"` would keep the times that it measures."""


def fit_tiny(
    method: str | Path, parameters: dict[str, Any], out: Path, cache: Path, **options: Any
) -> Fit:
    """Fit on a few samples of beam-tiny with one thread."""
    given = {"out": out, "limit": LIMIT, "cache": cache, "threads": 1, **options}
    return mor_bench.fit("beam-tiny", method, parameters, **given)


def changed_since(path: Path, time: float) -> bool:
    return path.exists() and path.stat().st_mtime > time


@pytest.mark.slow
def test_a_killed_fit_resumes_and_ends_with_the_same_bytes(cache: Path, tmp_path: Path) -> None:
    load_dataset("beam-tiny", LIMIT, cache=cache)
    path, out = descent_file(tmp_path), tmp_path / "model.safetensors"
    checkpoint, seen = tmp_path / "kept", 0.0
    options = [f"--limit={LIMIT}", f"--cache={cache}", "--threads=1", f"--out={out}"]
    options += [f"--checkpoint={checkpoint}", "--set=iterations=400", "--seed=3"]
    command = [*COMMAND, "fit", "beam-tiny", "-m", str(path), *options]
    # A background job of a shell ignores the interrupt, and so would its children.
    listening = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    for how in (signal.SIGKILL, signal.SIGINT):
        with subprocess.Popen(
            command,
            env={**os.environ, "DESCENT_NAP_S": "0.02"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=listening,
        ) as process:
            wait_for(partial(changed_since, checkpoint, seen), process)
            process.send_signal(how)
            stderr = process.communicate()[1]
        assert process.returncode == (130 if how == signal.SIGINT else -how), stderr
        assert not out.exists()
        seen = checkpoint.stat().st_mtime
    last = subprocess.run(command, capture_output=True, text=True, check=False)
    assert last.returncode == 0, last.stderr
    assert "goes on from iteration " in last.stderr
    assert "400 iterations, " in last.stdout
    assert not checkpoint.exists()
    parameters = {"iterations": 400, "seed": 3}
    whole = fit_tiny(path, parameters, tmp_path / "whole.safetensors", cache)
    assert out.read_bytes() == whole.out.read_bytes()
    assert f"ē {whole.error['mean_dof_m']:.2e} m" in last.stdout
    other = fit_tiny(path, {**parameters, "seed": 4}, tmp_path / "b.safetensors", cache)
    assert other.out.read_bytes() != whole.out.read_bytes()


@pytest.mark.slow
def test_a_fit_that_is_stopped_after_its_training_does_not_train_again(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    from mor_bench.surrogates.umesh.method import UMesh

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    seen: list[int] = []
    listener = Listener(training=lambda done, total, loss: seen.append(done))
    parameters = {**NETWORK, "iterations": 60, "validation_fraction": 0.0}
    out, checkpoint = tmp_path / "model.safetensors", tmp_path / ".model.safetensors.checkpoint"
    with monkeypatch.context() as patch:
        patch.setattr(UMesh, "save", stop)
        with pytest.raises(KeyboardInterrupt):
            fit_tiny("umesh-small", parameters, out, cache, listener=listener)
    assert checkpoint.exists()
    fitted = fit_tiny("umesh-small", parameters, out, cache, listener=listener)
    assert fitted.iterations == 60
    assert seen == [50, 60], "it trained once"
    whole = fit_tiny("umesh-small", parameters, tmp_path / "whole.safetensors", cache)
    assert out.read_bytes() == whole.out.read_bytes()
    assert {item.name for item in tmp_path.iterdir()} == {"model.safetensors", "whole.safetensors"}


Request = tuple[str, dict[str, Any], dict[str, Any]]
"""Method, its parameters, and the options of a fit."""

INVALID = InvalidInputError
REFUSED: list[tuple[Request, type[MorBenchError], str]] = [
    (("descent", {"iteration": 3}, {}), SpecError, "unknown key `iteration`"),
    (("descent", {"iterations": 0}, {}), SpecError, "iterations"),
    (("linear-fem", {"seed": 1}, {}), SpecError, "unknown key `seed`"),
    (
        ("linear-fem", {}, {"device": "cuda"}),
        INVALID,
        "LinearFEM has no training, so these options have no effect: `device`",
    ),
    (
        ("pod", {}, {"fit_seconds": 3.0, "start_from": "other.safetensors"}),
        INVALID,
        "these options have no effect: `fit_seconds`, `start_from`",
    ),
    (
        ("descent", {}, {"fit_seconds": 0.0}),
        INVALID,
        "`fit_seconds` must be a number above 0; got 0",
    ),
    (
        ("descent", {}, {"fit_seconds": float("nan")}),
        INVALID,
        "`fit_seconds` must be a number above",
    ),
    (("descent", {}, {"threads": 0}), INVALID, "`threads` must be an integer in"),
    (
        ("descent", {}, {"device": "gpu"}),
        INVALID,
        "`device` must be 'auto' or 'cpu' or 'cuda'; got",
    ),
    (("descent", {}, {"seeds": 3}), INVALID, "unknown option `seeds`"),
    (
        ("descent", {}, {"start_from": "other.safetensors"}),
        INVALID,
        "`start_from` must be a model of class 'tests.third_party:Descent'; got",
    ),
    (("descent", {}, {"start_from": "text"}), MorBenchError, "not a readable safetensors file"),
    (("descent", {}, {"out": "nowhere/a"}), INVALID, "`out`: .* cannot be written: No such file"),
    (("descent", {}, {"out": "."}), INVALID, "is a folder"),
    (
        ("descent", {}, {"checkpoint": "a.safetensors"}),
        INVALID,
        "`checkpoint` and `out` must be different files",
    ),
    (("descent", {}, {"checkpoint": "nowhere/c"}), INVALID, "`checkpoint`: .* cannot be written"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A method file, a model of another method, and a text."""
    folder = tmp_path_factory.mktemp("refused")
    descent_file(folder)
    other = mor_bench.load_method("linear-fem").fit(mor_bench.load_scene("beam-tiny"), None)
    other.save(folder / "other.safetensors")
    (folder / "text").write_text("no model")
    return folder


@pytest.mark.parametrize(("wanted", "kind", "message"), REFUSED)
def test_an_impossible_fit_is_refused_before_anything_runs(
    wanted: Request,
    kind: type[MorBenchError],
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    method, parameters, options = wanted
    monkeypatch.chdir(folder)
    before = set(folder.iterdir())
    source = "descent.toml" if method == "descent" else method
    given = {"out": "a.safetensors", "cache": "cache", **options}
    with pytest.raises(kind, match=message):
        mor_bench.fit("beam-tiny", source, parameters, **given)
    assert set(folder.iterdir()) == before


def test_cuda_is_refused_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    options: dict[str, Any] = {
        "out": tmp_path / "out",
        "device": "cuda",
        "cache": tmp_path / "cache",
    }
    for attempt in (
        partial(mor_bench.fit, "beam-tiny", "umesh-small"),
        partial(mor_bench.run, ["beam-tiny"], ["linear-fem"]),
    ):
        with pytest.raises(INVALID, match="`device` is 'cuda', but PyTorch finds no CUDA device"):
            attempt(**options)
    assert not list(tmp_path.iterdir())


def test_a_fit_takes_the_first_swept_value_and_scores_on_the_test_part(
    cache: Path, tmp_path: Path
) -> None:
    fitted = fit_tiny(
        "pca-regression-linear", {"n_output_modes": 4}, tmp_path / "a.safetensors", cache
    )
    again = mor_bench.load_surrogate(fitted.out)
    assert again.parameters["n_input_modes"] == 5
    test = load_dataset("beam-tiny", LIMIT, cache=cache).test
    off = np.abs(again.predict(test.forces) - test.displacements).mean(axis=(1, 2))
    assert fitted.error["mean_dof_m"] == pytest.approx(off.mean())
    assert fitted.n_train + fitted.n_validation + fitted.n_test == LIMIT
    assert fitted.iterations is None


def test_the_command_says_which_swept_value_it_took(cache: Path, tmp_path: Path) -> None:
    path = descent_file(tmp_path, sweep={"iterations": [20, 40, 60], "seed": [3, 4]})
    options = ["fit", "beam-tiny", "-m", str(path), f"--limit={LIMIT}", f"--cache={cache}"]
    options += ["--threads=1", f"--out={tmp_path / 'a.safetensors'}"]
    done = invoke(*options, "--seed=4")
    assert done.exit_code == 0, done.output
    assert " ".join(done.stdout.split()).startswith(
        "iterations = 20, the first of the 3 values of its sweep; "
        "choose another one with --set iterations=VALUE"
    )
    assert "20 iterations, " in done.stdout
    assert done.stdout.count("the first of") == 1
    given = invoke(*options, "--seed=4", "--set=iterations=40")
    assert "the first of" not in given.stdout
    assert "40 iterations, " in given.stdout


class FixedLength(Descent):
    """Trains for its own number of iterations and ignores the given seconds."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> FixedLength:
        self.training = replace(self.training, fit_seconds=None)
        super().fit(scene, snapshots)
        del self.iterations_
        return self


def test_a_method_that_ignores_the_seconds_is_reported(cache: Path, tmp_path: Path) -> None:
    path = method_file(tmp_path, "fixed", "tests.test_fit_command:FixedLength")
    with pytest.warns(UserWarning, match="FixedLength ignored `fit_seconds`"):
        fitted = fit_tiny(path, {}, tmp_path / "a.safetensors", cache, fit_seconds=5.0)
    assert fitted.out.exists()


def test_a_method_that_is_given_displacements_is_scored_on_its_predictions_from_them(
    cache: Path, tmp_path: Path
) -> None:
    content = load_generated_spec("beam-tiny").model_dump(mode="json")
    dataset = {**content, "observed": {"region": "z-max"}}
    options: dict[str, Any] = {"limit": LIMIT, "cache": cache}
    fitted = mor_bench.fit(dataset, "gappy-pod", out=tmp_path / "a.safetensors", **options)
    test = load_dataset(dataset, **options).test
    off = np.abs(fitted.method.predict(test.given) - test.displacements).mean(axis=(1, 2))
    assert fitted.error["mean_dof_m"] == pytest.approx(off.mean())
