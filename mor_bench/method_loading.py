"""Make methods by name, and read fitted methods from files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.checked_files import parse_json
from mor_bench.errors import (
    MorBenchError,
    NotFittedError,
    SpecError,
    StoreError,
    UnsupportedSceneError,
    UnusableClassError,
)
from mor_bench.model_file import StoredModel, class_path, read_model
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.specs import (
    check_parameters,
    list_suite,
    load_class,
    load_method_spec,
    load_recorded_spec,
)
from mor_bench.specs.inline_parameters import split_method
from mor_bench.surrogate import NO_PARAMETERS, Surrogate

ANSWERS = ("predict", "answer", "answer_parametric", "answer_observed")
"""Methods of a class, at least one of which must be its own."""


def load_method(source: str | Path, **parameters: Any) -> Surrogate:
    """Make an unfitted method.

    Parameters
    ----------
    source : str or Path
        A name in ``methods/``, or the path of a TOML file; values may stand in brackets behind it,
        as in ``"pod[n_modes=20]"``.
    **parameters
        Replace the file's hyperparameters.

    Raises
    ------
    SpecError
        If the method or a hyperparameter is unknown, or a value is of the wrong type or range.
    MissingDependencyError
        If the method needs an extra that is not installed.

    Examples
    --------
    >>> load_method("pod[n_modes=5]").n_modes
    5
    """
    spec = load_method_spec(source)
    if isinstance(source, str) and any(len(v) > 1 for v in split_method(source)[1].values()):
        raise SpecError(f"{source}: each parameter must have one value here.")
    surrogate = spec.load_class()
    return make_surrogate(surrogate, {**spec.parameters, **parameters})


def check_predicts(surrogate: type[Any], name: str) -> None:
    """Raise `UnusableClassError` if a class has no prediction of its own."""
    own = (getattr(surrogate, verb, None) for verb in ANSWERS)
    if all(function in vars(Surrogate).values() for function in own):
        raise UnusableClassError(f"surrogate {name!r} has neither `answer` nor `predict`.")


def make_surrogate(surrogate: type[Any], parameters: Mapping[str, Any]) -> Surrogate:
    """Check hyperparameters and construct; adapt a class that only has `fit` and `predict`.

    Raises
    ------
    SpecError
        If a hyperparameter is unknown, or its value has the wrong type or range.
    MorBenchError
        If the class has no `fit` and `predict`.
    """
    if issubclass(surrogate, Surrogate):
        return surrogate(**check_parameters(surrogate, parameters))
    if not all(callable(getattr(surrogate, verb, None)) for verb in ("fit", "predict")):
        raise MorBenchError(
            f"{class_path(surrogate)} is not a subclass of mor_bench.Surrogate, "
            "and has no methods `fit` and `predict`."
        )
    return AdaptedMethod(surrogate, check_parameters(surrogate, parameters))


class AdaptedMethod(Surrogate):
    """Adapter of a class that does not inherit from `Surrogate`; it cannot be saved.

    Parameters
    ----------
    adapted : type
        A class with the methods ``fit(scene, snapshots)`` and ``predict(forces)``, which gets
        forces (n, n_nodes, 3), N, and returns displacements of that shape, m. Its attributes
        `needs_snapshots` (default True) and `takes_observations` (default False) are used.
    parameters : dict
        Its checked hyperparameters.
    """

    def __init__(self, adapted: type[Any], parameters: dict[str, Any]) -> None:
        self._class, self._parameters = adapted, parameters

    @property
    def parameters(self) -> dict[str, Any]:
        return self._parameters

    @property
    def needs_snapshots(self) -> bool:  # type: ignore[override]
        return bool(getattr(self._class, "needs_snapshots", True))

    @property
    def takes_observations(self) -> bool:  # type: ignore[override]
        return bool(getattr(self._class, "takes_observations", False))

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        if reason := self.supports(scene):
            raise UnsupportedSceneError(f"{class_path(self._class)}: {scene.name}: {reason}")
        method = self._class(**self._parameters)
        method.fit(scene, snapshots)
        self.method_, self.scene_, self.sizes_ = method, scene, {}
        if snapshots is not None and scene.observed_nodes is None:
            self.range_ = LoadRange.of(snapshots)
        return self

    def predict(
        self, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        if parameters is not None:
            raise UnsupportedSceneError(f"{class_path(self._class)}: {NO_PARAMETERS}.")
        if not hasattr(self, "method_"):
            raise NotFittedError(f"{class_path(self._class)} must be fitted before it predicts.")
        if isinstance(forces, ObservedDisplacements):
            return np.asarray(self.method_.predict(forces))
        given = np.asarray(forces)
        if given.ndim != 2:
            return np.asarray(self.method_.predict(given))
        found = np.asarray(self.method_.predict(given[None]))
        return found[0] if found.shape == (1, *given.shape) else found

    def save(self, path: str | Path) -> None:
        raise MorBenchError(
            f"{class_path(self._class)} is not a subclass of mor_bench.Surrogate and cannot be "
            "saved."
        )


def load_surrogate(path: str | Path) -> Surrogate:
    """Read a fitted model written by `Surrogate.save`.

    Only classes of the suite's methods are imported: a file cannot run its own code.

    Raises
    ------
    StoreError
        If the file is missing, damaged, of another format or a newer schema, or names a class that
        belongs to no method.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> fitted = load_method("linear-fem").fit(mor_bench.load_scene("beam-tiny"))
    >>> with TemporaryDirectory() as folder:
    ...     fitted.save(f"{folder}/model.safetensors")
    ...     type(load_surrogate(f"{folder}/model.safetensors")).__name__
    'LinearFEM'
    """
    model = read_model(path)
    known = {load_method_spec(file).surrogate for file in list_suite("methods").values()}
    if model.surrogate not in known:
        raise StoreError(
            f"{path}: class {model.surrogate!r} is not used by any method of the suite."
        )
    return _fitted(path, load_class(model.surrogate), None, model)


def load_fitted(path: str | Path, surrogate: type[Any], scene: Scene) -> Surrogate:
    """Read a fitted model of a known class and scene; errors as in `load_surrogate`."""
    model = read_model(path)
    expected = class_path(surrogate)
    if model.surrogate != expected:
        raise StoreError(f"{path}: a model of class {model.surrogate!r}; expected {expected!r}.")
    return _fitted(path, surrogate, scene, model)


def _fitted(
    path: str | Path, surrogate: type[Any], scene: Scene | None, model: StoredModel
) -> Surrogate:
    """Make the method from a file's content. Without a scene, build the scene in its header."""
    try:
        method = make_surrogate(surrogate, parse_json(model.parameters, "parameters"))
        scene = scene or load_scene(load_recorded_spec(parse_json(model.scene, "scene"), "scene"))
        method.restore(scene, model.arrays, model.sizes)
        method.timings_ms_.update(model.timings_ms)
        if model.load_range:
            n_nodes, n_parameters = scene.mesh.n_nodes, len(scene.parameter_names)
            method.range_ = LoadRange.from_arrays(model.load_range, n_nodes, n_parameters)
    except (
        MorBenchError,
        ArithmeticError,
        KeyError,
        ValueError,
        IndexError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise StoreError(
            f"{path}: its content does not describe a {model.surrogate.partition(':')[2]}: {error}"
        ) from None
    return method
