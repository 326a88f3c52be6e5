"""Loads in compact form: vectors on load patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray


@dataclass(frozen=True, init=False)
class PatchLoads:
    """Loads in compact form: k force vectors on k patches per sample, or the motion of one tool.

    Attributes
    ----------
    patches : (n_samples, k) int64
        Patch numbers, which are also the load-region ids, in ascending order.
    vectors : (n_samples, k, 3) float64
        Forces, N, or displacements, m.
    parameters : (n_samples, n_parameters) float64
        Values of the scene's sampled parameters; without any, there are no columns.
    """

    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]
    parameters: NDArray[np.float64]

    def __init__(
        self,
        patches: NDArray[np.int64],
        vectors: NDArray[np.float64],
        parameters: NDArray[np.float64] | None = None,
    ) -> None:
        if parameters is None:
            parameters = np.zeros((len(patches), 0))
        vars(self).update(patches=patches, vectors=vectors, parameters=parameters)

    def __len__(self) -> int:
        return len(self.patches)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> PatchLoads:
        return PatchLoads(self.patches[index], self.vectors[index], self.parameters[index])

    def nodal_forces(self, weights: sp.csr_array) -> NDArray[np.float64]:
        """Return nodal forces, N, or displacements, m, of a moved tool, from a scene's weights.

        Their shape is (n_samples, n_nodes, 3).
        """
        total = np.zeros((len(self), weights.shape[1], 3))
        for patches, vectors in zip(self.patches.T, np.moveaxis(self.vectors, 1, 0), strict=True):
            total += weights[patches].toarray()[:, :, None] * vectors[:, None, :]
        return total
