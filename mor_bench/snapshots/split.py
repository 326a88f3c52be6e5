"""Split of samples into a training, a validation and a test part."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.snapshot_file import ImportedArrays
from mor_bench.snapshots.imported_dataset import NodalLoads, nodal_loads
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import ImportedDatasetSpec, Split, SplitBy

IMPORTED_SEED = 0
"""Seed of the split of imported samples."""


class Parts(NamedTuple):
    """Sorted row numbers of the training, the validation and the test samples, (n,) int64 each."""

    train: NDArray[np.int64]
    validation: NDArray[np.int64]
    test: NDArray[np.int64]


def split_samples(
    loads: PatchLoads | NodalLoads,
    n_regions: int,
    split: Split,
    seed: int,
    paths: NDArray[np.int64] | None = None,
) -> Parts:
    """Divide samples into a training, a validation and a test part.

    The split holds out any samples, whole load regions, or forces in a cone around a random axis;
    the directions of the validation part lie in a ring around the cone. A sample of several forces
    is a test sample if all of its forces are held out for the test, and unused if only some are. Of
    the others, it is a validation sample if at least one of its forces is held out for validation.
    The fractions of regions, or of the sphere, are chosen such that each part gets its fraction of
    the used samples. Samples with the same number in ``paths`` (n,) are steps of one load, whose
    patches and directions are the same; a split by sample keeps them together.

    Raises
    ------
    InvalidInputError
        If the training or the test part would be empty.
    """
    generator = np.random.default_rng([seed, 0x5917])
    n, k = loads.patches.shape
    # If a fraction p of the regions is held out, p^k of the samples have all forces in them and
    # (1 - p)^k have none.
    odds = (split.test_fraction / (1 - split.test_fraction)) ** (1 / k)
    part = odds / (1 + odds)
    # If a fraction q of the other regions is held out for validation, 1 - (1 - q)^k of the other
    # samples have a force there.
    ring = 1 - (1 - split.validation_fraction / (1 - split.test_fraction)) ** (1 / k)
    if split.by == "sample":
        row = np.arange(n)
        if paths is not None:
            numbers, row = np.unique(paths, return_inverse=True)
            n = len(numbers)
        n_test = round(split.test_fraction * n)
        n_validation = round(split.validation_fraction * n)
        rank = np.argsort(generator.permutation(n))[row][:, None]
        test, validation = rank < n_test, rank < n_test + n_validation
    elif split.by == "region":
        n_test = min(max(1, round(part * n_regions)), n_regions - 1)
        n_validation = round(ring * (n_regions - n_test))
        rank = np.argsort(generator.permutation(n_regions))[loads.patches]
        test, validation = rank < n_test, rank < n_test + n_validation
    else:
        axis = generator.normal(size=3)
        size = np.maximum(np.linalg.norm(loads.vectors, axis=2), np.finfo(float).tiny)
        cosine = loads.vectors @ axis / (np.linalg.norm(axis) * size)
        test, validation = cosine > 1 - 2 * part, cosine > 1 - 2 * (part + ring * (1 - part))
    return _parts(test.all(axis=1), test.any(axis=1), validation.any(axis=1), split.by)


def _parts(
    test: NDArray[np.bool_],
    touches_test: NDArray[np.bool_],
    touches_validation: NDArray[np.bool_],
    by: str,
) -> Parts:
    """Divide samples by three masks (n,); without a training part, there is no validation part."""
    others = ~touches_test
    validation = others & touches_validation
    train = others & ~validation
    if not train.any():
        train, validation = others, np.zeros_like(others)
    if not train.any() or not test.any():
        raise InvalidInputError(
            f"{len(test)} samples cannot be split by {by}: "
            "the training or the test part would be empty."
        )
    return Parts(np.flatnonzero(train), np.flatnonzero(validation), np.flatnonzero(test))


def split_imported(spec: ImportedDatasetSpec, arrays: ImportedArrays, by: SplitBy | None) -> Parts:
    """Divide imported samples into parts, see `split_samples`.

    The direction of a sample is the direction of the sum of its forces. If the file says which
    samples are test samples but not which are validation samples, these are drawn at random.

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
        held = arrays.validation
        if held is None:
            rank = np.random.default_rng([IMPORTED_SEED, 0x5917]).permutation(len(arrays.test))
            held = rank < round(spec.split.validation_fraction * len(rank))
        return _parts(arrays.test, arrays.test, held, chosen)
    loads = nodal_loads(arrays)
    # Ids may have large gaps, so their ranks are drawn.
    ids, ranks = np.unique(loads.patches, return_inverse=True)
    ranked = replace(loads, patches=ranks.reshape(loads.patches.shape))
    split = Split(
        test_fraction=spec.split.test_fraction,
        validation_fraction=spec.split.validation_fraction,
        by=chosen,
    )
    return split_samples(ranked, len(ids), split, IMPORTED_SEED)
