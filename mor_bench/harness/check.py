"""Validation of one dataset or method file, without running it."""

from __future__ import annotations

from pathlib import Path

from mor_bench.errors import MissingDependencyError
from mor_bench.mechanics.locking import locking_risk
from mor_bench.mechanics.model import check_supports, missing_library
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.sampling import n_samples_of
from mor_bench.specs import check_method, is_method_file, load_dataset_spec, load_method_spec


def check_file(path: Path) -> str:
    """Validate a file and say what it describes.

    A dataset's mesh, regions and patches are built; every configuration of a method is checked against its class.

    Raises
    ------
    SpecError, UnconstrainedBodyError
        The first problem, in one line.
    MissingDependencyError
        If the method's class or the dataset's solver needs an extra that is not installed.
    """
    if is_method_file(path):
        method = load_method_spec(path)
        check_method(method)
        return f"method, {len(method.configurations('quick'))} quick and {len(method.configurations('full'))} full configurations"
    spec = load_dataset_spec(path)
    scene = load_scene(spec)
    check_supports(scene)
    missing = missing_library(spec.solver)
    if missing:
        raise MissingDependencyError(f"{missing}.")
    n_patches = len(scene.patch_nodes)
    samples = n_samples_of(scene)
    said = f"dataset, {scene.mesh.n_cells} cells, {scene.mesh.n_nodes} nodes, {n_patches} load patches, {samples} samples"
    risk = locking_risk(scene)
    return f"{said}; warning: {risk}" if risk else said
