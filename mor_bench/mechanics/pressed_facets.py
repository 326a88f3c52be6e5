"""Forces and tangents of pressures on facets that move with the body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.pattern import Pattern
from mor_bench.scene.constant_pressures import HeldPressure
from mor_bench.scene.triangle_rules import DEGREE_4, DEGREE_4_WEIGHTS, quadratic_triangle

Array = NDArray[np.float64]

_LEVI_CIVITA = np.zeros((3, 3, 3))
_LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_LEVI_CIVITA[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


def _rule(n_corners: int) -> tuple[Array, Array, float]:
    """Return values (n_points, n_corners), derivatives (..., 2) and the weight of each point.

    The rule is exact for the force on a facet: 2 x 2 Gauss points on a quadrilateral, one on a
    triangle, six on a triangle of six nodes. Those six differ in weight; their values contain it.
    """
    if n_corners == 6:
        shape, derivatives = quadratic_triangle(DEGREE_4)
        return shape * DEGREE_4_WEIGHTS[:, None], derivatives, 1.0
    if n_corners == 3:
        return np.full((1, 3), 1 / 3), np.array([[[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]]), 0.5
    at = (0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)).tolist()
    x, y = (np.array(axis).ravel() for axis in np.meshgrid(at, at))
    values = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
    along_x = np.stack([y - 1, 1 - y, y, -y], axis=1)
    along_y = np.stack([x - 1, -x, x, 1 - x], axis=1)
    return values, np.stack([along_x, along_y], axis=2), 0.25


class PressedFacets:
    """Nodal forces of pressures on facets that move: f = -p ∫ N (x_ξ × x_η) dξ dη.

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd edition (2008),
    sections 8.5.2 and 9.3.4.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Positions at rest, m.
    regions : sequence of (n_facets, 4, 3 or 6) int64
        Facets of each region, oriented outwards.
    dof_of_node : (n_nodes, 3) int64
        Row of each displacement component in the vectors; ``pattern.n`` at supports.
    pattern : Pattern
        Pattern of the stiffness.
    """

    def __init__(
        self,
        points: Array,
        regions: Sequence[NDArray[np.int64]],
        dof_of_node: NDArray[np.int64],
        pattern: Pattern,
    ) -> None:
        facets = np.concatenate(regions)
        self.region = np.repeat(np.arange(len(regions)), [len(own) for own in regions])
        self._values, self._derivatives, self._weight = _rule(facets.shape[1])
        self._points, self._dofs, self._n = points[facets], dof_of_node[facets], pattern.n
        dofs = self._dofs.reshape(len(facets), -1)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        self._kept = (rows <= columns) & (columns < pattern.n)
        keys = pattern.rows * pattern.n + pattern.indices
        wanted = rows[self._kept] * pattern.n + columns[self._kept]
        self._slots, self._n_values = np.searchsorted(keys, wanted), len(keys)

    def _tangents(self, q: Array) -> Array:
        """Return x_ξ and x_η, (n_facets, n_points, 2, 3), m, at displacements q."""
        corners = self._points + np.append(q, 0.0)[self._dofs]
        count(multiply_adds=self._derivatives.size * 3 * len(corners))
        return np.asarray(np.einsum("pad,fai->fpdi", self._derivatives, corners))

    def force(self, q: Array, pressures: Array) -> Array:
        """Return the forces (n,), N, of pressures (n_regions,), Pa, at displacements q (n,), m."""
        tangents = self._tangents(q)
        vectors = np.cross(tangents[:, :, 0], tangents[:, :, 1])
        scale = -self._weight * pressures[self.region]
        own = np.einsum("pa,fpi,f->fai", self._values, vectors, scale)
        count(multiply_adds=2 * vectors.size + own.size * len(self._values))
        total = np.bincount(self._dofs.ravel(), own.ravel(), minlength=self._n + 1)
        return np.asarray(total[: self._n], dtype=np.float64)

    def _moments(self, q: Array) -> Array:
        """Return the integrals (n_facets, n_corners, n_corners, 3) of N_a (N_b,ξ x_η - N_b,η x_ξ).

        Their cross products with the motion of corner b are the changes of the force at corner a.
        """
        tangents = self._tangents(q)
        spin = np.einsum("pb,fpk->fpbk", self._derivatives[:, :, 0], tangents[:, :, 1])
        spin -= np.einsum("pb,fpk->fpbk", self._derivatives[:, :, 1], tangents[:, :, 0])
        moments = np.einsum("pa,fpbk->fabk", self._values, spin)
        count(multiply_adds=2 * spin.size + moments.size * len(self._values))
        return np.asarray(moments)

    def _blocks(self, moments: Array, pressures: Array) -> Array:
        """Return the facets' matrices (n_facets, n_dofs, n_dofs) of moments under pressures."""
        own = np.einsum("ijk,fabk,f->faibj", _LEVI_CIVITA, moments, pressures[self.region])
        count(multiply_adds=own.size)
        return np.asarray(own).reshape(self._kept.shape)

    def stiffness(self, q: Array, pressures: Array) -> Array:
        """Return the symmetric part of -df/dq in the pattern, N/m.

        The whole is symmetric if the region is closed, or ends on supports or planes of symmetry.
        """
        moments = self._moments(q)
        skew = 0.5 * self._weight * (moments - moments.swapaxes(1, 2))
        entries = self._blocks(skew, pressures)[self._kept]
        return np.asarray(np.bincount(self._slots, entries, self._n_values), dtype=np.float64)

    def skew_stiffness(self, q: Array, pressures: Array) -> sp.csr_array:
        """Return the skew part of -df/dq, (n, n), N/m."""
        moments, n = self._moments(q), self._n
        even = 0.5 * self._weight * (moments + moments.swapaxes(1, 2))
        blocks, dofs = self._blocks(even, pressures), self._dofs.reshape(len(moments), -1)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        free = (rows < n) & (columns < n)
        return sp.csr_array((blocks[free], (rows[free], columns[free])), shape=(n, n))


class ConstantFollowers:
    """Constant pressures that follow the surface, as a part of the internal force.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Positions of the undeformed body, m.
    held : sequence of HeldPressure
    dof_of_node : (n_nodes, 3) int64
        As for `PressedFacets`.
    pattern : Pattern
    """

    def __init__(
        self,
        points: Array,
        held: Sequence[HeldPressure],
        dof_of_node: NDArray[np.int64],
        pattern: Pattern,
    ) -> None:
        self._facets = PressedFacets(points, [each.facets for each in held], dof_of_node, pattern)
        self._pressures = np.array([each.pressure_pa for each in held])
        self._n = pattern.n
        self.begin_at(np.zeros(pattern.n))

    def begin_at(self, rest: Array) -> None:
        """Count the work from a rest state with displacements (n,), m, and not from zero."""
        self._rest, self._begin = rest, self._facets.force(rest, self._pressures)

    def add(self, u: Array, force: Array, values: Array) -> float:
        """Add to the internal force and, where ``values`` is not empty, to the tangent.

        Parameters
        ----------
        u : (n,) float64
            Displacements, m.
        force : (n or more,) float64
        values : (n_values or more,) float64

        Returns
        -------
        float
            Minus the work, J, on the straight way from the rest state.
        """
        # The force is quadratic on this way, so that Simpson's rule is exact.
        way = u - self._rest
        middle, end = (
            self._facets.force(self._rest + part * way, self._pressures) for part in (0.5, 1.0)
        )
        force[: self._n] -= end
        if len(values):
            found = self._facets.stiffness(u, self._pressures)
            values[: len(found)] += found
        return -float((self._begin + 4.0 * middle + end) @ way) / 6.0

    def skew_stiffness(self, u: Array) -> sp.csr_array:
        """Return the skew part of the tangent, (n, n), N/m, at displacements (n,), m."""
        return self._facets.skew_stiffness(u, self._pressures)
