"""Validation of one dataset or method file, without running it."""

from __future__ import annotations

from pathlib import Path

from mor_bench.errors import MissingDependencyError
from mor_bench.mechanics.locking import locking_risk
from mor_bench.mechanics.model import check_supports, missing_library
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.test_sets import check_regions
from mor_bench.specs import (
    ImportedDatasetSpec,
    check_method,
    is_method_file,
    load_dataset_spec,
    load_method_spec,
)


def check_file(path: Path) -> str:
    """Validate a file and say what it describes.

    A dataset's mesh, regions and patches are built, and its first sample is drawn; every configuration of a method is checked against its class.

    Raises
    ------
    SpecError, UnconstrainedBodyError
        The first problem, in one line.
    InvalidInputError
        If imported samples cannot be split as the file says, or `tests.unseen_region` is not apart from `loads.region`.
    MissingDependencyError
        If the method's class or the dataset's solver needs an extra that is not installed.
    """
    if is_method_file(path):
        method = load_method_spec(path)
        check_method(method)
        return f"method, {len(method.configurations('quick'))} quick and {len(method.configurations('full'))} full configurations"
    spec = load_dataset_spec(path)
    if isinstance(spec, ImportedDatasetSpec):
        return _imported(spec)
    scene = load_scene(spec)
    check_supports(scene)
    missing = missing_library(spec.solver)
    if missing:
        raise MissingDependencyError(f"{missing}.")
    draw_loads(scene, 0, 1)
    if spec.tests.unseen_region is not None:
        check_regions(spec)
    n_patches = len(scene.patch_nodes)
    samples = n_samples_of(scene)
    said = f"dataset, {scene.mesh.n_cells} cells, {scene.mesh.n_nodes} nodes, {n_patches} load patches, {samples} samples"
    risk = locking_risk(scene)
    return f"{said}; warning: {risk}" if risk else said


def _imported(spec: ImportedDatasetSpec) -> str:
    data = load_dataset(spec)
    mesh = data.scene.mesh
    return (
        f"dataset of imported snapshots, {mesh.n_cells} cells, {mesh.n_nodes} nodes, {len(data.scene.fixed_nodes)} of them fixed, "
        f"{len(data.train)} samples to train and {len(data.test)} to test"
    )
