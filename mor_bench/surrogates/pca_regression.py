"""PCA regression: a ridge regression from a few coordinates of the input to a few coordinates of the displacement."""

from __future__ import annotations

from math import comb
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import forward_model
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


def monomial_indices(n_variables: int, degree: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """For each degree from 2 on: which monomial of the degree below, times which variable, gives each monomial."""
    levels = []
    last = np.arange(n_variables)
    for _ in range(degree - 1):
        parents = np.concatenate([np.flatnonzero(last <= v) for v in range(n_variables)])
        variables = np.repeat(np.arange(n_variables), [int((last <= v).sum()) for v in range(n_variables)])
        levels.append((parents, variables))
        last = variables
    return levels


def monomials(z: NDArray[np.float64], levels: list[tuple[NDArray[np.int64], NDArray[np.int64]]]) -> NDArray[np.float64]:
    """All monomials of degree 1 and more of the variables z (n, n_variables), (n, n_monomials)."""
    powers = [z]
    for parents, variables in levels:
        powers.append(powers[-1][:, parents] * z[:, variables])
    return np.concatenate(powers, axis=1)


class PCARegression(Surrogate):
    """Polynomial ridge regression between principal coordinates, without means: no force gives no displacement.

    With the linear response as input, u = K₀⁻¹f + Φ W p(z): z are coordinates of the linear response K₀⁻¹f, p their
    monomials, and only the nonlinear rest is learned; the response to any force is at least that of linear elasticity.
    In a scene with observed nodes their displacements take the place of the force, and the linear extension of these that of
    the linear response.

    With the force as input, u = Φ W p(z) with z the coordinates of the force itself: between load regions that share no
    training sample this learns nothing.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int
        Length of z; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the displacement, or of its nonlinear rest; capped at the rank with a warning.
    degree : int
        Highest degree of the monomials.
    ridge : float
        Tikhonov weight relative to the mean squared feature, with features scaled to unit root mean square.
    """

    takes_observations = True

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        degree: Annotated[int, Field(ge=1, le=4)] = 3,
        ridge: Annotated[float, Field(ge=0)] = 1e-6,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.degree = degree
        self.ridge = ridge

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True) if self.input == "linear-response" else None

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        from sklearn.linear_model import Ridge

        with self._fitting(scene):
            snapshots = self._checked_snapshots(snapshots)
            forces, targets = snapshots.free_inputs, snapshots.free_displacements
            if self.input == "linear-response":
                inputs = forward_model(scene).linear_response(forces)
                targets = targets - inputs
            else:
                inputs = forces
            used = np.flatnonzero(inputs.any(axis=0))  # of forces only a few columns
            modes = pod(inputs[:, used], self.n_input_modes).modes
            axes = np.zeros((inputs.shape[1], modes.shape[1]))
            axes[used] = modes / np.sqrt(((inputs[:, used] @ modes) ** 2).mean(axis=0))
            features = monomials(inputs @ axes, monomial_indices(axes.shape[1], self.degree))
            feature_scale = np.sqrt((features**2).mean(axis=0))
            modes = pod(targets, self.n_output_modes).modes
            regression = Ridge(alpha=self.ridge * len(features), fit_intercept=False, solver="cholesky")
            regression.fit(features / feature_scale, targets @ modes)
            weights = np.atleast_2d(regression.coef_) / feature_scale
            self._restore({"axes": axes, "modes": modes, "weights": weights})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        free = batch[:, self.scene_.free_dofs]
        out = np.zeros_like(batch)
        if counting.running is not None:
            monomial_products = self.weights_.shape[1] - self.axes_.shape[1]
            products = self.axes_.size + monomial_products + self.weights_.size + self.modes_.size
            counting.running.add(multiply_adds=len(batch) * products)
        inputs = self.model_.linear_response(free) if self.input == "linear-response" else free
        nonlinear = (monomials(inputs @ self.axes_, self._levels) @ self.weights_.T) @ self.modes_.T
        out[:, self.scene_.free_dofs] = inputs + nonlinear if self.input == "linear-response" else nonlinear
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"axes": self.axes_, "modes": self.modes_, "weights": self.weights_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_axes, n_modes = len(self.scene_.free_dofs), state["axes"].shape[1], state["modes"].shape[1]
        n_features = sum(comb(n_axes + d - 1, d) for d in range(1, self.degree + 1))
        for name, shape in {"axes": (n_free, n_axes), "modes": (n_free, n_modes), "weights": (n_modes, n_features)}.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}.")
        self.axes_, self.modes_, self.weights_ = state["axes"], state["modes"], state["weights"]
        self._levels = monomial_indices(n_axes, self.degree)
        if self.input == "linear-response":
            self.model_ = forward_model(self.scene_)
