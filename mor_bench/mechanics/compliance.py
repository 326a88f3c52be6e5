"""The linear response to loads on few nodes, as a sum of columns of the compliance K₀⁻¹ that are computed once.

The loads of a scene act on the nodes of its load patches, and each on some ten of them: a sum of thirty columns takes the place of a
back-solve through both triangles of a factor. On beam-coarse, l-shape, liver-hex and beam-fine a response takes 0.005, 0.007, 0.06
and 0.2 ms in place of 0.04, 0.26, 0.8 and 10; the columns take 0.03, 0.06, 1 and 3 s to make and 1, 2, 45 and 98 MB to keep
(one thread of a busy machine).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.counting import count, counted, is_counting, uncounted
from mor_bench.mechanics.linear import BandedFactor, SparseFactor
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.dofs import dofs_of_nodes

Array = NDArray[np.float64]

MAX_BYTES = 256 * 2**20
"""Of the columns; where they need more, every response is a back-solve."""

_FIXED, _ELSEWHERE = -1, -2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _respond(columns, place, most, loads, out, used):
    """Sum columns (n_kept, n_dofs) for each of the loads (n, n_dofs); used (n,) is their number, or -1 where that cannot be done."""
    rows, forces = np.empty(most, np.int64), np.empty(most)
    for i in range(len(loads)):
        load, u, n = loads[i], out[i], 0
        for dof in range(len(load)):
            if load[dof] != 0.0 and place[dof] != _FIXED:
                if n == most or place[dof] == _ELSEWHERE:
                    n = -1
                    break
                rows[n], forces[n] = place[dof], load[dof]
                n += 1
        used[i] = n
        u[:] = 0.0
        whole = n - n % 4 if n > 0 else 0
        for k in range(
            0, whole, 4
        ):  # four at once, so that u is loaded and stored once for four multiply-adds
            a, b, c, d = (
                columns[rows[k]],
                columns[rows[k + 1]],
                columns[rows[k + 2]],
                columns[rows[k + 3]],
            )
            fa, fb, fc, fd = forces[k], forces[k + 1], forces[k + 2], forces[k + 3]
            for dof in range(len(u)):
                u[dof] += fa * a[dof] + fb * b[dof] + fc * c[dof] + fd * d[dof]
        for k in range(whole, n):
            a, fa = columns[rows[k]], forces[k]
            for dof in range(len(u)):
                u[dof] += fa * a[dof]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _project(matrix, loads, out):
    """out (n, r) = loads (n, n_dofs) @ matrix (n_dofs, r) over the components that are not zero; returns their number."""
    n = 0
    for i in range(len(loads)):
        load, z = loads[i], out[i]
        z[:] = 0.0
        for dof in range(len(load)):
            if load[dof] != 0.0:
                n += 1
                for k in range(matrix.shape[1]):
                    z[k] += load[dof] * matrix[dof, k]
    return n


def project(matrix: Array, loads: Array) -> Array:
    """The product of loads, most of whose components are zero, with a matrix.

    Parameters
    ----------
    matrix : (n_dofs, r) float64, in C order
        With rows of zeros at the supports, e.g. from `Compliance.to_coordinates`.
    loads : (n, n_dofs) float64
        Nodal forces, N.

    Returns
    -------
    (n, r) float64
    """
    out = np.empty((len(loads), matrix.shape[1]))
    n_loaded = int(_project(matrix, np.ascontiguousarray(loads), out))
    if is_counting():
        count(multiply_adds=n_loaded * matrix.shape[1])
    return out


class Compliance:
    """K₀⁻¹ of a scene, with K₀ the stiffness at rest: columns at the dofs of the nodes that its load patches touch, and a factor.

    A load anywhere else, or on so many nodes that a back-solve takes fewer multiplications, is answered by a back-solve; so is
    every load where the columns would need more than `MAX_BYTES`, or where only an iterative solver is at hand. Both agree to
    round-off.

    Parameters
    ----------
    model : FullOrderModel

    Attributes
    ----------
    columns : (n_kept, n_dofs) float64
        One column in each row, m/N, zero at the supports; without rows where none are kept.
    """

    def __init__(self, model: FullOrderModel) -> None:
        self._factor, self._free = model.rest_factor, model.scene.free_dofs
        n_dofs, n_free = model.scene.mesh.n_dofs, len(self._free)
        kept = dofs_of_nodes(np.unique(model.scene.patch_weights.indices))
        kept = kept[np.isin(kept, self._free)]
        if (
            not isinstance(self._factor, BandedFactor | SparseFactor)
            or 8 * len(kept) * n_dofs > MAX_BYTES
        ):
            kept = kept[:0]
        self._place = np.full(n_dofs, _FIXED, dtype=np.int32)
        self._place[self._free] = _ELSEWHERE
        self._place[kept] = np.arange(len(kept))
        units = np.zeros((n_free, len(kept)))
        units[np.searchsorted(self._free, kept), np.arange(len(kept))] = 1.0
        self.columns = np.zeros((len(kept), n_dofs))
        with uncounted():
            if len(kept):
                self.columns[:, self._free] = self._factor.solve(units).T
            with counted() as one:
                self._factor.solve(np.ones(n_free))
        self._most = min(len(kept), one.multiply_adds // n_free)

    def respond(self, loads: Array) -> Array:
        """K₀⁻¹ f.

        Parameters
        ----------
        loads : (n, n_dofs) float64
            Nodal forces, N; those on supports are not looked at.

        Returns
        -------
        (n, n_dofs) float64
            m, exactly zero at the supports.
        """
        loads = np.ascontiguousarray(loads)  # of one memory order the kernel is compiled once
        out, used = np.empty(loads.shape), np.empty(len(loads), dtype=np.int64)
        _respond(self.columns, self._place, self._most, loads, out, used)
        others = used < 0
        if is_counting():
            count(multiply_adds=int(used[~others].sum()) * len(self._free))
        if others.any():
            rows = np.flatnonzero(others)
            out[rows[:, None], self._free] = self._factor.solve(
                loads[rows[:, None], self._free].T
            ).T
        return out

    def solve(self, rhs: Array) -> Array:
        """As `respond`, on the free dofs and as a factor does it: (n_free,) or (n_free, m) in, N, the same shape out, m."""
        loads = np.zeros((rhs.size // len(self._free), len(self._place)))
        loads[:, self._free] = rhs.T
        return np.ascontiguousarray(self.respond(loads)[:, self._free].T).reshape(rhs.shape)

    def to_coordinates(self, axes: Array) -> Array:
        """K₀⁻¹ A on all dofs, zero at the supports: `project` by it is Aᵀ K₀⁻¹ f, without the response itself.

        Parameters
        ----------
        axes : (n_free, r) float64
            A.

        Returns
        -------
        (n_dofs, r) float64
        """
        out = np.zeros((len(self._place), axes.shape[1]))
        with uncounted():
            out[self._free] = self._factor.solve(axes)
        return out
