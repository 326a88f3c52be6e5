"""Cells of a body with their material, and gradients and weights at their quadrature points."""

from __future__ import annotations

from dataclasses import dataclass
from math import lcm

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import UnsupportedSceneError
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.scene.constant_pressures import HeldPressure, followers_of
from mor_bench.scene.interpolation import trilinear
from mor_bench.scene.materials import Material
from mor_bench.scene.scene import Scene
from mor_bench.specs import NO_EQUATIONS

Array = NDArray[np.float64]

FOLLOWS = "its pressures follow the surface, and the method solves for dead loads only"


@dataclass(frozen=True)
class Discretisation:
    """Cells of a mesh, their material and how they are integrated.

    Attributes
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8), (n_cells, 4) or (n_cells, 10) int
        Nodes of the H8, T4 or T10 cells to sum over.
    material : Material
    selective : bool
        Whether the volumetric energy is integrated with mean gradients, which cures volumetric
        locking of H8.
    springs : (n_dofs, n_dofs) sparse float64, optional
        Stiffness of springs on the surface, N/m.
    followers : tuple of HeldPressure
        Constant pressures that follow the surface. Their forces count as internal ones.
    rest : (n_nodes, 3) float64, optional
        Displacements of a rest state under a constant pre-load, m. Displacements and forces are
        then measured from it.
    positions : (n_cells, 3) float64, optional
        One point of each cell in [-1, 1]³ with weight 1, instead of the element's own quadrature.
        Only for H8 with full integration. A cell may occur several times in `cells`.
    """

    points: Array
    cells: NDArray[np.int64]
    material: Material
    selective: bool = False
    springs: sp.csr_array | None = None
    followers: tuple[HeldPressure, ...] = ()
    rest: Array | None = None
    positions: Array | None = None

    @property
    def n_cell_points(self) -> int:
        """Number of quadrature points of a cell, without the mean of selective integration."""
        return 1 if self.positions is not None else len(element_of(self.cells).weights)


def discretisation_of(
    scene: Scene, chosen: NDArray[np.int64] | slice = slice(None)
) -> Discretisation:
    """Return the discretisation of all cells of a scene, or of the chosen ones.

    Raises
    ------
    UnsupportedSceneError
        If the scene's snapshots were imported, so that its equations are unknown; or for chosen
        cells, if a constant pressure follows the surface.
    """
    if scene.material is None:
        raise UnsupportedSceneError(f"{scene.name}: {NO_EQUATIONS}.")
    mesh, followers = scene.mesh, followers_of(scene.constant_pressures)
    if followers and not isinstance(chosen, slice):
        raise UnsupportedSceneError(f"{scene.name}: {FOLLOWS}.")
    return Discretisation(
        mesh.points,
        mesh.cells[chosen],
        scene.material,
        scene.selective,
        scene.spring_matrix,
        followers,
    )


def constant_forces(scene: Scene) -> Array:
    """Return the weight and the constant dead pressures as nodal forces (n_nodes, 3), N."""
    gravity, found = scene.generated.gravity, np.zeros((scene.mesh.n_nodes, 3))
    if gravity is not None:
        density = gravity.density_kg_m3 * np.array(gravity.acceleration_m_s2)
        found += body_force(discretisation_of(scene), density)
    for held in scene.constant_pressures:
        if not held.follower:
            found += held.dead_forces(scene.mesh)
    return found


def body_force(body: Discretisation, density: Array) -> Array:
    """Return the nodal forces (n_nodes, 3), N, of a uniform force density (3,), N/m³."""
    element = element_of(body.cells)
    det_j = shape_gradients(body.points, body.cells, element.derivatives)[1]
    shares = (det_j * element.weights) @ element.values
    volumes = np.bincount(body.cells.ravel(), shares.ravel(), len(body.points))
    return np.asarray(volumes[:, None] * density)


@dataclass(frozen=True)
class Quadrature:
    """Gradients, weights and law parameters at the quadrature points of every cell.

    Attributes
    ----------
    gradients : (n_cells, n_points, n_nodes, 3) float64
    weights : (n_cells, n_points) float64
    parameters : (n_points, n_parameters) float64
    """

    gradients: Array
    weights: Array
    parameters: Array


def quadrature_of(body: Discretisation) -> Quadrature:
    """Return the quadrature of all cells, with full or selective integration.

    Selective integration takes the volumetric part from each cell's mean gradient, the rest at
    every point (B-bar: Hughes, IJNME 15, 1980). The energy is a sum of both parts, so the tangent
    stays symmetric. The pressure is constant in a cell and may oscillate between cells.
    """
    if body.positions is not None:
        derivatives = trilinear(body.positions)[1][:, None]
        gradients, det_j = shape_gradients(body.points, body.cells, derivatives)
        return Quadrature(gradients, det_j, law_parameters(body))
    element = element_of(body.cells)
    gradients, det_j = shape_gradients(body.points, body.cells, element.derivatives)
    weights = det_j * element.weights
    if not body.selective:
        return Quadrature(gradients, weights, law_parameters(body))
    # The gradient at the centre instead of the mean fails the patch test on warped cells.
    volume = weights.sum(axis=1)
    mean = np.einsum("cq,cqaj->caj", weights, gradients) / volume[:, None, None]
    return Quadrature(
        np.concatenate([gradients, mean[:, None]], axis=1),
        np.hstack([weights, volume[:, None]]),
        law_parameters(body),
    )


def law_parameters(body: Discretisation) -> Array:
    """Return the law's parameters (n_points, n_parameters) at the quadrature points of a cell."""
    material, n = body.material, body.n_cell_points
    if body.selective:
        return np.array([material.shape_parameters] * n + [material.volume_parameters])
    return np.array([material.parameters] * n)


SAME = 1e-12
"""Largest difference of equal gradients, relative to the largest one: round-off of positions."""


def distinct(gradients: Array, batch: int) -> Array:
    """Return the gradients (n_cells, ...) of all cells, or of a few batches if cells repeat.

    Kernels then read them from the cache instead of from memory. Boxes of hexahedra consist of
    equal cells; if each is divided into six tetrahedra, every sixth cell is the same.
    """
    atol = SAME * float(max(gradients.max(initial=0.0), -gradients.min(initial=0.0)))
    later = np.abs(gradients[1 : batch + 1] - gradients[:1]) <= atol
    equal = np.flatnonzero(later.all(axis=tuple(range(1, gradients.ndim))))
    if not len(equal):
        return gradients
    kept = lcm(int(equal[0]) + 1, batch)
    for start in range(0, len(gradients), kept):
        block = gradients[start : start + kept]
        if not (np.abs(block - gradients[np.arange(len(block)) % (equal[0] + 1)]) <= atol).all():
            return gradients
    return gradients[:kept]
