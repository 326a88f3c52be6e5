"""Reference elements and shape functions: H8 with 2x2x2 Gauss points, T4 with one, T10 with 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.interpolation import quadratic, trilinear
from mor_bench.scene.mesh import HEX_CORNERS, TET_EDGES

Array = NDArray[np.float64]


ROUND_OFF = 1e-14
"""Distance of a node from the middle of its edge by round-off, relative to the extent of a mesh."""


@dataclass(frozen=True)
class Element:
    """A reference element with its quadrature.

    Attributes
    ----------
    name : str
    derivatives : (n_points, n_nodes, 3) float64
        Derivatives of the shape functions at the quadrature points.
    weights : (n_points,) float64
        Quadrature weights; their sum is the reference cell's volume.
    centre : (n_nodes, 3) float64
        Derivatives of the shape functions at the centroid.
    values : (n_points, n_nodes) float64
        Shape functions at the quadrature points.
    """

    name: str
    derivatives: Array
    weights: Array
    centre: Array
    values: Array

    @property
    def n_nodes(self) -> int:
        return int(self.derivatives.shape[1])


_LINEAR = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

GAUSS = (2.0 * HEX_CORNERS - 1.0) / np.sqrt(3.0)

_VALUES, _DERIVATIVES = trilinear(GAUSS)
H8 = Element("H8", _DERIVATIVES, np.ones(8), trilinear(np.zeros((1, 3)))[1][0], _VALUES)
T4 = Element("T4", _LINEAR[None], np.array([1.0 / 6.0]), _LINEAR, np.full((1, 4), 0.25))

# Exact for quadratic polynomials (Hammer, Marlowe and Stroud 1956).
_NEAR, _FAR = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
_FOUR = np.full((4, 3), _NEAR) + (_FAR - _NEAR) * np.eye(4, 3, -1)
_VALUES, _DERIVATIVES = quadratic(_FOUR)
T10 = Element(
    "T10", _DERIVATIVES, np.full(4, 1.0 / 24.0), quadratic(np.full((1, 3), 0.25))[1][0], _VALUES
)


def element_of(cells: NDArray[np.int64]) -> Element:
    """Return the element with as many nodes as the cells.

    Raises
    ------
    InvalidInputError
        If no element has that number of nodes.
    """
    for element in (H8, T4, T10):
        if cells.ndim == 2 and cells.shape[1] == element.n_nodes:
            return element
    raise InvalidInputError(
        "cells must have shape (n_cells, 8) for H8, (n_cells, 4) for T4 or (n_cells, 10) for T10; "
        f"got {cells.shape}."
    )


def is_straight(points: Array, cells: NDArray[np.int64]) -> bool:
    """Return whether all cells are tetrahedra with straight edges and nodes in their middles."""
    if cells.shape[1] not in (T4.n_nodes, T10.n_nodes):
        return False
    middles = points[cells[:, TET_EDGES]].mean(axis=2)[:, : cells.shape[1] - 4]
    off = np.abs(points[cells[:, 4:]] - middles[:, : cells.shape[1] - 4])
    return bool(off.max(initial=0.0) <= ROUND_OFF * np.ptp(points, axis=0).max())


def shape_gradients(
    points: Array, cells: NDArray[np.int64], derivatives: Array
) -> tuple[Array, Array]:
    """Return the gradients of the shape functions in the reference configuration, and det J.

    Parameters
    ----------
    points : (n_nodes, 3) float64
    cells : (n_cells, n_cell_nodes) int
    derivatives : (n_points, n_cell_nodes, 3) or (n_cells, n_points, n_cell_nodes, 3) float64
        The same points in every cell, or own points for each.

    Returns
    -------
    gradients : (n_cells, n_points, n_cell_nodes, 3) float64
        dN_a/dX, 1/m.
    det_j : (n_cells, n_points) float64
        m³.

    Raises
    ------
    InvalidInputError
        If det J is not positive at some point: the cell is inverted or degenerate.
    """
    jacobian = points[cells].swapaxes(1, 2)[:, None] @ derivatives  # [k, i] = dX_k / dξ_i
    a, b, c = np.moveaxis(jacobian, -1, 0)
    adjugate = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
    det_j = (a * adjugate[..., 0, :]).sum(axis=-1)
    # The det J of a flat cell is of round-off size rather than zero.
    least = 1e-12 * np.linalg.norm(jacobian, axis=(2, 3)) ** 3
    if not np.all(det_j > least):
        cell, point = np.argwhere(~(det_j > least))[0]
        raise InvalidInputError(
            f"cell {cell} is inverted or degenerate: det J must be > 0 m³; "
            f"got {det_j[cell, point]:.3g} at quadrature point {point}."
        )
    return derivatives @ (adjugate / det_j[..., None, None]), det_j
