"""Base class of regressions between principal coordinates of the load and of the displacement."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.compliance import Compliance, project
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.moved_bodies import MovedResponse, parametric_response
from mor_bench.mechanics.observed import LinearResponse, linear_response
from mor_bench.mechanics.parametric import Bodies, ParametricResponse
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.reduction.sensitivity import sensitivities
from mor_bench.reduction.subspace import at_wanted, wanted_dofs
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements, checked_given
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]
Input = Literal["linear-response", "force"]
Output = Literal["remainder", "displacement"]


@dataclass(frozen=True)
class CoordinateSamples:
    """Training samples in coordinates.

    Attributes
    ----------
    z : (n, n_inputs) float64
        Inputs.
    values : (n, n_outputs) float64
        Target g(z), m.
    weights : (n, 1) float64
        Factors that make errors relative to the displacement.
    directions, slopes : (n, d, n_inputs) and (n, d, n_outputs) float64, or None
        Derivatives of z, and of the values, m, along d changes of the load.
    """

    z: Array
    values: Array
    weights: Array
    directions: Array | None = None
    slopes: Array | None = None

    def __getitem__(self, rows: NDArray[np.bool_]) -> CoordinateSamples:
        known = (self.directions, self.slopes)
        derived = (None if array is None else array[rows] for array in known)
        return CoordinateSamples(self.z[rows], self.values[rows], self.weights[rows], *derived)


class CoordinateRegression(Surrogate, ABC):
    """u = K₀⁻¹f + Φ g(z) with z coordinates of K₀⁻¹f, or u = Φ g(z) with z coordinates of f.

    A subclass may also declare `output`; "displacement" is u = Φ g(z) with z coordinates of K₀⁻¹f,
    without sampled parameters.

    No mean is subtracted, and g(0) = 0: no force gives no displacement. With the linear response as
    input, g learns only the nonlinear remainder. With the force as input, g needs no equations, but
    it has no information about load regions without training samples. In a scene with observed
    nodes, their displacements replace the force, and their linear extension replaces the linear
    response. Where an instrument presses, its displacement replaces the force, and linear
    elasticity with the same contact replaces the linear response.

    In a scene with sampled parameters, the linear response is that of the sample's own body. The
    parameters follow as further coordinates, scaled to [-1, 1] over the training samples. Then a
    subclass must ensure that g is zero where all other coordinates are.

    A subclass declares the parameters below as its hyperparameters, and `derivatives` if it can
    learn from them. `regress` learns g, `take` restores its arrays, and `coefficients` evaluates
    it.

    Parameters
    ----------
    input : {"linear-response", "force"}
        Source of the coordinates z. The linear response gives far smaller errors, and needs the
        scene's equations.
    n_input_modes : int, optional
        Length of z; capped at the rank of the input with a warning. Where None is allowed, it means
        `usual_inputs`.
    n_output_modes : int
        Size of the basis Φ of the nonlinear remainder, or of the displacement; capped at the rank
        with a warning.
    """

    input: Input
    n_input_modes: int | None
    n_output_modes: int
    derivatives: bool = False
    output: Output | None = None

    usual_inputs: ClassVar[Mapping[str, int]] = {"linear-response": 20, "force": 60}
    """Length of z for each input, if `n_input_modes` is None."""

    evenness: ClassVar[float] = 0.5
    """Evenness of the sizes of z, see `input_axes`."""

    integers: ClassVar[frozenset[str]] = frozenset()
    """Names of the arrays that are int32; all others are float64."""

    axes_: Array
    modes_: Array
    response_: LinearResponse
    responses_: ParametricResponse | MovedResponse
    ends_: Array
    """(2, n_varied): lowest and highest training value of each parameter that g depends on."""

    @abstractmethod
    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        """Learn g in the coordinates of `axes_` and `modes_`; return its arrays."""

    @abstractmethod
    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        """Return the required shapes of the arrays of `regress`; None is any length but 0."""

    @abstractmethod
    def take(self, model: dict[str, NDArray[Any]]) -> None:
        """Keep the checked arrays of `regress`.

        Raises
        ------
        InvalidInputError
            If they hold values that no fit gives.
        """

    @abstractmethod
    def coefficients(self, z: Array) -> Array:
        """Return g of inputs (n, n_inputs), as (n, n_outputs), and count its work."""

    def supports(self, scene: Scene) -> str | None:
        if self.input == "linear-response" or self.derivatives:
            return unknown_equations(scene, observed=not self.derivatives)
        return None

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        samples = _shuffled(samples)
        given, targets = samples.given.values.reshape(len(samples), -1), samples.free_displacements
        parametric = bool(scene.parameter_names)
        if self.input == "linear-response":
            self._respond_to(scene)
            response = self._responses(given, samples.parameters)
            inputs = scene.at_free_dofs(response)
            targets = targets - inputs if self._adds_response else targets
        else:
            inputs = scene.at_free_dofs(given)
        usual = min(self.usual_inputs[self.input], *inputs[:, inputs.any(axis=0)].shape)
        self.axes_ = axes = input_axes(inputs, self.n_input_modes or usual, self.evenness)
        self.modes_ = modes = pod(targets, self.n_output_modes).modes
        more: dict[str, Array] = {}
        if parametric:
            values = samples.parameters[:, self._varied(scene)]
            self.ends_ = np.array([values.min(axis=0), values.max(axis=0)])
            z = self._with_parameters(inputs @ axes, samples.parameters)
            more = {"parameter_ends": self.ends_} if self.ends_.size else {}
        else:
            z = project(self._to_coordinates(axes), response if self._kinked else given)
        known = CoordinateSamples(
            z,
            targets @ modes,
            error_weights(samples.free_displacements)[:, None],
        )
        if self.derivatives:
            of_force = self.input == "force"
            found = sensitivities(FullOrderModel(scene), samples, axes, modes, of_force=of_force)
            known = replace(known, directions=found.inputs, slopes=found.outputs)
        return {"axes": axes, "modes": modes, **more, **self.regress(known)}

    def prepare(self, scene: Scene, model: Arrays) -> None:
        n_free = len(scene.free_dofs)
        self.axes_ = take_array(model, "axes", (n_free, None))
        self.modes_ = take_array(model, "modes", (n_free, None))
        names, self.ends_ = {"axes", "modes"}, np.zeros((2, 0))
        if varied := self._varied(scene):
            self.ends_ = take_array(model, "parameter_ends", (2, len(varied)))
            names.add("parameter_ends")
        n_inputs = self.axes_.shape[1] + len(varied)
        shapes = self.shapes(model, n_inputs, self.modes_.shape[1])
        names |= shapes.keys()
        if model.keys() != names:
            raise InvalidInputError(
                f"the arrays must be {', '.join(sorted(names))}; got {', '.join(sorted(model))}."
            )
        self.take(
            {
                name: take_array(model, name, shape, _dtype(name in self.integers))
                for name, shape in shapes.items()
            }
        )
        if self.input == "linear-response" and not self._responds:
            self._respond_to(scene)
        if self.input == "force" or not scene.parameter_names:
            self.from_forces_ = self._to_coordinates(self.axes_)
        expanding = scene.columns_at_all_dofs(self.modes_)
        self._wanted = None if scene.parameter_names else wanted_dofs(scene)
        self._respond_at: Callable[[Array], Array] | None = None
        if self._wanted is not None:
            expanding = expanding[self._wanted]
            if self._adds_response and isinstance(self.response_, Compliance):
                self._respond_at = self.response_.at(self._wanted)
        self._expanding = np.ascontiguousarray(expanding.T)

    def answer(self, forces: Array) -> Array:
        loads = self._driving(forces)
        coefficients = self.coefficients(project(self.from_forces_, loads))
        if is_counting():
            count(multiply_adds=len(loads) * min(self._expanding.size, self.modes_.size))
        out = coefficients @ self._expanding
        if self._adds_response:
            out += self._added(loads)
        return at_wanted(out, self._wanted, loads.shape[1]).reshape(forces.shape)

    def inputs_of(self, forces: Array) -> Array:
        """Return the inputs z (n, n_inputs) of g under checked forces (n, n_nodes, 3)."""
        return project(self.from_forces_, self._driving(forces))

    def norms_of(self, coefficients: Array) -> Array:
        """Return the norms of Φ g at the wanted nodes, m, from coefficients g (…, n_outputs)."""
        gram = self._expanding @ self._expanding.T
        squared = ((coefficients @ gram) * coefficients).sum(axis=-1)
        return np.asarray(np.sqrt(np.maximum(squared, 0.0)))

    def disagreement(self, forces: ArrayLike, members: Callable[[Array], Array]) -> Array:
        """Return how much the members of an ensemble disagree, of shape () or (n,).

        It is the root mean square over the members of the norm of their deviation from the mean,
        see `relative_spread`.

        Parameters
        ----------
        forces : (n_nodes, 3) or (n, n_nodes, 3), or ObservedDisplacements
            As in `predict`.
        members : callable
            Returns g of each member, (n_members, n, n_outputs), at inputs z (n, n_inputs).

        Raises
        ------
        InvalidInputError, NotFittedError
            As in `predict`.
        """

        def apart(z: Array) -> Array:
            found = members(z)
            squared = (self.norms_of(found - found.mean(axis=0)) ** 2).mean(axis=0)
            return np.asarray(np.sqrt(squared))

        return self.relative_spread(forces, apart)

    def relative_spread(self, forces: ArrayLike, sizes: Callable[[Array], Array]) -> Array:
        """Return uncertainties relative to the norm of the prediction, of shape () or (n,).

        They are infinite if a load gives a prediction of zero, and zero without load. They are no
        bounds of errors: `mor_bench.error_bound` finds the factor that makes them bounds.

        Parameters
        ----------
        forces : (n_nodes, 3) or (n, n_nodes, 3), or ObservedDisplacements
            As in `predict`.
        sizes : callable
            Returns uncertainties (n,), m, at inputs z (n, n_inputs).

        Raises
        ------
        InvalidInputError, NotFittedError
            As in `predict`.
        """
        predicted = np.nan_to_num(self.predict(forces))
        given = checked_given(self.scene_, forces).values
        norms = np.linalg.norm(predicted.reshape(given.shape), axis=(1, 2))
        relative = np.where(given.any(axis=(1, 2)), np.inf, 0.0)
        np.divide(sizes(self.inputs_of(given)), norms, out=relative, where=norms > 0)
        return np.asarray(relative.reshape(np.shape(predicted)[:-2]))

    def _driving(self, forces: Array) -> Array:
        """Return what z is linear in, (n, n_dofs): the loads, or their response if kinked."""
        loads = forces.reshape(-1, self.scene_.mesh.n_dofs)
        return self.response_.respond(loads) if self._kinked else loads

    def _added(self, loads: Array) -> Array:
        """Return the linear response at the wanted dofs; ``loads`` is it where it is kinked."""
        if self._respond_at is not None:
            return self._respond_at(loads)
        response = loads if self._kinked else self.response_.respond(loads)
        return response if self._wanted is None else response[:, self._wanted]

    def answer_parametric(self, forces: Array, parameters: Array) -> Array:
        loads = forces.reshape(-1, self.scene_.mesh.n_dofs)
        if self.input == "linear-response":
            out = self.responses_.respond(loads, parameters)
            count(multiply_adds=len(loads) * self.axes_.size)
            z = self.scene_.at_free_dofs(out) @ self.axes_
        else:
            out, z = np.zeros(loads.shape), project(self.from_forces_, loads)
        coefficients = self.coefficients(self._with_parameters(z, parameters))
        count(multiply_adds=len(loads) * self.modes_.size)
        return (out + coefficients @ self._expanding).reshape(forces.shape)

    def answer_observed(self, observed: ObservedDisplacements) -> Array:
        return self.answer(observed.values)

    @cached_property
    def _kinked(self) -> bool:
        """True if the response to the input is not linear, so that z is taken of the response."""
        return self.input == "linear-response" and self.scene_.contact is not None

    @property
    def _adds_response(self) -> bool:
        return self.input == "linear-response" and self.output != "displacement"

    def _respond_to(self, scene: Scene) -> None:
        if scene.parameter_names:
            self.responses_ = parametric_response(scene)
        else:
            self.response_ = linear_response(scene)

    @property
    def _responds(self) -> bool:
        return hasattr(self, "response_") or hasattr(self, "responses_")

    def _responses(self, loads: Array, parameters: Array) -> Array:
        if self.scene_.parameter_names:
            return self.responses_.respond(loads, parameters)
        return self.response_.respond(loads)

    def _varied(self, scene: Scene) -> list[int]:
        """Return the numbers of the parameters that g depends on."""
        if self.input == "linear-response" and scene.parameter_names:
            return Bodies(scene).varied
        return list(range(len(scene.parameter_names)))

    def _with_parameters(self, z: Array, parameters: Array) -> Array:
        """Append the scaled parameters (n, n_parameters) to coordinates (n, n_axes)."""
        low, high = self.ends_
        half = np.where(high > low, 0.5 * (high - low), 1.0)
        values = parameters[:, self._varied(self.scene_)]
        return np.hstack([z, (values - 0.5 * (low + high)) / half])

    def _to_coordinates(self, axes: Array) -> Array:
        """Return the matrix A (n_dofs, n_inputs) with z = fᵀA for a load f."""
        if self.input == "linear-response" and not self._kinked:
            return self.response_.to_coordinates(axes)
        return self.scene_.columns_at_all_dofs(axes)


def _shuffled(samples: Snapshots) -> Snapshots:
    """Return imported snapshots in a fixed random order, because kernels use only the first ones.

    Imported snapshots may be ordered by load region; generated ones cover the regions evenly.
    """
    if isinstance(samples.loads, PatchLoads):
        return samples
    return samples[np.random.default_rng(0).permutation(len(samples))]


def _dtype(integer: bool) -> type[np.generic]:
    return np.int32 if integer else np.float64
