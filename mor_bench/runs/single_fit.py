"""The public `fit`: fit one configuration on a dataset's training part, save and score it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mor_bench.errors import InvalidInputError, MorBenchError
from mor_bench.machine import pinned_threads, usable_cores
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.measure.predictions import predict_all
from mor_bench.method_loading import check_predicts, make_surrogate
from mor_bench.model_file import weights_to_start_from
from mor_bench.options import FitOptions
from mor_bench.runs.configurations import OWN, check_foreign_method
from mor_bench.runs.listener import Listener
from mor_bench.runs.run_context import training_options
from mor_bench.runs.scoring import SCORE_CHUNK
from mor_bench.sandbox.child import crash
from mor_bench.sandbox.process import MethodFailedError, default_memory_limit_bytes
from mor_bench.snapshots.dataset import Dataset, Snapshots, load_dataset
from mor_bench.snapshots.generate import default_cache
from mor_bench.snapshots.store import check_replaceable, remove_leftovers, temporary_beside
from mor_bench.specs import MethodSpec, check_parameters, load_dataset_spec, load_method_spec
from mor_bench.surrogate import Surrogate
from mor_bench.training_options import TrainingOptions


@dataclass(frozen=True)
class Fit:
    """A fitted and saved model.

    Attributes
    ----------
    method : Surrogate
    out : Path
        Its file.
    error : dict
        Errors on the test part, see `mor_bench.measure.error_metrics.summary`.
    seconds : float
        Time of the fit in this process, s; a resumed training counts from its checkpoint.
    iterations : int or None
        Number of iterations of a training with a time target.
    n_train, n_validation, n_test : int
        Numbers of samples. A training uses the validation samples to stop early.
    first_of : dict of str to list
        Swept parameters that were not given, and the values in the file; the first one was used.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:
    ...     result = fit("beam-tiny", "linear-fem", out=f"{folder}/model.safetensors")
    ...     again = mor_bench.load_surrogate(result.out)
    >>> type(again) is type(result.method), result.n_train
    (True, 140)
    """

    method: Surrogate
    out: Path
    error: dict[str, float]
    seconds: float
    iterations: int | None
    n_train: int
    n_validation: int
    n_test: int
    first_of: dict[str, list[Any]]


def fit(
    dataset: str | Path | Mapping[str, Any],
    method: str | Path,
    parameters: Mapping[str, Any] | None = None,
    *,
    out: str | Path,
    listener: Listener = Listener(),
    **options: Any,
) -> Fit:
    """Fit a method on a dataset's training part, save the model, and score it on the test part.

    The fit runs in this process, without the sandbox of `mor_bench.run`. A training that was
    killed resumes from its checkpoint when it gets the same arguments. It ends with the same
    weights to the last bit, unless a time limit chooses another numerical back end.

    Parameters
    ----------
    dataset : str, Path or dict
        A name in the suite, the path of a TOML, or a dict with the same keys.
    method : str or Path
        A name in the suite, or the path of a TOML.
    parameters : dict, optional
        Parameters that replace the file's. A swept one has its first value by default.
    out : path
        The safetensors file to write or overwrite.
    listener : Listener
        Callbacks for progress.
    **options
        See `mor_bench.options.FitOptions`: limit, split, device, fit_seconds, threads, workers,
        checkpoint, start_from, cache and suite.

    Raises
    ------
    SpecError
        If the dataset, the method or a parameter is not valid.
    InvalidInputError
        If an option is unknown or out of range; if a training option is given to a method without
        training; if a file cannot be written; if the checkpoint or ``start_from`` belongs to
        another model.
    StoreError
        If ``start_from`` or the checkpoint is damaged.
    MorBenchError
        Any error of the method's `fit`; `MethodFailedError` if a third party's method crashes.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     result = fit("beam-tiny", "linear-fem", out=f"{folder}/model.safetensors")
    >>> result.n_test, f"{result.error['rel_l2_median']:.1%}"
    (40, '2.6%')
    """
    chosen = FitOptions(**options)
    out = Path(out)
    spec = load_dataset_spec(dataset, chosen.suite)
    method_spec = load_method_spec(method, chosen.suite)
    if not method_spec.surrogate.startswith(OWN):
        # The import of a third party's module may end Python, or hang.
        cache = chosen.cache or default_cache()
        check_foreign_method(method_spec, cache, default_memory_limit_bytes())
    with _one_line(method_spec):
        unfitted = _unfitted(method_spec, parameters or {})
        trains = unfitted.trains()
    checkpoint = chosen.checkpoint or out.parent / f".{out.name}.checkpoint"
    training = _training(unfitted, chosen)
    _check_writable("out", out)
    if trains:
        _check_checkpoint(checkpoint, out)
        unfitted.training = replace(training, checkpoint=checkpoint, progress=listener.training)
    data = load_dataset(
        spec,
        chosen.limit,
        split=chosen.split,
        workers=chosen.workers,
        cache=chosen.cache,
        progress=partial(listener.generating, spec.name),
    )
    with pinned_threads(chosen.threads or usable_cores()):
        with _one_line(method_spec):
            seconds = _fit_and_save(unfitted, data, out)
        if trains:
            checkpoint.unlink(missing_ok=True)
        iterations = getattr(unfitted, "iterations_", None)
        if chosen.fit_seconds is not None and iterations is None:
            warnings.warn(
                f"{type(unfitted).__name__} ignored `fit_seconds`: it trained for the "
                "number of its parameter `iterations`.",
                stacklevel=2,
            )
        with _one_line(method_spec):
            error = _test_error(unfitted, data.test)
    n_train, n_validation, n_test = map(len, (data.train, data.validation, data.test))
    swept = method_spec.sweep_of("full")
    first_of = {name: values for name, values in swept.items() if name not in (parameters or {})}
    return Fit(unfitted, out, error, seconds, iterations, n_train, n_validation, n_test, first_of)


def _unfitted(spec: MethodSpec, parameters: Mapping[str, Any]) -> Surrogate:
    surrogate = spec.load_class()
    check_predicts(surrogate, spec.surrogate)
    chosen = {**spec.configurations("full")[0], **parameters}
    check_parameters(surrogate, chosen, f"method {spec.name}")
    return make_surrogate(surrogate, chosen)


def _training(unfitted: Surrogate, options: FitOptions) -> TrainingOptions:
    """Return the training options; refuse those that have no effect on this method."""
    given = {
        "device": options.device == "cuda",
        "fit_seconds": options.fit_seconds,
        "checkpoint": options.checkpoint,
        "start_from": options.start_from,
    }
    named = ", ".join(f"`{name}`" for name, value in given.items() if value)
    if named and not unfitted.trains():
        raise InvalidInputError(
            f"{type(unfitted).__name__} has no training, so these options have no effect: {named}."
        )
    training = training_options(options)
    if options.start_from is None:
        return training
    weights_to_start_from(options.start_from, unfitted)
    return replace(training, start_from=options.start_from)


def _check_checkpoint(checkpoint: Path, out: Path) -> None:
    _check_writable("checkpoint", checkpoint)
    if checkpoint.resolve() == out.resolve():
        raise InvalidInputError(
            f"`checkpoint` and `out` must be different files; got {checkpoint} for both."
        )


def _check_writable(name: str, path: Path) -> None:
    """Check that a file can be written before a long fit begins."""
    if path.is_dir():
        raise InvalidInputError(f"`{name}`: {path} is a folder.")
    check_replaceable(path)
    remove_leftovers(path.parent, path.name)
    temporary = temporary_beside(path)
    try:
        temporary.touch(exist_ok=False)
        temporary.unlink()
    except OSError as error:
        raise InvalidInputError(f"`{name}`: {path} cannot be written: {error.strerror}.") from None


@contextmanager
def _one_line(spec: MethodSpec) -> Iterator[None]:
    """Turn an error inside a third party's method into one line that names the place."""
    try:
        yield
    except (MorBenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # a method must not decide the exit code
        if spec.surrogate.startswith(OWN):
            raise
        raise MethodFailedError(f"method {spec.name}: {crash(error)}") from error


def _fit_and_save(unfitted: Surrogate, data: Dataset, out: Path) -> float:
    """Fit and save a method; return the seconds of the fit."""
    start = perf_counter()
    if unfitted.trains():
        unfitted.training = replace(unfitted.training, validation=data.validation)
    unfitted.fit(data.scene, data.train if unfitted.needs_snapshots else None)
    seconds = perf_counter() - start
    unfitted.save(out)
    return seconds


def _test_error(method: Surrogate, test: Snapshots) -> dict[str, float]:
    predicted = [
        predict_all(method, test[start : start + SCORE_CHUNK].given)
        for start in range(0, len(test), SCORE_CHUNK)
    ]
    scene, answers = test.scene, np.concatenate(predicted)
    errors = sample_errors(answers, test.displacements, scene.output_nodes, scene.fixed_nodes)
    return summary(errors)
