"""Linear response to loads on few nodes, as a sum of precomputed columns of the compliance K₀⁻¹.

A load of a scene acts on some ten nodes of its load patches. A sum of thirty columns is then faster
than a back-solve with both triangles of a factor.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.counting import count, counted, is_counting, uncounted
from mor_bench.mechanics.banded import BandedFactor
from mor_bench.mechanics.linear import SparseFactor
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.dofs import dofs_of_nodes

Array = NDArray[np.float64]

MAX_BYTES = 256 * 2**20
"""Memory limit for the columns, bytes; if they need more, every response is a back-solve."""

_FIXED, _ELSEWHERE = -1, -2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _respond(columns, place, most, loads, out, used):
    """Sum columns (n_kept, m) for each of the loads (n, n_dofs); write them to out (n, m).

    ``used`` (n,) receives the number of columns, or -1 if the load needs a back-solve.
    """
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
        for k in range(0, whole, 4):  # four at once load and store u once for four multiply-adds
            a, b = columns[rows[k]], columns[rows[k + 1]]
            c, d = columns[rows[k + 2]], columns[rows[k + 3]]
            fa, fb, fc, fd = forces[k], forces[k + 1], forces[k + 2], forces[k + 3]
            for dof in range(len(u)):
                u[dof] += fa * a[dof] + fb * b[dof] + fc * c[dof] + fd * d[dof]
        for k in range(whole, n):
            a, fa = columns[rows[k]], forces[k]
            for dof in range(len(u)):
                u[dof] += fa * a[dof]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _project(matrix, loads, out):
    """Write loads (n, n_dofs) @ matrix (n_dofs, r) to out (n, r); return the non-zeros of loads."""
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
    """Return the product of sparse loads, stored densely, with a matrix.

    Parameters
    ----------
    matrix : (n_dofs, r) float64, in C order
        Zero at the supports, e.g. from `Compliance.to_coordinates`.
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
    """K₀⁻¹ of a scene, with K₀ the stiffness at rest.

    It keeps the columns of K₀⁻¹ at the nodes of the load patches. Loads on other nodes need a
    back-solve. Loads on many nodes also use one, if it takes fewer multiplications. All loads use
    back-solves if the columns exceed `MAX_BYTES`, or if the solver is iterative. Both ways agree
    to round-off.

    Parameters
    ----------
    model : FullOrderModel

    Attributes
    ----------
    columns : (n_kept, n_dofs) float64
        One kept column of K₀⁻¹ in each row, m/N, zero at the supports; may be empty.
    """

    def __init__(self, model: FullOrderModel) -> None:
        self._scene, self._factor = model.scene, model.rest_factor
        self._free = model.scene.free_dofs
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
        """Return the linear responses K₀⁻¹f.

        Parameters
        ----------
        loads : (n, n_dofs) float64
            Nodal forces, N; forces on supports are ignored.

        Returns
        -------
        (n, n_dofs) float64
            Displacements, m, exactly zero at the supports.
        """
        if (frames := self._scene.frames) is not None:
            return frames.to_global(self._respond(frames.to_local(loads)))
        return self._respond(loads)

    def at(self, dofs: NDArray[np.int64] | None) -> Callable[[Array], Array]:
        """Return a function of loads (n, n_dofs), N, that gives `respond` at some dofs only, m.

        None stands for all dofs.
        """
        if dofs is None:
            return self.respond
        if self._scene.frames is not None or not len(self.columns):
            return lambda loads: self.respond(loads)[:, dofs]
        columns = np.ascontiguousarray(self.columns[:, dofs])

        def respond(loads: Array) -> Array:
            out, others = self._summed(columns, loads)
            if others.any():
                out[others] = self.respond(loads[others])[:, dofs]
            return out

        return respond

    def _summed(self, columns: Array, loads: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return sums of columns (n_kept, m), and which loads need a back-solve instead."""
        loads = np.ascontiguousarray(loads)  # the kernel is compiled once per memory order
        out = np.empty((len(loads), columns.shape[1]))
        used = np.empty(len(loads), dtype=np.int64)
        _respond(columns, self._place, self._most, loads, out, used)
        others = used < 0
        if is_counting():
            moving = min(columns.shape[1], len(self._free))
            count(multiply_adds=int(used[~others].sum()) * moving)
        return out, others

    def _respond(self, loads: Array) -> Array:
        """Return responses in the frames of the nodes, as the loads are."""
        out, others = self._summed(self.columns, loads)
        if others.any():
            rows = np.flatnonzero(others)
            out[rows[:, None], self._free] = self._factor.solve(
                loads[rows[:, None], self._free].T
            ).T
        return out

    def solve(self, rhs: Array) -> Array:
        """Map forces (n_free,) or (n_free, m), N, to displacements, m, like a `Factor`."""
        loads = np.zeros((rhs.size // len(self._free), len(self._place)))
        loads[:, self._free] = rhs.T
        return np.ascontiguousarray(self._respond(loads)[:, self._free].T).reshape(rhs.shape)

    def to_coordinates(self, axes: Array) -> Array:
        """Return K₀⁻¹A on all dofs, zero at the supports.

        `project` with this matrix gives Aᵀ K₀⁻¹f without computing K₀⁻¹f.

        Parameters
        ----------
        axes : (n_free, r) float64
            A.

        Returns
        -------
        (n_dofs, r) float64
        """
        with uncounted():
            found = self._factor.solve(axes)
        return self._scene.columns_at_all_dofs(found)
