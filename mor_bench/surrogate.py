"""The interface that every method implements."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import (
    InvalidInputError,
    MorBenchError,
    NotFittedError,
    UnknownRangeError,
    UnsupportedSceneError,
)
from mor_bench.mechanics.indicator import ErrorIndicator, Indication
from mor_bench.model_arrays import check_finite
from mor_bench.model_file import StoredModel, class_path, write_model
from mor_bench.reduction.sizing import choose_sizes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.checked_samples import checked_samples
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import (
    Given,
    ObservedDisplacements,
    ParametricForces,
    checked_forces,
    checked_given,
    checked_parametric,
    has_values,
)
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.specs import CONTACT, NO_FORCES, check_parameters
from mor_bench.training_options import TrainingOptions

if TYPE_CHECKING:
    import onnx

Array = NDArray[np.float64]

NO_PARAMETERS = "it does not take sampled parameters"


class Surrogate:
    """A map from nodal forces, or observed displacements, to nodal displacements.

    A subclass is a dataclass of hyperparameters, ``@dataclass(eq=False)``, with three methods.
    `learn` returns the model as arrays, `prepare` computes from them everything else that a query
    needs, and `answer` predicts. Pydantic's `Field` in the annotations gives the range of a
    hyperparameter. This base class checks all input, saves, loads, and discards earlier fits.

    Examples
    --------
    >>> import mor_bench
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> mor_bench.load_method("linear-fem").fit(scene).predict(scene.mesh.points * 0.0).shape
    (63, 3)
    """

    needs_snapshots: ClassVar[bool] = True
    """True if `learn` uses snapshots; their cost is charged only to methods that do."""

    takes_observations: ClassVar[bool] = False
    """True if the input may be displacements of a part of the surface instead of forces. A
    class that defines `answer_observed` sets it."""

    takes_parameters: ClassVar[bool] = False
    """True if the method can handle scenes with sampled parameters, by `answer_parametric`."""

    architecture: ClassVar[tuple[str, ...]] = ()
    """Hyperparameters that determine names, shapes or meaning of the weights. A training can start
    only from a model with the same values."""

    sized: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Candidates for a hyperparameter set to "auto", from cheap to accurate; see
    `mor_bench.reduction.sizing`."""

    time_limit_s: float | None = None
    """Time limit for `fit`, s. A method that predicts that it will exceed the limit raises
    `OutOfTimeError`."""

    training: TrainingOptions = TrainingOptions()
    """Options of the training, set before `fit`."""

    scene_: Scene
    arrays_: dict[str, NDArray[Any]]
    range_: LoadRange
    sizes_: dict[str, Any]
    """Values chosen for hyperparameters set to "auto"."""

    timings_ms_: dict[str, float]
    """Times, ms, by which the fit chose between equivalent ways to predict, on its machine."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "answer_observed" in vars(cls):
            cls.takes_observations = True

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        """Return the model as arrays.

        Parameters
        ----------
        scene : Scene
        samples : Snapshots
            Checked training samples; empty for a method that needs none.
        """
        return {}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        """Compute everything else that a query needs; called after `learn` and after loading.

        Raises
        ------
        InvalidInputError
            If the arrays are not those of such a model, see `mor_bench.model_arrays`.
        """

    def answer(self, forces: Array) -> Array:
        """Return displacements, m, under checked forces (n, n_nodes, 3), N, in the same shape."""
        raise MorBenchError(f"{type(self).__name__} has neither `answer` nor `predict`.")

    def answer_parametric(self, forces: Array, parameters: Array) -> Array:
        """Return the same as `answer`, on bodies with checked parameters (n, n_parameters)."""
        raise UnsupportedSceneError(f"{type(self).__name__} cannot be used: {NO_PARAMETERS}.")

    def answer_observed(self, observed: ObservedDisplacements) -> Array:
        """Return the same as `answer`, from displacements of the observed nodes, zero elsewhere."""
        raise UnsupportedSceneError(f"{type(self).__name__} cannot be used: {NO_FORCES}.")

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Learn from snapshots and discard earlier fits.

        Parameters
        ----------
        scene : Scene
        snapshots : Snapshots, optional
            Training samples; ignored by methods that need none.

        Raises
        ------
        SpecError
            If a hyperparameter is out of its range.
        UnsupportedSceneError
            If the method cannot handle the scene.
        InvalidInputError
            If training samples are needed and missing, not finite, or all zero.
        """
        check_parameters(type(self), self.parameters)
        if reason := self.supports(scene) or Surrogate.supports(self, scene):
            raise UnsupportedSceneError(
                f"{type(self).__name__} cannot handle {scene.name}: {reason}"
            )
        self.forget()
        try:
            self._become(scene, {})
            samples = Snapshots.empty(scene)
            if self.needs_snapshots:
                samples = checked_samples(type(self).__name__, scene, snapshots)
                if scene.observed_nodes is None:
                    self.range_ = LoadRange.of(samples)
            self.sizes_ = choose_sizes(self, scene, samples, self.sized)
            self.arrays_ = self.learn(scene, samples)
            check_finite(type(self).__name__, self.arrays_)
            self.prepare(scene, self.arrays_)
        except BaseException:
            self.forget()
            raise
        return self

    def restore(
        self,
        scene: Scene,
        model: Mapping[str, NDArray[Any]],
        sizes: Mapping[str, Any] | None = None,
    ) -> Self:
        """Restore a fitted model from its ``arrays_`` and ``sizes_``.

        Raises
        ------
        MorBenchError
            If they are not those of such a model.
        """
        sizes = sizes or {}
        if any(self.parameters.get(name) != "auto" for name in sizes):
            raise InvalidInputError(
                f"values are given for {', '.join(sorted(sizes))}, but not all of these are "
                'set to "auto".'
            )
        check_parameters(type(self), {**self.parameters, **sizes})
        self.forget()
        self._become(scene, dict(sizes))
        self.arrays_ = dict(model)
        self.prepare(scene, self.arrays_)
        return self

    def predict(self, forces: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Predict displacements.

        Parameters
        ----------
        forces : (n_nodes, 3) or (n, n_nodes, 3), or ObservedDisplacements
            Nodal forces, N; or displacements of a part of the surface, m.
        parameters : (n_parameters,) or (n, n_parameters), optional
            Values of ``scene.parameter_names``, for all forces or for each of them. Required in a
            scene with sampled parameters; all others accept only an array without columns.

        Returns
        -------
        array of the same shape, float64
            Nodal displacements, m. Nodes outside the scene's ``needs.outputs`` may hold NaN.

        Raises
        ------
        InvalidInputError
            For a wrong shape or dtype, NaN or infinity.
        NotFittedError
            Before `fit`.
        SolverError
            If a method that solves equations finds no valid equilibrium.
        """
        if has_values(parameters) or self._fitted_scene().parameter_names:
            both = checked_parametric(self._fitted_scene(), forces, parameters)
            found, shape = self.answer_parametric(both.values, both.parameters), both.values.shape
        elif isinstance(forces, ObservedDisplacements):
            given = self._checked(forces)
            assert isinstance(given, ObservedDisplacements)
            found, shape = self.answer_observed(given), given.values.shape
        else:
            values = checked_forces(self._fitted_scene(), forces)
            found, shape = self.answer(values), values.shape
        if found.shape != shape:
            raise InvalidInputError(
                f"`answer` must return an array of shape {shape}; got {found.shape}."
            )
        return found.reshape(forces.shape if isinstance(forces, np.ndarray) else np.shape(forces))

    @classmethod
    def trains(cls) -> bool:
        """Return whether `fit` uses `training`: the class has ``iterations`` and ``seed``."""
        return {"iterations", "seed"} <= inspect.signature(cls.__init__).parameters.keys()

    def supports(self, scene: Scene) -> str | None:
        """Return the reason why the method cannot handle a scene, or None if it can."""
        if scene.parameter_names and not self.takes_parameters:
            return NO_PARAMETERS
        if self.takes_observations or scene.observed_nodes is None:
            return None
        return CONTACT if scene.contact else NO_FORCES

    def value(self, name: str) -> Any:
        """Return the value of a hyperparameter, or the value chosen for it if it is "auto"."""
        value = self.sizes_.get(name, getattr(self, name))
        if value == "auto":
            raise InvalidInputError(f"no value was chosen for `{name}`.")
        return value

    def out_of_range(
        self, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> NDArray[np.bool_]:
        """Flag loads outside the range of the training loads, as a bool array of shape () or (n,).

        A flag is not a bound on the error, see `mor_bench.snapshots.load_range`. A method that
        needs no snapshots has no range, unless it prepares for certain loads. Parameters and errors
        are those of `predict`.

        Raises
        ------
        UnknownRangeError
            If the range is unknown: the class overrides `fit`, the model's file has an older
            version, or displacements are given instead of forces.
        """
        if not hasattr(self, "scene_") and type(self).fit is not Surrogate.fit:
            raise UnknownRangeError(
                f"{type(self).__name__} overrides `fit`, so the range of its training loads is "
                "not known."
            )
        given = self._checked(forces, parameters)
        if hasattr(self, "range_"):
            bodies = given.parameters if isinstance(given, ParametricForces) else None
            flags = self.range_.excludes(given.values, bodies)
        elif not self.needs_snapshots:
            flags = np.zeros(len(given), dtype=bool)
        elif self.scene_.observed_nodes is not None:
            raise UnknownRangeError(
                f"{self.scene_.name}: the range of the training loads is not known: "
                f"{CONTACT if self.scene_.contact else NO_FORCES}."
            )
        else:
            raise UnknownRangeError(
                f"the range of the training loads of this {type(self).__name__} is not "
                "known. Its class overrides `fit`, or its file is from an older version "
                "and must be fitted again."
            )
        return flags.reshape(np.shape(forces)[:-2])

    def indicate_error(self, forces: ArrayLike, displacements: ArrayLike) -> Indication:
        """Estimate the error of predictions, m, from the equilibrium residual.

        Forces and displacements must have the same shape. Displacements must cover all nodes.

        Raises
        ------
        InvalidInputError, NotFittedError
            As in `predict`; also if displacements are given only at the wanted outputs.
        UnsupportedSceneError
            If the scene's equations or the forces are unknown.
        """
        if self._fitted_scene().parameter_names:
            raise UnsupportedSceneError(
                f"{self.scene_.name}: the error cannot be estimated with sampled parameters."
            )
        given = self._checked(forces)
        if self.scene_.observed_nodes is not None:
            raise UnsupportedSceneError(
                f"{self.scene_.name}: the error cannot be estimated: "
                f"{CONTACT if self.scene_.contact else NO_FORCES}."
            )
        predicted = np.asarray(displacements)
        if predicted.dtype.kind != "f" or predicted.shape != np.shape(forces):
            raise InvalidInputError(
                f"`displacements` must be floats of shape {np.shape(forces)}; "
                f"got {predicted.dtype} of shape {predicted.shape}."
            )
        predicted = predicted.reshape(given.values.shape).astype(np.float64, copy=False)
        left_out = np.delete(predicted, self.scene_.output_nodes, axis=1)
        if np.isnan(left_out).any():
            raise InvalidInputError(
                "`displacements` must be given at all nodes; the nodes outside "
                "`needs.outputs` hold NaN."
            )
        return self._indicator(given.values, predicted)

    @cached_property
    def _indicator(self) -> ErrorIndicator:
        return ErrorIndicator(self.scene_)

    @property
    def parameters(self) -> dict[str, Any]:
        """The hyperparameters and their values."""
        if type(self).__init__ is object.__init__:
            return {}
        names = list(inspect.signature(type(self).__init__).parameters)[1:]
        return {name: getattr(self, name) for name in names}

    def save(self, path: str | Path) -> None:
        """Write the fitted model to one safetensors file, see `mor_bench.model_file`.

        Raises
        ------
        NotFittedError
            Before `fit`.
        MorBenchError
            If the class overrides `fit`, so that its model is unknown.
        """
        if not hasattr(self, "scene_"):
            raise NotFittedError(f"{type(self).__name__} must be fitted before it is saved.")
        if not hasattr(self, "arrays_"):
            raise MorBenchError(f"{type(self).__name__} overrides `fit` and cannot be saved.")
        model = StoredModel(
            class_path(type(self)),
            json.dumps(self.parameters),
            self.scene_.spec.model_dump_json(),
            self.arrays_,
            self.range_.arrays() if hasattr(self, "range_") else {},
            self.sizes_,
            self.timings_ms_,
        )
        write_model(path, model)

    def onnx_model(self) -> onnx.ModelProto:
        """Return the network as an ONNX graph from `forces` to `displacements`.

        Both are (n, n_nodes, 3) float32; see `mor_bench.export`.
        """
        raise MorBenchError(f"{type(self).__name__} has no network to write as ONNX.")

    def forget(self) -> None:
        """Delete the fit: every attribute except hyperparameters and options."""
        for name in vars(self).keys() - {*self.parameters, "training", "time_limit_s"}:
            delattr(self, name)

    def _become(self, scene: Scene, sizes: dict[str, Any]) -> None:
        self.scene_, self.sizes_, self.timings_ms_ = scene, sizes, {}

    def _checked(self, forces: ArrayLike, parameters: ArrayLike | None = None) -> Given:
        if has_values(parameters):
            return checked_parametric(self._fitted_scene(), forces, parameters)
        return checked_given(self._fitted_scene(), forces)

    def _fitted_scene(self) -> Scene:
        if not hasattr(self, "scene_"):
            raise NotFittedError(f"{type(self).__name__} must be fitted before it predicts.")
        return self.scene_
