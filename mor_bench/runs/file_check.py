"""Check one dataset or method file without running it."""

from __future__ import annotations

from pathlib import Path

from mor_bench.errors import MissingDependencyError
from mor_bench.mechanics.locking import locking_risk
from mor_bench.mechanics.model import missing_library, rest_displacement
from mor_bench.mechanics.rigid_motions import check_supports
from mor_bench.method_loading import check_predicts
from mor_bench.runs.configurations import OWN, check_foreign_method
from mor_bench.sandbox.process import default_memory_limit_bytes
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import default_cache
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.test_sets import check_regions
from mor_bench.specs import (
    DatasetSpec,
    ImportedDatasetSpec,
    check_method,
    is_method_file,
    load_dataset_spec,
    load_method_spec,
)


def check_file(path: Path) -> str:
    """Check a file and describe its content in one line.

    For a dataset, mesh, regions and patches are built and the first sample is drawn. For a method,
    every configuration is checked against its class.

    Raises
    ------
    SpecError, MethodFailedError, UnconstrainedBodyError
        For the first problem, in one line.
    InvalidInputError
        If imported samples cannot be split, or the unseen region overlaps the load region.
    MissingDependencyError
        If the method's class or the dataset's solver needs an extra that is not installed.
    """
    if is_method_file(path):
        method = load_method_spec(path)
        if method.surrogate.startswith(OWN):
            check_method(method)
            check_predicts(method.load_class(), method.surrogate)
        else:
            check_foreign_method(method, default_cache(), default_memory_limit_bytes())
        quick, full = (len(method.configurations(profile)) for profile in ("quick", "full"))
        return f"method, {quick} quick and {full} full configurations"
    spec = load_dataset_spec(path)
    if isinstance(spec, ImportedDatasetSpec):
        return _imported(spec)
    return _generated(spec)


def _generated(spec: DatasetSpec) -> str:
    scene = load_scene(spec)
    check_supports(scene)
    rest_displacement(scene)
    missing = missing_library(spec.solver)
    if missing:
        raise MissingDependencyError(f"{missing}.")
    size = f"{scene.mesh.n_cells} cells, {scene.mesh.n_nodes} nodes"
    if spec.loads is None:
        text = f"scene, {size}; no table `loads`, so no samples can be drawn"
    else:
        draw_loads(scene, 0, 1)
        if spec.tests.unseen_region is not None:
            check_regions(spec)
        loaded = f"{len(scene.patch_nodes)} load patches"
        if scene.motion and scene.observed_nodes is not None:
            loaded = f"{len(scene.observed_nodes)} moved nodes"
        if scene.contact and scene.observed_nodes is not None:
            from mor_bench.mechanics.contact_points import ContactPoints  # other scenes need none

            ContactPoints(scene)  # does the instrument penetrate the body at rest?
            loaded = f"{len(scene.observed_nodes)} nodes to touch"
        if scene.pressure:
            loaded = f"{len(scene.pressure.regions)} pressed regions"
        if len(scene.acting) > 1:
            loaded = f"{len(scene.acting)} tables of loads"
        samples = f"{loaded}, {n_samples_of(scene)} samples"
        text = f"dataset, {size}, {samples}"
    risk = locking_risk(scene)
    return f"{text}; warning: {risk}" if risk else text


def _imported(spec: ImportedDatasetSpec) -> str:
    data = load_dataset(spec)
    mesh, n_fixed = data.scene.mesh, len(data.scene.fixed_nodes)
    return (
        f"dataset of imported snapshots, {mesh.n_cells} cells, {mesh.n_nodes} nodes, "
        f"{n_fixed} of them fixed, {len(data.train)} samples to train, "
        f"{len(data.validation)} to validate and {len(data.test)} to test"
    )
