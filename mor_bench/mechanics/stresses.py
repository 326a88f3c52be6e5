"""Cauchy stresses at the centroids of the cells, from displacements at the nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.kernels import LANES
from mor_bench.mechanics.laws import point_stresses
from mor_bench.mechanics.model import rest_displacement
from mor_bench.scene.scene import Scene
from mor_bench.specs import NO_EQUATIONS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stresses:
    """Stresses at the centroids of the cells.

    Attributes
    ----------
    cauchy : (..., n_cells, 3, 3) float64
        Cauchy stress, Pa.

    Examples
    --------
    A body at rest has no stress:

    >>> import mor_bench
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> float(abs(stresses(scene, scene.mesh.points * 0.0).cauchy).max())
    0.0
    """

    cauchy: Array

    @property
    def von_mises(self) -> Array:
        """Equivalent stress √(3/2 s : s) of the deviator s, Pa, (..., n_cells)."""
        mean = np.trace(self.cauchy, axis1=-2, axis2=-1) / 3.0
        deviator = self.cauchy - mean[..., None, None] * np.eye(3)
        return np.asarray(np.sqrt(1.5 * np.einsum("...ij,...ij->...", deviator, deviator)))

    @property
    def principal(self) -> Array:
        """Principal stresses in ascending order, Pa, (..., n_cells, 3); NaN if not finite."""
        finite = np.isfinite(self.cauchy).all(axis=(-2, -1))
        found = np.full(self.cauchy.shape[:-1], np.nan)
        found[finite] = np.linalg.eigvalsh(self.cauchy[finite])
        return found


class CellDeformations:
    """Computes the deformation gradient at the centroid of every cell.

    That of a body with gravity contains the deformation of the rest state.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        mesh = scene.mesh
        centre = element_of(mesh.cells).centre[None]
        self._gradients = shape_gradients(mesh.points, mesh.cells, centre)[0][:, 0]
        rest = None if scene.material is None else rest_displacement(scene)
        self._rest = np.zeros_like(mesh.points) if rest is None else rest
        self._cells = mesh.cells

    def __call__(self, displacement: Array) -> Array:
        """Return F (n_cells, 3, 3) at a displacement (n_nodes, 3), m."""
        nodal = (self._rest + displacement)[self._cells]
        return np.asarray(np.eye(3) + np.einsum("cai,caj->cij", nodal, self._gradients))


class CellStresses:
    """Computes σ = P Fᵀ / det F at the centroid of every cell (Holzapfel 2000, section 3.1).

    Stresses of H8 converge fastest at the centroids (Barlow 1976). Those of a body with gravity
    contain the stress of the rest state. Where a displacement inverts a cell, the stress has no
    meaning, and may be infinite or NaN.

    Parameters
    ----------
    scene : Scene

    Attributes
    ----------
    volumes : (n_cells,) float64
        Volumes of the undeformed cells, m³.

    Raises
    ------
    UnsupportedSceneError
        If the scene's equations are unknown, or its material or shape varies between samples.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.material is None:
            raise UnsupportedSceneError(f"{scene.name}: {NO_EQUATIONS}.")
        if scene.parameter_names:
            raise UnsupportedSceneError(
                f"{scene.name}: stresses need one body, and `parameters` gives each sample its own."
            )
        mesh = scene.mesh
        element = element_of(mesh.cells)
        det_j = shape_gradients(mesh.points, mesh.cells, element.derivatives)[1]
        self.volumes = det_j @ element.weights
        self._shape = mesh.points.shape
        self._deformations = CellDeformations(scene)
        self._stresses = point_stresses(scene.material.law)
        self._parameters = np.array(scene.material.parameters)

    def __call__(self, displacements: Array) -> Stresses:
        """Return the stresses at displacements (n, n_nodes, 3), m.

        Raises
        ------
        InvalidInputError
            If the shape is wrong.
        """
        if displacements.ndim != 3 or displacements.shape[1:] != self._shape:
            raise InvalidInputError(
                f"displacements must have shape (n, {self._shape[0]}, 3); "
                f"got {displacements.shape}."
            )
        found = np.empty((len(displacements), len(self.volumes), 3, 3))
        for u, cauchy in zip(displacements, found, strict=True):
            cauchy[:] = self._cauchy(self._deformations(u))
        return Stresses(found)

    def _cauchy(self, F: Array) -> Array:
        """Return the stress (n, 3, 3) at deformation gradients (n, 3, 3)."""
        n = len(F)
        n_batches = -(-n // LANES)
        padded = np.zeros((n_batches * LANES, 9))
        padded[:n] = (F - np.eye(3)).reshape(n, 9)
        H = np.ascontiguousarray(padded.reshape(n_batches, LANES, 9).swapaxes(1, 2))
        P = np.empty((n_batches, 9 * LANES))
        parameters = np.tile(np.repeat(self._parameters, LANES), (n_batches, 1))
        self._stresses(H.reshape(n_batches, -1), np.ones((n_batches, LANES)), parameters, P, None)
        stress = P.reshape(n_batches, 9, LANES).swapaxes(1, 2).reshape(-1, 3, 3)[:n]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            cauchy = stress @ F.swapaxes(1, 2) / np.linalg.det(F)[:, None, None]
        return np.asarray(0.5 * (cauchy + cauchy.swapaxes(1, 2)))


def stresses(scene: Scene, displacements: ArrayLike) -> Stresses:
    """Return the stresses at the centroids of the cells.

    Parameters
    ----------
    scene : Scene
    displacements : (n_nodes, 3) or (n, n_nodes, 3)
        As predicted, m: without the rest state under gravity.

    Raises
    ------
    InvalidInputError
        If the shape is wrong.
    UnsupportedSceneError
        As `CellStresses`, which is faster for many calls.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> stresses(data.scene, data.test.displacements).cauchy.shape
    (40, 24, 3, 3)
    """
    u = np.asarray(displacements, dtype=np.float64)
    if u.ndim == 2:
        return Stresses(CellStresses(scene)(u[None]).cauchy[0])
    return CellStresses(scene)(u)
