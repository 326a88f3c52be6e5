"""Checks of training samples before a method learns from them."""

from __future__ import annotations

import numpy as np

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots


def checked_samples(owner: str, scene: Scene, snapshots: Snapshots | None) -> Snapshots:
    """Check training samples.

    Raises
    ------
    InvalidInputError
        If there are none, or they have a wrong shape or dtype, are not finite, or are all zero.
    """
    if snapshots is None or len(snapshots) == 0:
        raise InvalidInputError(f"{owner} needs at least one training sample; got none.")
    displacements, vectors = snapshots.free_displacements, snapshots.loads.vectors
    shape = (len(snapshots), len(scene.free_dofs))
    kinds = {displacements.dtype.kind, vectors.dtype.kind}
    if displacements.shape != shape or not kinds <= set("fiu"):
        raise InvalidInputError(
            f"the training samples must be real numbers, displacements of shape {shape}; "
            f"got {displacements.dtype} of shape {displacements.shape} and forces in "
            f"{vectors.dtype}."
        )
    if not np.isfinite(displacements).all() or not np.isfinite(vectors).all():
        raise InvalidInputError("the training snapshots hold NaN or infinity.")
    if not displacements.any() or not vectors.any():
        raise InvalidInputError(
            "the training snapshots are all zero: nothing can be learned from them."
        )
    return snapshots
