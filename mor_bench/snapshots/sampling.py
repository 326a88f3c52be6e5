"""Sampling plans: which force acts on which patch in sample number i."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.specs import Loads


@dataclass(frozen=True)
class PatchLoads:
    """Loads in compact form: one force vector on one patch per sample.

    Attributes
    ----------
    patches : (n_samples,) int64
        Patch number, which is also the load-region id.
    vectors : (n_samples, 3) float64
        Force, N.
    """

    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.patches)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> PatchLoads:
        return PatchLoads(self.patches[index], self.vectors[index])

    def nodal_forces(self, weights: sp.csr_array) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal forces, N, from the scene's patch weights."""
        rows = weights[self.patches].toarray()
        return np.asarray(rows[:, :, None] * self.vectors[:, None, :])


def draw_loads(loads: Loads, n_patches: int, start: int, stop: int) -> PatchLoads:
    """The loads of samples ``start`` to ``stop - 1``.

    Sample i acts on patch ``i % n_patches``, so that every beginning of a dataset covers the region evenly. Its
    direction is uniform on the sphere and its magnitude uniform in the given range, from a generator seeded with
    (seed, i): neither order nor the number of workers changes a sample.
    """
    indices = np.arange(start, stop)
    vectors = np.empty((len(indices), 3))
    for row, index in enumerate(indices):
        generator = np.random.default_rng([loads.seed, int(index)])
        direction = generator.normal(size=3)
        vectors[row] = direction * (generator.uniform(*loads.magnitude_n) / np.linalg.norm(direction))
    return PatchLoads(indices % n_patches, vectors)
