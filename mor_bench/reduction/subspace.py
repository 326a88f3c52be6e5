"""Between the nodes of a scene and the coordinates of a linear subspace: loads in, the wanted displacements out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.counting import count, is_counting
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _project(modes, load, reduced):  # type: ignore[no-untyped-def]
    """reduced = Φᵀ load over the components that are not zero; returns their number."""
    reduced[:] = 0.0
    loaded = 0
    for dof in range(len(load)):
        if load[dof] != 0.0:
            loaded += 1
            for i in range(modes.shape[1]):
                reduced[i] += load[dof] * modes[dof, i]
    return loaded


def extent_of(scene: Scene) -> float:
    """Coordinates of orthonormal modes that are displacements of the size of the body."""
    return float(np.ptp(scene.mesh.points, axis=0).max() * np.sqrt(len(scene.free_dofs)))


class Subspace:
    """u = Φq on the nodes of a scene.

    Loads act on few nodes, and only displacements that ``scene.spec.needs.outputs`` asks for are expanded.

    Parameters
    ----------
    scene : Scene
    modes : (n_free, r) float64
        Φ on the free dofs.
    """

    def __init__(self, scene: Scene, modes: Array) -> None:
        self.n_modes = modes.shape[1]
        self._modes = np.zeros((scene.mesh.n_dofs, self.n_modes))
        self._modes[scene.free_dofs] = modes
        nodes = scene.output_nodes
        self._wanted = None if len(nodes) == scene.mesh.n_nodes else dofs_of_nodes(nodes)
        self._expanding = self._modes if self._wanted is None else self._modes[self._wanted]

    def project(self, load: Array) -> Array:
        """Φᵀf (r,) of nodal forces (n_dofs,), N."""
        reduced = np.empty(self.n_modes)
        loaded = int(_project(self._modes, load, reduced))
        if is_counting():
            count(multiply_adds=loaded * self.n_modes)
        return reduced

    def expand(self, q: Array, out: Array) -> None:
        """Write Φq into ``out`` (n_dofs,), m; NaN where no output is wanted."""
        if is_counting():
            count(multiply_adds=self._expanding.size)
        if self._wanted is None:
            np.dot(self._expanding, q, out=out)
        else:
            out[:] = np.nan
            out[self._wanted] = self._expanding @ q

    def answer(self, batch: Array, solve: Callable[[Array], Array]) -> Array:
        """Displacements of loads (n, n_nodes, 3), N, by a solve from Φᵀf to q, in the same shape, m."""
        out = np.empty((len(batch), len(self._modes)))
        for row, load in zip(out, batch.reshape(out.shape), strict=True):
            self.expand(solve(self.project(load)), row)
        return out.reshape(batch.shape)
