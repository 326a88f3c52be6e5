"""What the hyper-reduced methods share: training snapshots, nodal modes, a model over chosen cells, loads to coordinates and back."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.assembly import discretisation_of
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import CubatureProblem
from mor_bench.reduction.points import ReducedPoints
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto, size_to_needs
from mor_bench.reduction.subspace import Subspace, extent_of
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import NO_EQUATIONS
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]


def projected(displacements: Array, modes: Array) -> Array:
    """(n, r) coordinates of displacements (n, n_free) in a basis (n_free, r) with orthonormal columns."""
    return displacements @ modes


def training_coordinates(displacements: Array, modes: Array, n_snapshots: int) -> Array:
    """Coordinates of at most ``n_snapshots`` snapshots, spread evenly over those that are not zero, (n, r)."""
    moved = np.flatnonzero(displacements.any(axis=1))
    chosen = np.unique(np.linspace(0, len(moved) - 1, n_snapshots).astype(int))
    return projected(displacements[moved[chosen]], modes)


def checked_indices(indices: NDArray[Any], name: str, size: int) -> NDArray[np.int64]:
    """Different integers in [0, size), in one dimension, at least one."""
    good = indices.dtype.kind == "i" and indices.ndim == 1 and len(indices) > 0
    if (
        not good
        or indices.min() < 0
        or indices.max() >= size
        or len(np.unique(indices)) != len(indices)
    ):
        raise InvalidInputError(f"`{name}` must be different integers in [0, {size - 1}].")
    return indices.astype(np.int64)


def checked_array(array: NDArray[Any], name: str, shape: tuple[int | None, ...]) -> Array:
    """A finite float64 array of this shape; None leaves a length open."""
    fits = array.ndim == len(shape) and all(
        n in (m, None) or m is None for n, m in zip(array.shape, shape, strict=True)
    )
    if array.dtype != np.float64 or not fits or 0 in array.shape or not np.isfinite(array).all():
        raise InvalidInputError(
            f"`{name}` must be a finite float64 array of shape {shape}; got {array.dtype} of shape {array.shape}."
        )
    return np.ascontiguousarray(array)


def nodal(scene: Scene, rows: Array) -> Array:
    """(n_nodes, 3, r) from a row for each free dof; zero at supports."""
    full = np.zeros((scene.mesh.n_dofs, rows.shape[1]))
    full[scene.free_dofs] = rows
    return full.reshape(scene.mesh.n_nodes, 3, -1)


def reduced_points(
    scene: Scene,
    cells: NDArray[np.int64],
    weights: Array,
    modes: Array,
    test_modes: Array | None = None,
) -> ReducedPoints:
    """The scene's law over some of its cells, with nodal modes and test modes (n_nodes, 3, r)."""
    return ReducedPoints(discretisation_of(scene, cells), weights, modes, test_modes)


CUBATURE_TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3)
"""To choose from."""


class CubatureSurrogate(Surrogate):
    """POD-Galerkin over weighted cells; a subclass says how cells and weights are trained.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis; capped at the snapshots' rank with a warning. "auto", here and of the tolerances: as little work as
        meets the scene's need, see `mor_bench.reduction.sizing`.
    cubature_tolerance : float or "auto"
        What the cubature may miss; smaller keeps more cells: slower and closer to plain POD.
    n_cubature_snapshots : int
        Training snapshots whose reduced forces are matched, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load.
    """

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1)] | Auto = 20,
        cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] | Auto = 1e-3,
        n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300,
        tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8,
    ) -> None:
        self.n_modes = n_modes
        self.cubature_tolerance = cubature_tolerance
        self.n_cubature_snapshots = n_cubature_snapshots
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    @abstractmethod
    def _train(
        self, model: FullOrderModel, modes: Array, q: Array, tolerance: float
    ) -> tuple[NDArray[np.int64], Array]:
        """Cells, and their positive weights (n,) or those of their points (n, n_cell_points), from snapshots q in the basis."""

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            known = self._checked_snapshots(snapshots)
            rungs = {
                "n_modes": MODES,
                "cubature_tolerance": CUBATURE_TOLERANCES,
                "tolerance": TOLERANCES,
            }
            displacements, knobs = (
                known.free_displacements,
                size_to_needs(self, scene, known, rungs),
            )
            modes = pod(displacements, knobs["n_modes"]).modes
            if knobs["cubature_tolerance"] == 0:
                cells, weights = np.arange(scene.mesh.n_cells), np.ones(scene.mesh.n_cells)
            else:
                q = training_coordinates(displacements, modes, self.n_cubature_snapshots)
                cells, weights = self._train(
                    FullOrderModel(scene), modes, q, knobs["cubature_tolerance"]
                )
            self._restore({"modes": modes, "cells": cells, "weights": weights})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        options = NewtonOptions(self.tolerance_)
        return self._subspace.answer(
            batch, lambda load: self.problem_.solve(load, options).displacement
        ).reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_, "cells": self.cells_, "weights": self.weights_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.modes_ = checked_array(state["modes"], "modes", (len(self.scene_.free_dofs), None))
        self.cells_ = checked_indices(state["cells"], "cells", self.scene_.mesh.n_cells)
        self.weights_ = checked_array(
            state["weights"], "weights", (len(self.cells_), None)[: state["weights"].ndim]
        )
        if not (
            (self.weights_ >= 0).all()
            and self.weights_.reshape(len(self.cells_), -1).any(axis=1).all()
        ):
            raise InvalidInputError(
                "`weights` must be positive for a cell, or for some of its points."
            )
        self.tolerance_ = self._sized("tolerance")
        self._subspace = Subspace(self.scene_, self.modes_)
        points = reduced_points(
            self.scene_, self.cells_, self.weights_, nodal(self.scene_, self.modes_)
        )
        self.problem_ = CubatureProblem(points, extent_of(self.scene_))
        _ = self.problem_.rest_factor
