"""Errors of POD with static correction against Poisson's ratio of the body and of its reduction.

    python -m tests.benchmarks.softened_volume --json softened-volume.json

The body has selective integration, so it does not lock. Its reduced problem has the same shear
modulus, and Poisson's ratio of the body or a smaller one. No cell is left out, so the errors are
those of modes and law alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.static_correction import corrected_snapshots, predict_corrected
from mor_bench.snapshots.dataset import Dataset, Snapshots
from tests.benchmarks.projections import TOLERANCE, ErrorsFile, spread_of, write_rows

Array = NDArray[np.float64]

SCENES = ("beam-nearly-incompressible", "liver-hex")
BODIES = (0.48, 0.49, 0.499)
"""Poisson's ratios of the bodies."""
REDUCED = (0.49, 0.48, 0.45)
"""Smaller Poisson's ratios of the reduced problems."""
SIZES = (20, 40, 80)
"""Numbers of modes."""
LIMIT = 400
"""Samples of each body."""


def dataset_of(name: str, poisson: float) -> Dataset:
    """Return a scene's loads on a body with selective integration and a Poisson's ratio."""
    spec = mor_bench.load_scene(name).spec.model_dump(mode="json")
    spec["discretisation"]["integration"] = "selective"
    shear = spec["material"]["young_pa"] / (1 + spec["material"]["poisson"])
    spec["material"] |= {"poisson": poisson, "young_pa": shear * (1 + poisson)}
    return mor_bench.load_dataset(spec, limit=LIMIT)


def errors_of(model: FullOrderModel, modes: Array, poisson: float, test: Snapshots) -> Array:
    """Return relative l2 errors (n,); infinite where there is no answer."""
    scene = model.scene
    assert scene.material is not None
    soft = replace(scene, material=scene.material.with_poisson(poisson))
    problem = GalerkinProblem(FullOrderModel(soft).assembler, modes)
    errors = np.full(len(test), np.inf)
    for number, (load, u) in enumerate(zip(test.free_forces, test.free_displacements, strict=True)):
        try:
            found = predict_corrected(problem, modes, model, model.rest_factor, load, TOLERANCE)
        except SolverError:
            continue
        errors[number] = np.linalg.norm(found - u) / np.linalg.norm(u)
    return errors


def measured(name: str, poisson: float) -> list[dict[str, Any]]:
    """Return the errors of each size and each Poisson's ratio of the reduced problem."""
    data = dataset_of(name, poisson)
    model, train = FullOrderModel(data.scene), data.train
    linear = model.rest_factor.solve(train.free_forces.T).T
    snapshots = corrected_snapshots(train.free_displacements, linear)
    rows = []
    for size in SIZES:
        modes = np.ascontiguousarray(pod(snapshots, size).modes)
        for reduced in (poisson, *(ratio for ratio in REDUCED if ratio < poisson)):
            errors = errors_of(model, modes, reduced, data.test)
            row = {"dataset": name, "poisson": poisson, "size": size, "reduced": reduced}
            rows.append({**row, "error": spread_of(errors)})
            print(rows[-1], flush=True)
    return rows


def main(report: ErrorsFile = None) -> None:
    """Compare Poisson's ratios of reduced problems with static correction."""
    rows = [row for name in SCENES for poisson in BODIES for row in measured(name, poisson)]
    write_rows(report, rows)


if __name__ == "__main__":
    typer.run(main)
