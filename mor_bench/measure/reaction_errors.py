"""Errors of the force that a moved tool feels, which follows from the predicted displacements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.scene.scene import Scene


class ReactionErrors:
    """Compares resultant forces of predictions and references, relative to the reference's.

    Parameters
    ----------
    scene : Scene
        A scene with a moved tool.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._forces = scene, ToolForces(scene)

    def __call__(
        self,
        predicted: NDArray[np.float64],
        references: NDArray[np.float64],
        parameters: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return the norm of the difference over the norm of the reference, (n,).

        Parameters
        ----------
        predicted, references : (n, n_nodes, 3) float64
            Displacements, m. A prediction that is not finite has an infinite error.
        parameters : (n, n_parameters) float64, optional
            Sampled parameters of the bodies.
        """
        own, right = (self._resultants(u, parameters) for u in (predicted, references))
        size = np.linalg.norm(right, axis=1)
        errors = np.linalg.norm(own - right, axis=1) / np.where(size > 0, size, 1.0)
        return np.where(np.isfinite(errors), errors, np.inf)

    def _resultants(
        self, displacements: NDArray[np.float64], parameters: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        free = self._scene.at_free_dofs(displacements.reshape(len(displacements), -1))
        return np.asarray(self._forces(free, parameters).sum(axis=1))
