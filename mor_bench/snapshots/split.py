"""Which samples are for training and which for the test."""

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
"""Of the split of imported samples."""


def split_samples(
    loads: PatchLoads | NodalLoads, n_regions: int, split: Split, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row numbers of the training and of the test samples, each sorted.

    By sample, any go to the test. By region, whole load regions do, chosen independently of how many samples there are;
    by direction, forces in a cone around a random axis. A sample of several forces is for the test if all of them are and
    for training if none is; the part of the regions, or of the sphere, is such that the test has its fraction of those.

    Raises
    ------
    InvalidInputError
        If a part would be empty.
    """
    generator = np.random.default_rng([seed, 0x5917])
    n, k = loads.patches.shape
    if split.by == "sample":
        held = np.zeros((n, 1), dtype=bool)
        held[generator.permutation(n)[: round(split.test_fraction * n)]] = True
    else:
        # With p of the regions held out, p^k of the samples have all in them and (1 - p)^k none.
        odds = (split.test_fraction / (1 - split.test_fraction)) ** (1 / k)
        part = odds / (1 + odds)
        if split.by == "region":
            n_test = min(max(1, round(part * n_regions)), n_regions - 1)
            held = np.isin(loads.patches, generator.permutation(n_regions)[:n_test])
        else:
            axis = generator.normal(size=3)
            along = (
                loads.vectors
                @ axis
                / (
                    np.linalg.norm(axis)
                    * np.maximum(np.linalg.norm(loads.vectors, axis=2), np.finfo(float).tiny)
                )
            )
            held = along > 1 - 2 * part
    test, train = held.all(axis=1), ~held.any(axis=1)
    if not train.any() or not test.any():
        raise InvalidInputError(
            f"{n} samples cannot be split by {split.by}: the training or the test part would be empty."
        )
    return np.flatnonzero(train), np.flatnonzero(test)


def split_imported(
    spec: ImportedDatasetSpec, arrays: ImportedArrays, by: SplitBy | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row numbers of the training and of the test samples, each sorted.

    As `split_samples`; the direction of a sample is that of the sum of its forces.

    Raises
    ------
    InvalidInputError
        If the file has not what the split needs, or a part would be empty.
    """
    by_or_file = by or spec.split.by
    needed = {"file": arrays.test, "region": arrays.regions}
    if by_or_file in needed and needed[by_or_file] is None:
        name = {"file": "test", "region": "regions"}[by_or_file]
        raise InvalidInputError(
            f"{spec.name}: a split by {by_or_file} needs the array `{name}` in {spec.snapshots.file.path}; or split by sample."
        )
    if by_or_file == "file":
        assert arrays.test is not None
        if arrays.test.all() or not arrays.test.any():
            raise InvalidInputError(
                f"{spec.name}: `test` must be true for some samples and false for others."
            )
        return np.flatnonzero(~arrays.test), np.flatnonzero(arrays.test)
    loads = nodal_loads(arrays)
    # Ids may have gaps of any size: what is drawn is their rank.
    ids, ranks = np.unique(loads.patches, return_inverse=True)
    split = Split(test_fraction=spec.split.test_fraction, by=by_or_file)
    return split_samples(
        replace(loads, patches=ranks.reshape(loads.patches.shape)), len(ids), split, IMPORTED_SEED
    )
