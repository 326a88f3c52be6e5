"""Linear subspaces of a scene: project loads, and expand coordinates to displacements."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count, is_counting
from mor_bench.mechanics.compliance import project
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]


def extent_of(scene: Scene) -> float:
    """Return the size of coordinates of orthonormal modes at displacements of the body's size."""
    return float(np.ptp(scene.mesh.points, axis=0).max() * np.sqrt(len(scene.free_dofs)))


def wanted_dofs(scene: Scene) -> NDArray[np.int64] | None:
    """Return the dofs of the nodes in ``scene.spec.needs.outputs``; None if those are all."""
    nodes = scene.output_nodes
    return None if len(nodes) == scene.mesh.n_nodes else dofs_of_nodes(nodes)


def at_wanted(values: Array, wanted: NDArray[np.int64] | None, n_dofs: int) -> Array:
    """Return values (n, n_wanted) of the wanted dofs on all dofs (n, n_dofs), else NaN."""
    if wanted is None:
        return values
    out = np.full((len(values), n_dofs), np.nan)
    out[:, wanted] = values
    return out


class Subspace:
    """The displacements u = Φq on the nodes of a scene.

    Loads act on few nodes. Only displacements in ``scene.spec.needs.outputs`` are expanded.

    Parameters
    ----------
    scene : Scene
    modes : (n_free, r) float64
        Φ on the free dofs.
    """

    def __init__(self, scene: Scene, modes: Array) -> None:
        self.n_modes = modes.shape[1]
        self._modes = scene.columns_at_all_dofs(modes)
        self._free = scene.free_dofs
        self._wanted = wanted_dofs(scene)
        self._expanding = self._modes if self._wanted is None else self._modes[self._wanted]

    def project(self, load: Array) -> Array:
        """Return Φᵀf (r,) of nodal forces (n_dofs,), N."""
        return np.asarray(project(self._modes, load[None])[0])

    def expand(self, q: Array, out: Array) -> None:
        """Write Φq to ``out`` (n_dofs,), m; NaN where no output is wanted."""
        if is_counting():
            count(multiply_adds=self._expanding.size)
        if self._wanted is None:
            np.dot(self._expanding, q, out=out)
        else:
            out[:] = np.nan
            out[self._wanted] = self._expanding @ q

    def answer(self, batch: Array, solve: Callable[[Array], Array]) -> Array:
        """Return displacements (n, n_nodes, 3), m, under loads of that shape, N.

        ``solve`` maps Φᵀf to q.
        """
        out = np.empty((len(batch), len(self._modes)))
        for row, load in zip(out, project(self._modes, batch.reshape(out.shape)), strict=True):
            self.expand(solve(load), row)
        return out.reshape(batch.shape)

    def answer_given(self, batch: Array, solve: Callable[[Array], Array]) -> Array:
        """Return displacements as `answer`; ``solve`` maps values on the free dofs to q."""
        out = np.empty((len(batch), len(self._modes)))
        for row, given in zip(out, batch.reshape(out.shape), strict=True):
            self.expand(solve(given[self._free]), row)
        return out.reshape(batch.shape)

    def answer_each(
        self, batch: Array, each: Array, solve: Callable[[Array, Array], Array]
    ) -> Array:
        """Return the same as `answer`; ``solve`` also gets the row of ``each`` (n, m) of a load."""
        rows = iter(each)
        return self.answer(batch, lambda load: solve(load, next(rows)))
