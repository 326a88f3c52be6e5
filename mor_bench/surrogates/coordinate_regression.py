"""What regressions between principal coordinates of the load's effect and of the displacement share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.compliance import project
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.observed import LinearResponse, linear_response
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.reduction.sensitivity import sensitivities
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import PatchLoads
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]
Input = Literal["linear-response", "force"]


@dataclass(frozen=True)
class CoordinateSamples:
    """Training samples as a regression between coordinates sees them.

    Attributes
    ----------
    z : (n, n_inputs) float64
    values : (n, n_outputs) float64
        What g(z) is to be, m.
    weights : (n, 1) float64
        What errors are multiplied by where they are to count relative to the displacement.
    directions, slopes : (n, d, n_inputs) and (n, d, n_outputs) float64, or None
        Derivatives of z, and of the values, m, along d changes of the load.
    """

    z: Array
    values: Array
    weights: Array
    directions: Array | None = None
    slopes: Array | None = None

    def __getitem__(self, rows: NDArray[np.bool_]) -> CoordinateSamples:
        derived = (
            None if array is None else array[rows] for array in (self.directions, self.slopes)
        )
        return CoordinateSamples(self.z[rows], self.values[rows], self.weights[rows], *derived)


def _mixed(snapshots: Snapshots) -> Snapshots:
    """Imported snapshots in random order, the same each time: they may come load region by load region, and kernels see the first."""
    return (
        snapshots
        if isinstance(snapshots.loads, PatchLoads)
        else snapshots[np.random.default_rng(0).permutation(len(snapshots))]
    )


class CoordinateRegression(Surrogate):
    """u = K₀⁻¹f + Φ g(z), with z coordinates of the linear response K₀⁻¹f; or u = Φ g(z), with z coordinates of the force f.

    Neither has a mean, and g(0) = 0: no force gives no displacement. With the linear response as input only the nonlinear rest
    is learned, and the answer to any force is at least that of linear elasticity. With the force as input nothing is known of
    load regions that training does not hold, and no equations are needed.

    In a scene with observed nodes their displacements take the place of the force, and the linear extension of these that of the
    linear response.

    A subclass has the knobs `input`, `n_input_modes` and `n_output_modes`, and `derivatives` if it can learn from them; it learns
    g in `_learn`, takes what was learned back in `_take`, whose shapes `_shapes` gives, and evaluates it in `_coefficients`.
    """

    takes_observations = True

    input: Input
    n_input_modes: int | None
    n_output_modes: int
    derivatives: bool = False
    compliance_: LinearResponse

    usual_inputs: ClassVar[Mapping[Input, int]] = {"linear-response": 20, "force": 60}
    """Length of z where `n_input_modes` is None."""

    evenness: ClassVar[float] = 0.5
    """Of the sizes of z, see `input_axes`."""

    integers: ClassVar[frozenset[str]] = frozenset()
    """Names of the arrays that are int32; all others are float64."""

    def supports(self, scene: Scene) -> str | None:
        if self.input == "linear-response" or self.derivatives:
            return unknown_equations(scene, observed=not self.derivatives)
        return None

    @abstractmethod
    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        """Fit g; `axes_` and `modes_` are those of the samples' coordinates."""

    @abstractmethod
    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        """The shapes that the arrays of `_learn` must have."""

    @abstractmethod
    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        """Keep the arrays of `_learn`, finite, in C order and of the shapes that they must have."""

    @abstractmethod
    def _learned(self) -> dict[str, NDArray[Any]]:
        """The arrays of `_learn`."""

    @abstractmethod
    def _coefficients(self, z: Array) -> Array:
        """g of inputs (n, n_inputs), as (n, n_outputs), and its work counted."""

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            snapshots = _mixed(self._checked_snapshots(snapshots))
            free, forces, targets = (
                scene.free_dofs,
                snapshots.inputs.reshape(len(snapshots), -1),
                snapshots.free_displacements,
            )
            if self.input == "linear-response":
                self.compliance_ = linear_response(scene)
                inputs = self.compliance_.respond(forces)[:, free]
                targets = targets - inputs
            else:
                inputs = snapshots.free_inputs
            usual = min(self.usual_inputs[self.input], *inputs[:, inputs.any(axis=0)].shape)
            axes = input_axes(inputs, self.n_input_modes or usual, self.evenness)
            modes = pod(targets, self.n_output_modes).modes
            weights = error_weights(snapshots.free_displacements)[:, None]
            samples = CoordinateSamples(
                project(self._to_coordinates(axes), forces), targets @ modes, weights
            )
            if self.derivatives:
                known = sensitivities(
                    FullOrderModel(scene), snapshots, axes, modes, of_force=self.input == "force"
                )
                samples = replace(samples, directions=known.inputs, slopes=known.outputs)
            self.axes_, self.modes_ = axes, modes
            self._restore({"axes": axes, "modes": modes, **self._learn(samples)})
        return self

    def _to_coordinates(self, axes: Array) -> Array:
        """(n_dofs, n_inputs): z = fᵀ of this, whichever the input."""
        if self.input == "linear-response":
            return self.compliance_.to_coordinates(axes)
        return self._on_all_dofs(axes)

    def _on_all_dofs(self, modes: Array) -> Array:
        whole = np.zeros((self.scene_.mesh.n_dofs, modes.shape[1]))
        whole[self.scene_.free_dofs] = modes
        return whole

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        loads = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        coefficients = self._coefficients(project(self._from_forces, loads))
        if is_counting():
            count(multiply_adds=len(loads) * self.modes_.size)
        out = coefficients @ self._expanding
        if self.input == "linear-response":
            out += self.compliance_.respond(loads)
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"axes": self.axes_, "modes": self.modes_, **self._learned()}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_inputs, n_outputs = (
            len(self.scene_.free_dofs),
            state["axes"].shape[1],
            state["modes"].shape[1],
        )
        shapes = {
            "axes": (n_free, n_inputs),
            "modes": (n_free, n_outputs),
            **self._shapes(state, n_inputs, n_outputs),
        }
        if set(state) != set(shapes):
            raise InvalidInputError(
                f"the arrays must be {', '.join(sorted(shapes))}; got {', '.join(sorted(state))}."
            )
        for name, shape in shapes.items():
            array, dtype = state[name], np.dtype(np.int32 if name in self.integers else np.float64)
            if array.shape != shape or array.dtype != dtype or not np.isfinite(array).all():
                raise InvalidInputError(
                    f"`{name}` must be a finite {dtype} array of shape {shape}; got {array.dtype} of shape {array.shape}."
                )
        self._take(state)
        self.axes_, self.modes_ = state["axes"], state["modes"]
        if self.input == "linear-response" and not hasattr(self, "compliance_"):
            self.compliance_ = linear_response(self.scene_)
        self._from_forces = self._to_coordinates(self.axes_)
        self._expanding = np.ascontiguousarray(self._on_all_dofs(self.modes_).T)
