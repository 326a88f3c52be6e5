"""A regular grid over any mesh: maps forces to grid points, and displacements to nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import prod

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.mesh import KUHN, Mesh, box_mesh

MAX_POINTS = 1_000_000
"""Largest number of grid points; with 128 channels, this many points need half a gigabyte."""


@dataclass(frozen=True)
class GridMap:
    """A regular grid, and the values N of its trilinear shape functions at the nodes of a mesh.

    Attributes
    ----------
    shape : (int, int, int)
        Points per axis.
    weights : (n_nodes, n_grid) sparse float
        N; each row sums to 1. Grid points are numbered in C order.
    """

    shape: tuple[int, int, int]
    weights: sp.csr_array

    @cached_property
    def _transposed(self) -> sp.csr_array:
        return sp.csr_array(self.weights.T)

    def forces_to_grid(self, forces: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return Nᵀ f, forces (n, n_grid, 3) at the grid points with the same sum and moment, N.

        Parameters
        ----------
        forces : (n, n_nodes, 3) float
            Nodal forces, N.

        Raises
        ------
        InvalidInputError
            If the shape is wrong.
        """
        return _product(self._transposed, forces)

    def displacements_to_nodes(self, displacements: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return N u, displacements (n, n_nodes, 3) of the nodes, m.

        Parameters
        ----------
        displacements : (n, n_grid, 3) float
            Displacements of the grid points, m.

        Raises
        ------
        InvalidInputError
            If the shape is wrong.
        """
        return _product(self.weights, displacements)


def _product(matrix: sp.csr_array, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Map (n, columns, 3) to (n, rows, 3). The order of summation does not depend on threads."""
    rows, columns = matrix.shape
    if values.ndim != 3 or values.shape[1:] != (columns, 3):
        raise InvalidInputError(
            f"the values must have shape (n, {columns}, 3); got {values.shape}."
        )
    product = matrix @ values.transpose(1, 0, 2).reshape(columns, 3 * len(values))
    return np.ascontiguousarray(product.reshape(rows, len(values), 3).transpose(1, 0, 2))


def grid_map(mesh: Mesh, shape: tuple[int, int, int] | None = None) -> GridMap:
    """Return the mesh's own regular grid, or a grid over its bounding box.

    Parameters
    ----------
    mesh : Mesh
    shape : three ints, optional
        Points per axis. Default: those of the mesh's own grid, or else `default_shape`.

    Returns
    -------
    GridMap
        On the mesh's own grid every weight is exactly 1.

    Raises
    ------
    SpecError
        If the grid has fewer than 2 points along an axis, or more than `MAX_POINTS`.
    InvalidInputError
        If `default_shape` is needed and the body has no volume.
    """
    own, index = mesh.grid_shape, mesh.grid_index
    if own is not None and index is not None and shape in (None, own):
        ones = np.ones(mesh.n_nodes), (np.arange(mesh.n_nodes), index)
        return GridMap(own, sp.csr_array(ones, shape=(mesh.n_nodes, prod(own))))
    nx, ny, nz = default_shape(mesh) if shape is None else shape
    if min(nx, ny, nz) < 2 or nx * ny * nz > MAX_POINTS:
        raise SpecError(
            f"a regular grid must have at least 2 points per axis and at most {MAX_POINTS:,} "
            f"in all; got {nx} x {ny} x {nz}."
        )
    low, high = mesh.bounds
    length_x, length_y, length_z = (float(length) for length in high - low)
    # Rounding is monotone, so nodes on the bounding box stay in this box.
    box = box_mesh((length_x, length_y, length_z), (nx - 1, ny - 1, nz - 1))
    return GridMap((nx, ny, nz), interpolation_matrix(box, mesh.points - low))


def default_shape(mesh: Mesh) -> tuple[int, int, int]:
    """Return the points per axis of a grid about as dense as the nodes of the body.

    Each node owns a cube of edge h = (volume of the body / n_nodes)^(1/3). An axis of length L gets
    round(L / h) points, at least 2. A coarser grid may be better for a short training.

    Raises
    ------
    InvalidInputError
        If the volume of the body is not positive.
    """
    volume = _volume(mesh)
    if not volume > 0:
        raise InvalidInputError(f"the volume of the mesh must be positive; got {volume:g} m³.")
    spacing = (volume / mesh.n_nodes) ** (1 / 3)
    nx, ny, nz = (max(2, round(float(length) / spacing)) for length in np.ptp(mesh.bounds, axis=0))
    return nx, ny, nz


def _volume(mesh: Mesh) -> float:
    """Return the volume of the body, m³, with straight edges and hexahedra cut into six T4."""
    hexahedra = mesh.cells.shape[1] == 8
    tetrahedra = mesh.cells[:, KUHN].reshape(-1, 4) if hexahedra else mesh.cells[:, :4]
    corners = mesh.points[tetrahedra]
    return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6)
