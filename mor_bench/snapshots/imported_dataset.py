"""Loads and samples of a dataset with snapshots from another program."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.snapshot_file import ImportedArrays, read_arrays
from mor_bench.specs import ImportedDatasetSpec


@dataclass(frozen=True)
class NodalLoads:
    """Loads given as forces on all nodes.

    Attributes
    ----------
    forces : (n_samples, n_nodes, 3) float64
        Nodal forces, N.
    patches : (n_samples, k) int64
        Load-region ids; zeros if the file has none.
    """

    forces: NDArray[np.float64]
    patches: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.forces)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> NodalLoads:
        return NodalLoads(self.forces[index], self.patches[index])

    @property
    def vectors(self) -> NDArray[np.float64]:
        """(n_samples, 1, 3) sums of the forces, N."""
        return np.asarray(self.forces.sum(axis=1, keepdims=True))


def read_samples(spec: ImportedDatasetSpec, limit: int | None = None) -> ImportedArrays:
    """Read the first or all samples of an imported dataset; errors as in `read_arrays`."""
    arrays = read_arrays(spec.snapshots.file)
    by_sample = {
        name: getattr(arrays, name)
        for name in ("forces", "displacements", "regions", "test", "validation")
    }
    return replace(
        arrays,
        **{name: array[:limit] for name, array in by_sample.items() if array is not None},
    )


def nodal_loads(arrays: ImportedArrays) -> NodalLoads:
    """Return the loads of imported samples."""
    regions = arrays.regions
    if regions is None:
        regions = np.zeros((len(arrays.forces), 1), dtype=np.int64)
    return NodalLoads(arrays.forces, regions)
