"""Snapshots in memory, and a dataset read from its shards with the split that its file asks for."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.generate import SHARD_SIZE, Progress, generate, n_samples_of, shard_path
from mor_bench.snapshots.sampling import PatchLoads
from mor_bench.snapshots.store import read_shard
from mor_bench.specs import DatasetSpec, Split, SplitBy, load_dataset_spec


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array, locked: what all methods share, none may change."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Snapshots:
    """Pairs of nodal forces and displacements; a dataset's are read-only.

    Attributes
    ----------
    scene : Scene
    loads : PatchLoads
        The forces in compact form.
    free_displacements : (n_samples, n_free) float64
        At the free dofs, m; supports are exactly zero.
    min_det_f : (n_samples,) float64
    """

    scene: Scene = field(repr=False)
    loads: PatchLoads
    free_displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.loads)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> Snapshots:
        loads = self.loads[index]
        for array in (loads.patches, loads.vectors):
            read_only(array)
        return Snapshots(self.scene, loads, read_only(self.free_displacements[index]), read_only(self.min_det_f[index]))

    @cached_property
    def forces(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal forces, N."""
        return read_only(self.loads.nodal_forces(self.scene.patch_weights))

    @property
    def free_forces(self) -> NDArray[np.float64]:
        """(n_samples, n_free) nodal forces at the free dofs, N."""
        return self.forces.reshape(len(self), -1)[:, self.scene.free_dofs]

    @cached_property
    def displacements(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal displacements, m."""
        full = np.zeros((len(self), self.scene.mesh.n_dofs))
        full[:, self.scene.free_dofs] = self.free_displacements
        return read_only(full.reshape(len(self), -1, 3))

    @property
    def regions(self) -> NDArray[np.int64]:
        """(n_samples,) load-region id."""
        return self.loads.patches


@dataclass(frozen=True)
class Dataset:
    """A scene with its training and test snapshots.

    Attributes
    ----------
    n_refused : int
        Samples without a valid equilibrium; they are stored with their reason and in neither part.
    """

    scene: Scene = field(repr=False)
    train: Snapshots
    test: Snapshots
    n_refused: int


def split_samples(regions: NDArray[np.int64], n_regions: int, split: Split, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row numbers of the training and of the test samples, each sorted.

    By region, whole load regions go to the test, chosen independently of how many samples there are; by sample, any.

    Raises
    ------
    InvalidInputError
        If a part would be empty.
    """
    generator = np.random.default_rng([seed, 0x5917])
    if split.by == "region":
        n_test = min(max(1, round(split.test_fraction * n_regions)), n_regions - 1)
        in_test = np.isin(regions, generator.permutation(n_regions)[:n_test])
    else:
        n_test = round(split.test_fraction * len(regions))
        in_test = np.zeros(len(regions), dtype=bool)
        in_test[generator.permutation(len(regions))[:n_test]] = True
    if in_test.all() or not in_test.any():
        raise InvalidInputError(f"{len(regions)} samples cannot be split by {split.by}: the training or the test part would be empty.")
    return np.flatnonzero(~in_test), np.flatnonzero(in_test)


def load_dataset(
    source: str | Path | Mapping[str, Any] | DatasetSpec,
    limit: int | None = None,
    *,
    split: SplitBy | None = None,
    workers: int | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Read a dataset, generating first what is missing.

    Parameters
    ----------
    source : str, Path, dict or DatasetSpec
        A name in the suite, the path of a TOML, or a dict with the same keys.
    limit : int, optional
        Only the first samples; they cover the load regions evenly.
    split : {"region", "sample"}, optional
        Instead of the split in the file.
    workers : int, optional
        Processes for generation; all cores by default.
    cache : Path, optional
        Cache folder; the user's by default.
    progress : callable, optional
        Called with (samples done, samples wanted).

    Raises
    ------
    SpecError
        If the dataset is not valid.
    InvalidInputError
        If ``limit`` or ``workers`` is less than 1, or a part of the split would be empty.
    """
    for name, value in (("limit", limit), ("workers", workers)):
        if value is not None and value < 1:
            raise InvalidInputError(f"`{name}` must be an integer >= 1; got {value}.")
    if split not in (None, "region", "sample"):
        raise InvalidInputError(f"`split` must be 'region' or 'sample'; got {split!r}.")
    spec = source if isinstance(source, DatasetSpec) else load_dataset_spec(source)
    scene = load_scene(spec)
    folder = generate(spec, limit, workers or os.cpu_count() or 1, cache, progress)
    total = n_samples_of(spec, limit)
    shards = [read_shard(shard_path(folder, number)) for number in range(-(-total // SHARD_SIZE))]

    def joined(name: str) -> Any:
        return np.concatenate([getattr(shard, name) for shard in shards])[:total]

    chosen = spec.split if split is None else Split(test_fraction=spec.split.test_fraction, by=split)
    ok = joined("status") == 0
    snapshots = Snapshots(scene, PatchLoads(joined("patches"), joined("vectors")), joined("displacements"), joined("min_det_f"))[np.flatnonzero(ok)]
    train, test = split_samples(snapshots.regions, len(scene.patch_nodes), chosen, spec.loads.seed)
    return Dataset(scene, snapshots[train], snapshots[test], int((~ok).sum()))
