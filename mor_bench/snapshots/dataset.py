"""Snapshots in memory, and a dataset read from its shards with the split that its file asks for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene, imported_scene, load_scene
from mor_bench.snapshots.executors import check_pool
from mor_bench.snapshots.generate import Progress, generate, n_samples_to_generate, read_shards
from mor_bench.snapshots.given import Given, given_of
from mor_bench.snapshots.imported_dataset import NodalLoads, nodal_loads, read_samples
from mor_bench.snapshots.sampling import PatchLoads, n_samples_of, repeated
from mor_bench.snapshots.split import split_imported, split_samples
from mor_bench.snapshots.test_sets import SetName, check_regions, spec_of_set
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    Split,
    SplitBy,
    generated,
    load_dataset_spec,
)


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
    loads : PatchLoads or NodalLoads
        The forces in compact form, or imported ones as they came.
    free_displacements : (n_samples, n_free) float64
        At the free dofs, m; supports are exactly zero.
    min_det_f : (n_samples,) float64
        NaN of imported ones.
    """

    scene: Scene = field(repr=False)
    loads: PatchLoads | NodalLoads
    free_displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]

    @classmethod
    def empty(cls, scene: Scene) -> Snapshots:
        """No samples of a scene."""
        loads = NodalLoads(np.zeros((0, scene.mesh.n_nodes, 3)), np.zeros((0, 1), dtype=np.int64))
        return cls(scene, loads, np.zeros((0, len(scene.free_dofs))), np.zeros(0))

    def __len__(self) -> int:
        return len(self.loads)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> Snapshots:
        loads = self.loads[index]
        for array in (
            loads.patches,
            loads.forces if isinstance(loads, NodalLoads) else loads.vectors,
        ):
            read_only(array)
        return Snapshots(
            self.scene,
            loads,
            read_only(self.free_displacements[index]),
            read_only(self.min_det_f[index]),
        )

    @cached_property
    def forces(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal forces, N."""
        if isinstance(self.loads, NodalLoads):
            return self.loads.forces
        return read_only(self.loads.nodal_forces(self.scene.patch_weights))

    @cached_property
    def inputs(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) what methods are given: the forces, N, or, in a scene with observed nodes, the displacements of these, m.

        Zero at all other nodes. `forces` stays what it is: the forces that the samples were made with.
        """
        nodes = self.scene.observed_nodes
        if nodes is None:
            return self.forces
        seen = np.zeros_like(self.displacements)
        seen[:, nodes] = self.displacements[:, nodes]
        return read_only(seen)

    @property
    def given(self) -> Given:
        """What methods are given for these samples."""
        return given_of(self.scene, self.inputs)

    @property
    def free_inputs(self) -> NDArray[np.float64]:
        """(n_samples, n_free) `inputs` at the free dofs."""
        return self.inputs.reshape(len(self), -1)[:, self.scene.free_dofs]

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
        """(n_samples,) load-region id; (n_samples, k) with k forces at once."""
        patches = self.loads.patches
        return patches[:, 0] if patches.shape[1] == 1 else patches


@dataclass(frozen=True)
class Dataset:
    """A scene with its training and test snapshots.

    Attributes
    ----------
    n_refused : int
        Samples without a valid equilibrium; they are stored with their reason and in no part.
    n_unused : int
        Valid samples in neither part: those of several forces of which some belong to one part and some to the other.
    tests : dict of str to Snapshots
        The named test sets that were asked for, see `mor_bench.snapshots.test_sets`.
    """

    scene: Scene = field(repr=False)
    train: Snapshots
    test: Snapshots
    n_refused: int
    n_unused: int = 0
    tests: dict[str, Snapshots] = field(default_factory=dict)


def load_dataset(
    source: str | Path | Mapping[str, Any] | AnyDatasetSpec,
    limit: int | None = None,
    *,
    split: SplitBy | None = None,
    tests: Sequence[SetName] = (),
    workers: int | None = None,
    cluster: str | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Read a dataset, generating first what is missing.

    Parameters
    ----------
    source : str, Path, dict, DatasetSpec or ImportedDatasetSpec
        A name in the suite, the path of a TOML, or a dict with the same keys.
    limit : int, optional
        Only the first samples; they cover the load regions evenly.
    split : {"region", "sample", "direction"}, optional
        Instead of the split in the file.
    tests : sequence of str
        Named test sets to read beside the main one, see `mor_bench.snapshots.test_sets`.
    workers : int, optional
        Processes for generation; all cores by default.
    cluster : str, optional
        Address of a Dask scheduler whose workers generate instead, ``tcp://host:port``.
    cache : Path, optional
        Cache folder; the user's by default.
    progress : callable, optional
        Called with (samples done, samples wanted).

    Raises
    ------
    SpecError
        If the dataset is not valid.
    InvalidInputError
        If ``limit`` or ``workers`` is less than 1, ``cluster`` is no address or given beside ``workers``, or a part of the
        split would be empty.
    StoreError, WorkerError, MissingDependencyError
        If generation cannot go on, see `mor_bench.snapshots.generate.generate`.
    """
    if limit is not None and limit < 1:
        raise InvalidInputError(f"`limit` must be an integer >= 1; got {limit}.")
    check_pool(workers, cluster)
    if split not in (None, *get_args(SplitBy)):
        raise InvalidInputError(
            f"`split` must be one of {', '.join(get_args(SplitBy))}; got {split!r}."
        )
    spec = (
        source
        if isinstance(source, DatasetSpec | ImportedDatasetSpec)
        else load_dataset_spec(source)
    )
    if isinstance(spec, ImportedDatasetSpec):
        return _imported(spec, limit, split, tests)
    others = {name: spec_of_set(spec, name) for name in tests}
    if "unseen-regions" in others:
        check_regions(spec)
    by = Split(test_fraction=spec.split.test_fraction, by=split or spec.split.by)
    stores = [
        _Store(item, generate(item, limit, workers, cache, progress, cluster), limit)
        for item in (spec, *others.values())
    ]
    if n_repeated := repeated([(store.scene, store.loads) for store in stores]):
        raise InvalidInputError(
            f"{spec.name}: {n_repeated} samples repeat others; are `seed` and `magnitude_n` as they should be?"
        )
    main = stores[0]
    valid = np.flatnonzero(main.status == 0)
    parts = split_samples(main.loads[valid], len(main.scene.patch_nodes), by, spec.loads.seed)
    train, test = main.snapshots([valid[part] for part in parts])
    sets: dict[str, Snapshots] = {
        name: store.snapshots([np.flatnonzero(store.status == 0)])[0]
        for name, store in zip(others, stores[1:], strict=True)
    }
    return Dataset(
        main.scene,
        train,
        test,
        len(main.status) - len(valid),
        len(valid) - len(train) - len(test),
        sets,
    )


def _imported(
    spec: ImportedDatasetSpec, limit: int | None, by: SplitBy | None, tests: Sequence[SetName]
) -> Dataset:
    if tests:
        raise InvalidInputError(
            f"{spec.name} has no test set {tests[0]!r}: its snapshots were imported."
        )
    arrays = read_samples(spec, limit)
    scene = imported_scene(spec, arrays)
    loads, displacements = (
        nodal_loads(arrays),
        arrays.displacements.reshape(len(arrays.forces), -1)[:, scene.free_dofs],
    )
    parts = split_imported(spec, arrays, by)
    train, test = (
        Snapshots(scene, loads[part], displacements[part], np.full(len(part), np.nan))[:]
        for part in parts
    )
    return Dataset(scene, train, test, 0, len(loads) - len(train) - len(test))


class _Store:
    """The shards of a dataset, read one at a time."""

    def __init__(self, spec: DatasetSpec, folder: Path, limit: int | None) -> None:
        self.scene = load_scene(spec)
        whole = n_samples_of(self.scene)
        self._folder, self._total = folder, whole if limit is None else min(limit, whole)
        shards = [
            replace(shard, displacements=shard.displacements[:, :0])
            for shard in read_shards(folder, self._total)
        ]
        self.loads = PatchLoads(
            *(
                np.concatenate([getattr(shard, name) for shard in shards])
                for name in ("patches", "vectors")
            )
        )
        self.status, self._min_det_f = (
            np.concatenate([getattr(shard, name) for shard in shards])
            for name in ("status", "min_det_f")
        )

    def snapshots(self, parts: Sequence[NDArray[np.int64]]) -> list[Snapshots]:
        """The samples of some parts, each given by rising numbers; beside them no more than one shard is in memory."""
        out = [np.empty((len(part), len(self.scene.free_dofs))) for part in parts]
        for shard in read_shards(self._folder, self._total):
            for part, displacements in zip(parts, out, strict=True):
                first, last = np.searchsorted(part, [shard.start, shard.start + len(shard.status)])
                displacements[first:last] = shard.displacements[part[first:last] - shard.start]
        return [
            Snapshots(self.scene, self.loads[part], u, self._min_det_f[part])[:]
            for part, u in zip(parts, out, strict=True)
        ]


def stream(
    source: str | Path | Mapping[str, Any] | AnyDatasetSpec,
    limit: int | None = None,
    *,
    workers: int | None = None,
    cache: Path | None = None,
) -> Iterator[Snapshots]:
    """The valid samples of a dataset, train and test together, a hundred at a time; parameters as of `load_dataset`."""
    spec = generated(
        source
        if isinstance(source, DatasetSpec | ImportedDatasetSpec)
        else load_dataset_spec(source)
    )
    scene = load_scene(spec)
    folder = generate(spec, limit, workers, cache)
    for shard in read_shards(folder, n_samples_to_generate(spec, limit)):
        yield Snapshots(
            scene, PatchLoads(shard.patches, shard.vectors), shard.displacements, shard.min_det_f
        )[np.flatnonzero(shard.status == 0)]
