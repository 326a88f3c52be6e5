"""One configuration fitted on a dataset's training part and saved: what `mor-bench fit` does."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from time import perf_counter
from typing import Any

import numpy as np

from mor_bench.errors import InvalidInputError
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.measure.predictions import predict_all
from mor_bench.method_loading import make_surrogate
from mor_bench.model_file import weights_to_start_from
from mor_bench.runs.compare import training_options
from mor_bench.runs.dataset_run import Listener
from mor_bench.runs.fit_cache import SCORE_CHUNK
from mor_bench.snapshots.dataset import Snapshots, load_dataset
from mor_bench.snapshots.store import remove_leftovers
from mor_bench.specs import SplitBy, check_parameters, load_dataset_spec, load_method_spec
from mor_bench.surrogate import Surrogate
from mor_bench.training_options import Device


@dataclass(frozen=True)
class Fit:
    """A fitted and saved model.

    Attributes
    ----------
    method : Surrogate
    out : Path
        Its file.
    error : dict
        On the test part, see `mor_bench.measure.error_metrics.summary`.
    seconds : float
        Of the fit in this process; of one that went on from a checkpoint, without what it took before.
    iterations : int or None
        That the seconds asked for came to.
    n_train, n_test : int
        Samples.
    """

    method: Surrogate
    out: Path
    error: dict[str, float]
    seconds: float
    iterations: int | None
    n_train: int
    n_test: int


def fit(
    dataset: str | Path | Mapping[str, Any],
    method: str | Path,
    parameters: Mapping[str, Any] | None = None,
    *,
    out: str | Path,
    split: SplitBy | None = None,
    limit: int | None = None,
    device: Device = "cpu",
    fit_seconds: float | None = None,
    checkpoint: str | Path | None = None,
    start_from: str | Path | None = None,
    threads: int | None = None,
    workers: int | None = None,
    cache: Path | None = None,
    suite: Path | None = None,
    listener: Listener = Listener(),
) -> Fit:
    """Fit a method on a dataset's training part, save the model, and score it on the test part.

    A training that was killed goes on from its checkpoint when it is given the same arguments, and ends with the same weights to
    the last bit; only a back end that is chosen by its time may be another one. It runs in this process: what `mor_bench.run`
    shields a comparison from is not held off here.

    Parameters
    ----------
    dataset : str, Path or dict
        A name in the suite, the path of a TOML, or a dict with the same keys.
    method : str or Path
        A name in the suite, or the path of a TOML.
    parameters : dict, optional
        Knobs in the place of the file's. One that the file sweeps over has the first of its values by default.
    out : path
        The safetensors file to write, or to write over.
    split : {"region", "sample", "direction"}, optional
        Instead of the split in the dataset's file.
    limit : int, optional
        Only the first samples of the dataset.
    device : {"cpu", "cuda", "auto"}
        Of the training; "auto" is a CUDA device if there is one.
    fit_seconds : float, optional
        That the training is sized to, in the place of the knob `iterations`.
    checkpoint : path, optional
        File that the training is written to now and then, and goes on from, until the model is saved; ``.NAME.checkpoint`` beside
        ``out`` by default.
    start_from : path, optional
        A model of the same class and architecture, whose weights the training starts from.
    threads : int, optional
        All cores by default. Another number may change the last bits.
    workers : int, optional
        Processes for data generation; all cores by default.
    cache, suite : Path, optional
        Cache folder; folder with ``datasets/`` and ``methods/``.
    listener : Listener
        Told of the progress of generation and training.

    Returns
    -------
    Fit

    Raises
    ------
    SpecError
        If the dataset, the method or a knob is unknown, or a value out of range.
    InvalidInputError
        If the method does not train and an option of trainings is given, there is no such device, ``out`` or ``checkpoint`` cannot
        be written or both are one file, the checkpoint is of another training, or ``start_from`` is of another class or architecture.
    StoreError
        If ``start_from`` or the checkpoint is damaged.
    MorBenchError
        As the method's `fit`.
    """
    out = Path(out)
    kept = out.with_name(f".{out.name}.checkpoint") if checkpoint is None else Path(checkpoint)
    spec = load_dataset_spec(dataset, suite)
    unfitted = _unfitted(method, parameters or {}, suite)
    cores = os.cpu_count() or 1
    if threads is not None and not 1 <= threads <= cores:
        raise InvalidInputError(f"`threads` must be an integer in [1, {cores}]; got {threads}.")
    _check_options(
        unfitted,
        {
            "device": device == "cuda",
            "fit_seconds": fit_seconds,
            "checkpoint": checkpoint,
            "start_from": start_from,
        },
    )
    options = training_options(device, fit_seconds)
    if start_from is not None:
        weights_to_start_from(start_from, unfitted)
        options = replace(options, start_from=Path(start_from))
    _check_writable("out", out)
    if unfitted.trains():
        _check_writable("checkpoint", kept)
        if kept.resolve() == out.resolve():
            raise InvalidInputError(
                f"`checkpoint` must be another file than `out`; got {kept} for both."
            )
        remove_leftovers(kept.parent, kept.name)
        unfitted.training = replace(options, checkpoint=kept, progress=listener.training)
    data = load_dataset(
        spec,
        limit,
        split=split,
        workers=workers,
        cache=cache,
        progress=partial(listener.generating, spec.name),
    )
    with pinned_threads(threads or cores):
        start = perf_counter()
        unfitted.fit(data.scene, data.train if unfitted.needs_snapshots else None)
        seconds = perf_counter() - start
        unfitted.save(out)
        if unfitted.trains():
            kept.unlink(missing_ok=True)
        if fit_seconds is not None and getattr(unfitted, "iterations_", None) is None:
            warnings.warn(
                f"{type(unfitted).__name__} did not size its training to seconds: its knob `iterations` counted.",
                stacklevel=2,
            )
        error = _test_error(unfitted, data.test)
    return Fit(
        unfitted,
        out,
        error,
        seconds,
        getattr(unfitted, "iterations_", None),
        len(data.train),
        len(data.test),
    )


def _unfitted(source: str | Path, parameters: Mapping[str, Any], suite: Path | None) -> Surrogate:
    spec = load_method_spec(source, suite)
    surrogate = spec.load_class()
    knobs = {**spec.configurations("full")[0], **parameters}
    check_parameters(surrogate, knobs, f"method {spec.name}")
    return make_surrogate(surrogate, knobs)


def _check_options(unfitted: Surrogate, given: Mapping[str, Any]) -> None:
    named = [f"`{name}`" for name, value in given.items() if value]
    if named and not unfitted.trains():
        raise InvalidInputError(
            f"{type(unfitted).__name__} has no training that {', '.join(named)} could act on."
        )


def _check_writable(name: str, path: Path) -> None:
    """A file can be written beside it: better known before a fit of hours than after."""
    if path.is_dir():
        raise InvalidInputError(f"`{name}`: {path} is a folder.")
    try:
        with NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
            pass
    except OSError as error:
        raise InvalidInputError(f"`{name}`: {path} cannot be written: {error.strerror}.") from None


def _test_error(method: Surrogate, test: Snapshots) -> dict[str, float]:
    predicted = [
        predict_all(method, test[start : start + SCORE_CHUNK].given)
        for start in range(0, len(test), SCORE_CHUNK)
    ]
    return summary(
        sample_errors(np.concatenate(predicted), test.displacements, test.scene.output_nodes)
    )
