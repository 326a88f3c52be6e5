"""Snapshots in memory, and datasets with their split, read from shards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Unpack, get_args

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, check_count
from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.scene.scene import Scene, imported_scene, load_scene
from mor_bench.snapshots.executors import check_pool
from mor_bench.snapshots.generate import GenerationOptions, generate, read_shards
from mor_bench.snapshots.given import Given, given_of
from mor_bench.snapshots.imported_dataset import NodalLoads, nodal_loads, read_samples
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import n_samples_of, path_of_samples, repeated
from mor_bench.snapshots.split import split_imported, split_samples
from mor_bench.snapshots.test_sets import SetName, check_regions, spec_of_set
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, ImportedDatasetSpec, SplitBy, as_spec


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Lock and return an array that all methods share."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Snapshots:
    """Pairs of nodal forces and displacements. The arrays of a dataset are read-only.

    Attributes
    ----------
    scene : Scene
    loads : PatchLoads or NodalLoads
        The forces in compact form, or imported forces on all nodes.
    free_displacements : (n_samples, n_free) float64
        Displacements of the free dofs, m. Supports do not move.
    min_det_f : (n_samples,) float64
        Smallest det F of each sample; NaN for imported samples.

    Examples
    --------
    >>> samples = load_dataset("beam-tiny").test
    >>> samples.forces.shape, samples.displacements.shape
    ((40, 63, 3), (40, 63, 3))
    """

    scene: Scene = field(repr=False)
    loads: PatchLoads | NodalLoads
    free_displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]

    def __repr__(self) -> str:
        return f"<Snapshots of {self.scene.name}: {len(self)} samples>"

    @classmethod
    def empty(cls, scene: Scene) -> Snapshots:
        """Return an empty set of samples for a scene."""
        loads = NodalLoads(np.zeros((0, scene.mesh.n_nodes, 3)), np.zeros((0, 1), dtype=np.int64))
        return cls(scene, loads, np.zeros((0, len(scene.free_dofs))), np.zeros(0))

    def __len__(self) -> int:
        return len(self.loads)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> Snapshots:
        loads = self.loads[index]
        read_only(loads.patches)
        if isinstance(loads, NodalLoads):
            read_only(loads.forces)
        else:
            read_only(loads.vectors)
            read_only(loads.parameters)
        displacements, min_det_f = self.free_displacements[index], self.min_det_f[index]
        return Snapshots(self.scene, loads, read_only(displacements), read_only(min_det_f))

    @cached_property
    def forces(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal forces, N; those of the tool where one moves the body."""
        if isinstance(self.loads, NodalLoads):
            return self.loads.forces
        if self.scene.motion or self.scene.contact:
            return read_only(ToolForces(self.scene)(self.free_displacements, self.parameters))
        return read_only(self.loads.nodal_forces(self.scene.patch_weights))

    @property
    def parameters(self) -> NDArray[np.float64]:
        """(n_samples, n_parameters) values of ``scene.parameter_names``; no columns without any."""
        if isinstance(self.loads, NodalLoads):
            return np.zeros((len(self), len(self.scene.parameter_names)))
        return self.loads.parameters

    @cached_property
    def given(self) -> Given:
        """Input of the methods: forces, with parameters if any, or observed displacements.

        Displacements are zero at all other nodes. Where an instrument presses, they are its own.
        Displacements with parameters are `ParametricForces`.
        """
        nodes = self.scene.observed_nodes
        if nodes is None:
            return given_of(self.scene, self.forces, self.parameters)
        if self.scene.contact and isinstance(self.loads, PatchLoads):
            moved = self.loads.nodal_forces(self.scene.patch_weights)
            return given_of(self.scene, read_only(moved), self.parameters)
        seen = np.zeros_like(self.displacements)
        seen[:, nodes] = self.displacements[:, nodes]
        return given_of(self.scene, read_only(seen), self.parameters)

    @property
    def free_forces(self) -> NDArray[np.float64]:
        """(n_samples, n_free) nodal forces at the free dofs, N."""
        return self.scene.at_free_dofs(self.forces.reshape(len(self), self.scene.mesh.n_dofs))

    @cached_property
    def displacements(self) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal displacements, m."""
        full = self.scene.at_all_dofs(self.free_displacements)
        return read_only(full.reshape(len(self), self.scene.mesh.n_nodes, 3))

    @property
    def regions(self) -> NDArray[np.int64]:
        """(n_samples,) load-region id; (n_samples, k) with k forces at once; 0 for pressures."""
        patches = self.loads.patches[:, :1] if self.scene.pressure else self.loads.patches
        return patches[:, 0] if patches.shape[1] == 1 else patches


@dataclass(frozen=True)
class Dataset:
    """A scene with its training, validation and test snapshots.

    Attributes
    ----------
    train, validation, test : Snapshots
        Methods learn from `train`. Choices between configurations use `validation`, so that errors
        on `test` are those of methods that were not chosen for it. See
        `mor_bench.snapshots.split`.
    n_refused : int
        Samples without a valid equilibrium. They are stored with the reason and are in no part.
    n_unused : int
        Valid samples in no part, because only some of their forces are held out for the test.
    tests : dict of str to Snapshots
        The requested named test sets, see `mor_bench.snapshots.test_sets`.

    Examples
    --------
    >>> data = load_dataset("beam-tiny")
    >>> {part: len(getattr(data, part)) for part in ("train", "validation", "test")}
    {'train': 140, 'validation': 30, 'test': 40}
    """

    scene: Scene = field(repr=False)
    train: Snapshots
    validation: Snapshots
    test: Snapshots
    n_refused: int
    n_unused: int = 0
    tests: dict[str, Snapshots] = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = f"{len(self.train)} train, {len(self.validation)} validation, {len(self.test)} test"
        return f"<Dataset {self.scene.name}: {parts} samples>"

    def _repr_html_(self) -> str:
        """Show the parts of the dataset in a notebook."""
        mesh = self.scene.mesh
        parts = {"train": self.train, "validation": self.validation, "test": self.test}
        rows = "".join(_html_row(name, part) for name, part in {**parts, **self.tests}.items())
        headings = ("part", "samples", "load regions", "largest displacement along an axis (m)")
        head = "".join(f'<th scope="col">{text}</th>' for text in headings)
        return (
            f"<table><caption>{escape(self.scene.name)}: {mesh.n_nodes:,} nodes, "
            f"{mesh.n_cells:,} cells, {mesh.n_dofs:,} degrees of freedom; "
            f"{self.n_refused:,} samples without equilibrium, {self.n_unused:,} unused</caption>"
            f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        )


def _html_row(name: str, part: Snapshots) -> str:
    nodal = part.free_displacements
    largest = f"{np.abs(nodal).max():.3g}" if nodal.size else "–"
    cells = (f"{len(part):,}", f"{len(np.unique(part.regions)):,}", largest)
    return (
        f'<tr><th scope="row">{escape(name)}</th>'
        f"{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    )


def load_dataset(
    source: str | Path | Mapping[str, Any] | AnyDatasetSpec,
    limit: int | None = None,
    *,
    split: SplitBy | None = None,
    tests: Sequence[SetName] = (),
    **generation: Unpack[GenerationOptions],
) -> Dataset:
    """Read a dataset; generate missing samples first.

    Parameters
    ----------
    source : str, Path, dict, DatasetSpec or ImportedDatasetSpec
        Name of a dataset in the suite, path of a TOML, a dict with the same keys, or a spec.
    limit : int, optional
        Use only the first samples. They cover the load regions evenly.
    split : {"region", "sample", "direction"}, optional
        Replaces the split in the file.
    tests : sequence of str
        Named test sets to read too, see `mor_bench.snapshots.test_sets`.
    workers, cluster, cache, progress : optional
        Options of generation, see `mor_bench.snapshots.generate.generate`.

    Raises
    ------
    SpecError
        If the dataset is not valid.
    InvalidInputError
        If ``limit`` or ``workers`` is less than 1, or a part of the split would be empty. Also if
        ``cluster`` is not an address or is given together with ``workers``.
    StoreError, WorkerError, MissingDependencyError
        If generation fails, see `mor_bench.snapshots.generate.generate`.

    Examples
    --------
    >>> data = load_dataset("beam-tiny")
    >>> len(data.train), len(data.validation), len(data.test)
    (140, 30, 40)
    """
    if unknown := sorted(generation.keys() - GenerationOptions.__annotations__.keys()):
        raise TypeError(f"load_dataset() got an unexpected keyword argument {unknown[0]!r}")
    check_count("limit", limit)
    check_pool(generation.get("workers"), generation.get("cluster"))
    if split not in (None, *get_args(SplitBy)):
        raise InvalidInputError(
            f"`split` must be one of {', '.join(get_args(SplitBy))}; got {split!r}."
        )
    spec = as_spec(source)
    if isinstance(spec, ImportedDatasetSpec):
        return _imported(spec, limit, split, tests)
    sets = {name: spec_of_set(spec, name) for name in tests}
    if "unseen-regions" in sets:
        check_regions(spec)
    main, *others = (
        _Store(item, generate(item, limit, **generation), limit) for item in (spec, *sets.values())
    )
    return _split(spec, split or spec.split.by, main, dict(zip(sets, others, strict=True)))


def _split(
    spec: DatasetSpec, by: SplitBy, main: _Store, others: Mapping[SetName, _Store]
) -> Dataset:
    if n := repeated([(store.scene, store.loads) for store in (main, *others.values())]):
        raise InvalidInputError(
            f"{spec.name}: {n} samples repeat others; check `seed` and the range of magnitudes."
        )
    valid, n_patches = main.valid, len(main.scene.patch_nodes)
    chosen = spec.split.model_copy(update={"by": by})
    paths = path_of_samples(main.scene, valid)
    parts = split_samples(main.loads[valid], n_patches, chosen, spec.load_plan.seed, paths)
    train, validation, test = main.snapshots([valid[part] for part in parts])
    sets: dict[str, Snapshots] = {n: s.snapshots([s.valid])[0] for n, s in others.items()}
    n_refused, n_unused = len(main.status) - len(valid), len(valid) - sum(map(len, parts))
    return Dataset(main.scene, train, validation, test, n_refused, n_unused, sets)


def _imported(
    spec: ImportedDatasetSpec, limit: int | None, by: SplitBy | None, tests: Sequence[SetName]
) -> Dataset:
    if tests:
        raise InvalidInputError(
            f"{spec.name} has no test set {tests[0]!r}: its snapshots were imported."
        )
    arrays = read_samples(spec, limit)
    scene, loads = imported_scene(spec, arrays), nodal_loads(arrays)
    displacements = arrays.displacements.reshape(len(loads), -1)[:, scene.free_dofs]
    parts = split_imported(spec, arrays, by)
    train, validation, test = (
        Snapshots(scene, loads[part], displacements[part], np.full(len(part), np.nan))[:]
        for part in parts
    )
    return Dataset(scene, train, validation, test, 0, len(loads) - sum(map(len, parts)))


class _Store:
    """The shards of a dataset. Displacements are read one shard at a time."""

    def __init__(self, spec: DatasetSpec, folder: Path, limit: int | None) -> None:
        self.scene = load_scene(spec)
        self._folder, self._total = folder, n_samples_of(self.scene, limit)
        shards = [
            replace(shard, displacements=shard.displacements[:, :0])
            for shard in read_shards(folder, self._total)
        ]
        patches, vectors, parameters, self.status, self._min_det_f = (
            np.concatenate([getattr(shard, name) for shard in shards])
            for name in ("patches", "vectors", "parameters", "status", "min_det_f")
        )
        self.loads = PatchLoads(patches, vectors, parameters)

    @property
    def valid(self) -> NDArray[np.int64]:
        """Numbers of the samples with a valid equilibrium."""
        return np.flatnonzero(self.status == 0)

    def snapshots(self, parts: Sequence[NDArray[np.int64]]) -> list[Snapshots]:
        """Return some parts of the samples, each given by ascending numbers."""
        out = [np.empty((len(part), len(self.scene.free_dofs))) for part in parts]
        for shard in read_shards(self._folder, self._total):
            for part, displacements in zip(parts, out, strict=True):
                first, last = np.searchsorted(part, [shard.start, shard.start + len(shard.status)])
                displacements[first:last] = shard.displacements[part[first:last] - shard.start]
        return [
            Snapshots(self.scene, self.loads[part], u, self._min_det_f[part])[:]
            for part, u in zip(parts, out, strict=True)
        ]
