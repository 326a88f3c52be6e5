"""Measure the discretisation error of a scene's mesh on uniformly refined meshes.

Every mesh gets the same forces at the same points of the surface, so resultant and moment agree.
The limit of vanishing cell size is Richardson's extrapolation from the last three meshes, if their
order of convergence is plausible.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.checked_files import read_json
from mor_bench.checkout import source_commit
from mor_bench.errors import (
    InvalidInputError,
    SolverError,
    SpecError,
    StoreError,
    UnsupportedSceneError,
)
from mor_bench.machine import describe_machine
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.mesh_limit import limit_of
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.generate import dataset_folder
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import DatasetSpec, find_suite, load_generated_spec
from mor_bench.version import __version__

FORMAT = "mor-bench discretisation error"
SCHEMA_VERSION = 1
Progress = Callable[[int, int], None]
"""Called with the numbers of finished solves and of all solves."""


@dataclass(frozen=True)
class RefinementPlan:
    """Loads and meshes that `refine` solves.

    Attributes
    ----------
    n_loads : int
        Samples of the dataset, spread over its load patches. At least 1, at most one per patch.
    levels : int
        Refinements, in [1, 10]; each divides every cell into eight.
    max_dofs : int
        Meshes with more degrees of freedom are left out.
    """

    n_loads: int = 5
    levels: int = 2
    max_dofs: int = 150_000


def chosen_samples(scene: Scene, n_loads: int) -> NDArray[np.int64]:
    """Choose samples of a dataset, one from each of equal ranges of its load patches.

    The choice is seeded by the dataset. Where patches come in random order, these are the first
    samples.
    """
    loads, n_patches = scene.generated.load_plan, len(scene.patch_nodes)
    last = loads.steps - 1  # whole loads
    if loads.samples_per_patch is None:
        return np.arange(min(n_loads, n_samples_of(scene) // loads.steps)) * loads.steps + last
    generator = np.random.default_rng([loads.seed, 0xD15C])
    bounds = np.arange(n_loads + 1) * n_patches // n_loads
    patches = generator.integers(bounds[:-1], bounds[1:])
    chosen = generator.integers(loads.samples_per_patch, size=n_loads) * n_patches + patches
    return np.asarray(chosen * loads.steps + last)


def _meshes(scene: Scene, plan: RefinementPlan) -> tuple[list[Scene], list[dict[str, int]]]:
    """Return the scene on its own and refined meshes, and the sizes of meshes that are left out."""
    meshes = [scene]
    for _ in range(plan.levels):
        finer = refined(meshes[-1])
        if finer.mesh.n_dofs > plan.max_dofs:
            if len(meshes) == 1:
                raise InvalidInputError(
                    f"`max_dofs` must be at least {finer.mesh.n_dofs}, the number of "
                    f"unknowns of the first refinement of {scene.name}; got "
                    f"{plan.max_dofs}."
                )
            return meshes, [_size(finer)]
        meshes.append(finer)
    return meshes, []


def _size(scene: Scene) -> dict[str, int]:
    return {"n_cells": scene.mesh.n_cells, "n_dofs": scene.mesh.n_dofs}


class _OnMesh:
    """Some loads of a scene on another mesh of its body, and displacements at the scene's nodes."""

    def __init__(self, scene: Scene, mesh: Scene, loads: Sequence[PatchLoads]) -> None:
        points, shares = scene.patch_points(np.concatenate([load.patches[0] for load in loads]))
        weights = sp.csr_array(shares @ interpolation_matrix(mesh.mesh, points))
        rows = np.split(
            np.arange(weights.shape[0])[:, None],
            np.cumsum([load.patches.size for load in loads])[:-1],
        )
        self.scene = mesh
        if scene.follows:  # the facets that are pressed move, so they are this mesh's own
            weights, rows = mesh.patch_weights, [load.patches.T for load in loads]
        self.forces = [
            PatchLoads(row.T, load.vectors).nodal_forces(weights)[0]
            for row, load in zip(rows, loads, strict=True)
        ]
        self.at_nodes = interpolation_matrix(mesh.mesh, scene.mesh.points)
        self.model = full_order_model(mesh)

    def solve(self, row: int, start: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Solve for displacements (n_nodes of this mesh, 3), m, from a start of that shape."""
        known = [self.forces[row]] if start is None else [self.forces[row], start]
        free = self.scene.at_free_dofs(np.stack(known).reshape(len(known), -1))
        found = self.model.solve(free[0], None if start is None else free[1]).displacement
        return self.scene.at_all_dofs(found[None]).reshape(-1, 3)


@dataclass
class _Load:
    """A load followed from mesh to mesh.

    Attributes
    ----------
    sample : int
    load : PatchLoads
    found : (n_nodes, 3) float64 or None
        Displacements on the last mesh, m, where the next solve starts.
    answers : list of (n_nodes, 3) float64
        Displacements at the scene's nodes, of every mesh.
    reason : str or None
        Reason why a mesh has no equilibrium.
    """

    sample: int
    load: PatchLoads
    found: NDArray[np.float64] | None
    answers: list[NDArray[np.float64]]
    reason: str | None = None

    def record(self) -> dict[str, Any]:
        """Return the load's part of the record."""
        record: dict[str, Any] = {
            "sample": self.sample,
            "patches": self.load.patches[0].tolist(),
            "vectors_n": self.load.vectors[0].tolist(),
            "error_m": None,
            "relative_l2": None,
            "order": None,
            "limit": "none",
        }
        if self.reason is not None:
            return {**record, "reason": self.reason}
        limit, order, kind = limit_of(self.answers)
        errors = sample_errors(self.answers[0][None], limit[None])
        return {
            **record,
            "error_m": float(errors.mean_dof_m[0]),
            "relative_l2": float(errors.relative_l2[0]),
            "order": order,
            "limit": kind,
        }


def _solve_all(scene: Scene, meshes: list[Scene], loads: list[_Load]) -> Iterator[None]:
    """Solve every load on every mesh, coarsest first; yields after each solve."""
    previous: Scene | None = None
    for mesh in meshes:
        on_mesh = _OnMesh(scene, mesh, [load.load for load in loads])
        carried = (
            None if previous is None else interpolation_matrix(previous.mesh, mesh.mesh.points)
        )
        for row, load in enumerate(loads):
            if load.reason is None:
                known = load.found
                start = None if carried is None or known is None else carried @ known
                try:
                    load.found = on_mesh.solve(row, start)
                except SolverError as error:
                    load.reason = f"{mesh.mesh.n_cells} cells: {error}"
                else:
                    load.answers.append(on_mesh.at_nodes @ load.found)
            yield
        previous = mesh


def refine(
    dataset: str | Path | Mapping[str, Any] | DatasetSpec,
    plan: RefinementPlan = RefinementPlan(),
    *,
    cache: Path | None = None,
    suite: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure the discretisation error of a dataset's mesh, and keep it in the dataset's cache.

    Parameters
    ----------
    dataset : str, Path, dict or DatasetSpec
        As for `load_dataset`.
    plan : RefinementPlan
    cache, suite : Path, optional
        Cache folder of datasets; folder with ``datasets/``.
    progress : callable, optional
        Called with (finished solves, all solves).

    Returns
    -------
    dict
        `error_m` and `relative_l2`: means over the loads of the mean absolute error per degree of
        freedom, m, and of the relative l2 error, both against the limit; `relative_l2_median`;
        `meshes` and `left_out`: cells and degrees of freedom; `digest`, `version`, `command`;
        `commit` of the code, None outside a checkout; `date`; `machine`;
        `loads`: each with `sample`, `patches`, `vectors_n`, `error_m`, `relative_l2`, `order` and
        `limit`, which is ``extrapolated``, ``finest``, or ``none`` with a `reason` if a mesh has no
        equilibrium. The means leave out such a load.

    Raises
    ------
    SpecError
        If the dataset is not valid.
    InvalidInputError
        If a number is out of range, or not even the first refinement is within ``max_dofs``.
    SolverError
        If no load has an equilibrium on every mesh.
    """
    spec = dataset if isinstance(dataset, DatasetSpec) else load_generated_spec(dataset, suite)
    scene = load_scene(spec)
    if scene.motion:
        raise UnsupportedSceneError(
            f"{spec.name}: the discretisation error can be measured for forces only, not where "
            "`loads.kind` is 'displacement'."
        )
    if scene.parameter_names:
        raise UnsupportedSceneError(
            f"{spec.name}: the discretisation error can be measured for one body only, not with "
            "the table `parameters`."
        )
    n_patches = n_samples_of(scene) if scene.pressure else len(scene.patch_nodes)
    if not 1 <= plan.n_loads <= n_patches:
        raise InvalidInputError(
            f"`loads` must be an integer in [1, {n_patches}], the number of load patches "
            f"of {spec.name}; got {plan.n_loads}."
        )
    if not 1 <= plan.levels <= 10:
        raise InvalidInputError(f"`levels` must be an integer in [1, 10]; got {plan.levels}.")
    meshes, left_out = _meshes(scene, plan)
    loads = [
        _Load(int(i), draw_loads(scene, int(i), int(i) + 1), None, [])
        for i in chosen_samples(scene, plan.n_loads)
    ]
    for number, _ in enumerate(_solve_all(scene, meshes, loads)):
        if progress:
            progress(number + 1, len(meshes) * len(loads))
    result = _record(spec, plan, loads, [_size(mesh) for mesh in meshes], left_out)
    path = _cached_path(spec, cache)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(result, indent=1, allow_nan=False) + "\n").encode())
    return result


def _record(
    spec: DatasetSpec,
    plan: RefinementPlan,
    loads: list[_Load],
    meshes: list[dict[str, int]],
    left_out: list[dict[str, int]],
) -> dict[str, Any]:
    """Return the record of `refine`, given the sizes of the meshes."""
    records = [load.record() for load in loads]
    solved = [record for record in records if record["error_m"] is not None]
    if not solved:
        raise SolverError(
            f"{spec.name}: no load has an equilibrium on every mesh; the reason for the "
            f"first load: {loads[0].reason}"
        )
    options = f"--loads {plan.n_loads} --levels {plan.levels} --max-dofs {plan.max_dofs}"
    return {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "dataset": spec.name,
        "digest": spec.digest(),
        "version": __version__,
        "command": f"mor-bench refine {spec.name} {options}",
        "commit": source_commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "machine": describe_machine(),
        "error_m": float(np.mean([record["error_m"] for record in solved])),
        "relative_l2": float(np.mean([record["relative_l2"] for record in solved])),
        "relative_l2_median": float(np.median([record["relative_l2"] for record in solved])),
        "meshes": meshes,
        "left_out": left_out,
        "loads": records,
    }


def _cached_path(spec: DatasetSpec, cache: Path | None) -> Path:
    return dataset_folder(spec, cache) / "discretisation.json"


def measured(
    spec: DatasetSpec, cache: Path | None = None, suite: Path | None = None
) -> dict[str, Any] | None:
    """Read the record of `refine` for a dataset, from the cache or shipped as ``*.refine.json``.

    A record belongs to a dataset if the digests of the physics agree. Returns None without one.

    Raises
    ------
    StoreError
        If a record is damaged.
    """
    paths = [path for path in [_cached_path(spec, cache)] if path.exists()]
    for folder in dict.fromkeys([suite, None]):
        with suppress(SpecError):  # a suite need not have datasets
            paths += sorted((find_suite(folder) / "datasets").glob("*.refine.json"))
    for path in paths:
        record = _read(path)
        if record["digest"] == spec.digest():
            return record
    return None


def _read(path: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = read_json(path)
        sound = (record["format"], record["schema_version"]) == (FORMAT, SCHEMA_VERSION)
        sound = sound and isinstance(record["digest"], str)
        sound = sound and all(
            0 <= float(record[key]) < inf for key in ("error_m", "relative_l2_median")
        )
    except (OSError, StoreError, ValueError, KeyError, TypeError):
        sound = False
    if not sound:
        raise StoreError(
            f"{path}: damaged, or not a discretisation error of schema version {SCHEMA_VERSION}; "
            "remove it and run `mor-bench refine`."
        )
    return record
