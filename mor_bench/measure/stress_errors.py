"""Errors of the stresses that follow from the predicted displacements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.stresses import CellStresses
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]


class StressErrors:
    """Compares Cauchy stresses at the cells' centroids of predictions and references.

    Parameters
    ----------
    scene : Scene
        A scene whose equations are known.
    """

    def __init__(self, scene: Scene) -> None:
        self._stresses = CellStresses(scene)
        self._rest = self._stresses(np.zeros((1, scene.mesh.n_nodes, 3))).cauchy

    def __call__(self, predicted: Array, references: Array) -> tuple[Array, Array, Array]:
        """Return the errors of the field, of its largest von Mises stress and tension, (n,) each.

        The first is the norm √(Σ V σ : σ) of the difference over that of the reference, with the
        cells' volumes V. The stress of a rest state under gravity is subtracted from the field,
        since no method computes it. The largest stresses contain it.

        The tension is the largest principal stress, on which Rankine's criterion of rupture
        depends. Compression everywhere makes it negative, and it may vanish. So its error is
        divided by the largest magnitude of a principal stress of the reference.

        Parameters
        ----------
        predicted, references : (n, n_nodes, 3) float64
            Displacements, m. A prediction that is not finite has infinite errors.
        """
        own, right = self._stresses(predicted), self._stresses(references)
        field = self._norm(own.cauchy - right.cauchy), self._norm(right.cauchy - self._rest)
        peak, true_peak = own.von_mises.max(axis=1), right.von_mises.max(axis=1)
        tension, principal = own.principal[..., 2].max(axis=1), right.principal
        off = np.abs(tension - principal[..., 2].max(axis=1))
        return (
            _relative(*field),
            _relative(np.abs(peak - true_peak), true_peak),
            _relative(off, np.abs(principal).max(axis=(1, 2))),
        )

    def _norm(self, stress: Array) -> Array:
        squares = np.einsum("ncij,ncij->nc", stress, stress)
        return np.asarray(np.sqrt(squares @ self._stresses.volumes))


def _relative(errors: Array, sizes: Array) -> Array:
    found = errors / np.where(sizes > 0, sizes, 1.0)
    return np.where(np.isfinite(found), found, np.inf)
