"""Split of samples into training and test parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.snapshot_file import ImportedArrays
from mor_bench.snapshots.imported_dataset import NodalLoads, nodal_loads
from mor_bench.snapshots.sampling import PatchLoads
from mor_bench.specs import ImportedDatasetSpec, Split, SplitBy

IMPORTED_SEED = 0
"""Seed of the split of imported samples."""


def split_samples(
    loads: PatchLoads | NodalLoads, n_regions: int, split: Split, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted row numbers of the training and of the test samples.

    The split holds out any samples, whole load regions, or forces in a cone around a random axis. A
    sample of several forces is a test sample if all of its forces are held out, and a training
    sample if none is held out. The fraction of regions, or of the sphere, is chosen such that the
    test part gets its fraction of the used samples.

    Raises
    ------
    InvalidInputError
        If the training or the test part would be empty.
    """
    generator = np.random.default_rng([seed, 0x5917])
    n, k = loads.patches.shape
    if split.by == "sample":
        held = np.zeros((n, 1), dtype=bool)
        held[generator.permutation(n)[: round(split.test_fraction * n)]] = True
    else:
        # If a fraction p of the regions is held out, p^k of the samples have all forces in them and
        # (1 - p)^k have none.
        odds = (split.test_fraction / (1 - split.test_fraction)) ** (1 / k)
        part = odds / (1 + odds)
        if split.by == "region":
            n_test = min(max(1, round(part * n_regions)), n_regions - 1)
            held = np.isin(loads.patches, generator.permutation(n_regions)[:n_test])
        else:
            axis = generator.normal(size=3)
            size = np.maximum(np.linalg.norm(loads.vectors, axis=2), np.finfo(float).tiny)
            held = loads.vectors @ axis / (np.linalg.norm(axis) * size) > 1 - 2 * part
    test, train = held.all(axis=1), ~held.any(axis=1)
    if not train.any() or not test.any():
        raise InvalidInputError(
            f"{n} samples cannot be split by {split.by}: "
            "the training or the test part would be empty."
        )
    return np.flatnonzero(train), np.flatnonzero(test)


def split_imported(
    spec: ImportedDatasetSpec, arrays: ImportedArrays, by: SplitBy | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted row numbers of imported training and test samples, see `split_samples`.

    The direction of a sample is the direction of the sum of its forces.

    Raises
    ------
    InvalidInputError
        If the file lacks the array that the split needs, or a part would be empty.
    """
    chosen = by or spec.split.by
    needed = {"file": ("test", arrays.test), "region": ("regions", arrays.regions)}
    if chosen in needed and needed[chosen][1] is None:
        raise InvalidInputError(
            f"{spec.name}: a split by {chosen} needs the array `{needed[chosen][0]}` "
            f"in {spec.snapshots.file.path}; or split by sample."
        )
    if chosen == "file":
        assert arrays.test is not None
        if arrays.test.all() or not arrays.test.any():
            raise InvalidInputError(
                f"{spec.name}: `test` must be true for some samples and false for others."
            )
        return np.flatnonzero(~arrays.test), np.flatnonzero(arrays.test)
    loads = nodal_loads(arrays)
    # Ids may have large gaps, so their ranks are drawn.
    ids, ranks = np.unique(loads.patches, return_inverse=True)
    ranked = replace(loads, patches=ranks.reshape(loads.patches.shape))
    split = Split(test_fraction=spec.split.test_fraction, by=chosen)
    return split_samples(ranked, len(ids), split, IMPORTED_SEED)
