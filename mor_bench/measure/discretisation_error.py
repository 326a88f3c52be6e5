"""The discretisation error of a scene's own mesh, from a few of its loads solved on uniformly refined meshes.

Every mesh is given the same forces at the same points of the surface, so that resultant and moment
are the same on all. The limit of vanishing cell size is Richardson's from the last three meshes
where the order that they show is sane.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import inf, log2
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SolverError, SpecError, StoreError
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.scene import Scene, load_scene, refined
from mor_bench.snapshots.generate import dataset_folder
from mor_bench.snapshots.sampling import PatchLoads, draw_loads, n_samples_of
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import DatasetSpec, find_suite, load_generated_spec
from mor_bench.version import __version__

FORMAT = "mor-bench discretisation error"
SCHEMA_VERSION = 1
SANE_ORDERS = (0.5, 3.0)
"""Orders of convergence with which a limit is extrapolated; linear elements have 2 at most, less at a clamped edge."""

Progress = Callable[[int, int], None]
"""Called with the solves done and the solves wanted."""


def chosen_samples(scene: Scene, n_loads: int) -> NDArray[np.int64]:
    """Numbers of samples of a dataset, one from each of equal stretches of its load patches, seeded by the dataset.

    Where patches come in random order, the first samples.
    """
    loads, n_patches = scene.generated.loads, len(scene.patch_nodes)
    if loads.samples_per_patch is None:
        return np.arange(min(n_loads, n_samples_of(scene)))
    generator = np.random.default_rng([loads.seed, 0xD15C])
    bounds = np.arange(n_loads + 1) * n_patches // n_loads
    patches = generator.integers(bounds[:-1], bounds[1:])
    return np.asarray(
        generator.integers(loads.samples_per_patch, size=n_loads) * n_patches + patches
    )


def limit_of(
    displacements: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], float | None, str]:
    """The displacement that those of meshes refined by two again and again tend to.

    Parameters
    ----------
    displacements : list of (n_nodes, 3) float64
        At the same nodes, m, coarsest mesh first; at least two.

    Returns
    -------
    limit : (n_nodes, 3) float64
        Richardson's, or the last of the list if there are less than three or their order is not in
        `SANE_ORDERS`.
    order : float or None
        That the last three show.
    kind : {"extrapolated", "finest"}
    """
    finest = displacements[-1]
    if len(displacements) < 3:
        return finest, None, "finest"
    before, last = (
        float(np.linalg.norm(b - a))
        for a, b in zip(displacements[-3:-1], displacements[-2:], strict=True)
    )
    order = log2(before / last) if before > 0 and last > 0 else inf
    if not SANE_ORDERS[0] <= order <= SANE_ORDERS[1]:
        return finest, order if np.isfinite(order) else None, "finest"
    return finest + (finest - displacements[-2]) / (2**order - 1), order, "extrapolated"


def _meshes(scene: Scene, levels: int, max_dofs: int) -> tuple[list[Scene], list[dict[str, Any]]]:
    """The scene on its own and on the refined meshes that are within the limit, and a record of those that are not."""
    meshes = [scene]
    for _ in range(levels):
        finer = refined(meshes[-1])
        if finer.mesh.n_dofs > max_dofs:
            if len(meshes) == 1:
                raise InvalidInputError(
                    f"`max_dofs` must be at least {finer.mesh.n_dofs}, the unknowns of the first refinement of {scene.name}; got {max_dofs}."
                )
            return meshes, [_size(finer)]
        meshes.append(finer)
    return meshes, []


def _size(scene: Scene) -> dict[str, int]:
    return {"n_cells": scene.mesh.n_cells, "n_dofs": scene.mesh.n_dofs}


class _OnMesh:
    """Some loads of a scene on another mesh of its body, and answers at the scene's own nodes."""

    def __init__(self, scene: Scene, mesh: Scene, loads: Sequence[PatchLoads]) -> None:
        points, shares = scene.patch_points(np.concatenate([load.patches[0] for load in loads]))
        weights = sp.csr_array(shares @ interpolation_matrix(mesh.mesh, points))
        rows = np.split(
            np.arange(weights.shape[0])[:, None],
            np.cumsum([load.patches.size for load in loads])[:-1],
        )
        self.scene = mesh
        self.forces = [
            PatchLoads(row.T, load.vectors).nodal_forces(weights)[0]
            for row, load in zip(rows, loads, strict=True)
        ]
        self.at_nodes = interpolation_matrix(mesh.mesh, scene.mesh.points)
        self.model = FullOrderModel(mesh)

    def solve(self, row: int, start: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """(n_nodes of this mesh, 3) displacements, m, from a start of that shape."""
        free = self.scene.free_dofs
        out = np.zeros(self.scene.mesh.n_dofs)
        out[free] = self.model.solve(
            self.forces[row].ravel()[free], None if start is None else start.ravel()[free]
        ).displacement
        return out.reshape(-1, 3)


def refine(
    dataset: str | Path | Mapping[str, Any] | DatasetSpec,
    n_loads: int = 5,
    levels: int = 2,
    *,
    max_dofs: int = 150_000,
    cache: Path | None = None,
    suite: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure the discretisation error of a dataset's mesh, and keep the record beside the dataset's samples.

    Parameters
    ----------
    dataset : str, Path, dict or DatasetSpec
        As for `load_dataset`.
    n_loads : int
        Samples of the dataset that are solved, spread over its load patches.
    levels : int
        Refinements, each of eight cells in the place of one.
    max_dofs : int
        Meshes with more unknowns are left out.
    cache, suite : Path, optional
        Cache folder of datasets; folder with ``datasets/``.
    progress : callable, optional
        Called with (solves done, solves wanted).

    Returns
    -------
    dict
        `error_m` and `relative_l2`: mean over the loads of e (mean absolute error per dof at the
        scene's nodes, m) and of relative l2, against the limit; `relative_l2_median`; `loads`: each
        with `sample`, `patch`, `vector_n`, `error_m`, `relative_l2`, `order` and `limit`
        (`extrapolated`, `finest`, or `none` with a `reason` if a mesh has no equilibrium; such a
        load counts in no mean); `meshes` and `left_out`: cells and dofs; `digest`, `version`,
        `command`.

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
    n_patches = len(scene.patch_nodes)
    if not 1 <= n_loads <= n_patches:
        raise InvalidInputError(
            f"`loads` must be an integer in [1, {n_patches}], the load patches of {spec.name}; got {n_loads}."
        )
    if not 1 <= levels <= 10:
        raise InvalidInputError(f"`levels` must be an integer in [1, 10]; got {levels}.")
    scenes, left_out = _meshes(scene, levels, max_dofs)
    samples = chosen_samples(scene, n_loads)
    loads = [draw_loads(scene, int(i), int(i) + 1) for i in samples]
    answers: list[list[NDArray[np.float64]]] = [[] for _ in samples]
    starts: list[NDArray[np.float64] | None] = [None] * n_loads
    reasons: list[str | None] = [None] * n_loads
    previous: Scene | None = None
    for number, mesh in enumerate(scenes):
        on_mesh = _OnMesh(scene, mesh, loads)
        carried = (
            None if previous is None else interpolation_matrix(previous.mesh, mesh.mesh.points)
        )
        for row in range(n_loads):
            if reasons[row] is None:
                known = starts[row]
                start = None if carried is None or known is None else carried @ known
                try:
                    found = on_mesh.solve(row, start)
                except SolverError as error:
                    reasons[row] = f"{mesh.mesh.n_cells} cells: {error}"
                else:
                    starts[row] = found
                    answers[row].append(on_mesh.at_nodes @ found)
            if progress:
                progress(number * n_loads + row + 1, len(scenes) * n_loads)
        previous = mesh
    records = [
        {
            "sample": int(i),
            "patches": load.patches[0].tolist(),
            "vectors_n": load.vectors[0].tolist(),
            **_errors(answer, reason),
        }
        for i, load, answer, reason in zip(samples, loads, answers, reasons, strict=True)
    ]
    solved = [record for record in records if record["error_m"] is not None]
    if not solved:
        raise SolverError(
            f"{spec.name}: no load has an equilibrium on every mesh; the first: {reasons[0]}"
        )
    result = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "dataset": spec.name,
        "digest": spec.digest(),
        "version": __version__,
        "command": f"mor-bench refine {spec.name} --loads {n_loads} --levels {levels} --max-dofs {max_dofs}",
        "error_m": float(np.mean([record["error_m"] for record in solved])),
        "relative_l2": float(np.mean([record["relative_l2"] for record in solved])),
        "relative_l2_median": float(np.median([record["relative_l2"] for record in solved])),
        "meshes": [_size(mesh) for mesh in scenes],
        "left_out": left_out,
        "loads": records,
    }
    path = _cached_path(spec, cache)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(result, indent=1, allow_nan=False) + "\n").encode())
    return result


def _errors(answers: list[NDArray[np.float64]], reason: str | None) -> dict[str, Any]:
    """The part of a load's record that its displacements on all meshes yield."""
    if reason is not None:
        return {
            "error_m": None,
            "relative_l2": None,
            "order": None,
            "limit": "none",
            "reason": reason,
        }
    limit, order, kind = limit_of(answers)
    errors = sample_errors(answers[0][None], limit[None])
    return {
        "error_m": float(errors.mean_dof_m[0]),
        "relative_l2": float(errors.relative_l2[0]),
        "order": order,
        "limit": kind,
    }


def _cached_path(spec: DatasetSpec, cache: Path | None) -> Path:
    return dataset_folder(spec, cache) / "discretisation.json"


def measured(
    spec: DatasetSpec, cache: Path | None = None, suite: Path | None = None
) -> dict[str, Any] | None:
    """The record of `refine` for a dataset: the one in the cache, else one shipped as ``datasets/*.refine.json``, else None.

    Records are told apart by the digest of the dataset's physics: of a dataset that was changed
    there is none.

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
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        sound = (record["format"], record["schema_version"]) == (
            FORMAT,
            SCHEMA_VERSION,
        ) and isinstance(record["digest"], str)
        sound = sound and all(
            0 <= float(record[key]) < inf for key in ("error_m", "relative_l2_median")
        )
    except (OSError, ValueError, KeyError, TypeError):
        sound = False
    if not sound:
        raise StoreError(
            f"{path}: damaged, or not a discretisation error of schema version {SCHEMA_VERSION}; remove it and run `mor-bench refine`."
        )
    return record
