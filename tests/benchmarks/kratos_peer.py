"""Kratos as a contender: its model of a scene, and its Newton with several linear solvers."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.scene import Scene
from tests.benchmarks.contenders import (
    MAX_STEPS,
    TOLERANCE,
    Array,
    Contender,
    DisagreementError,
    common_material,
)

KRATOS = ("KratosMultiphysics", "KratosStructuralMechanicsApplication")
TUNED_AMGCL = {
    "solver_type": "amgcl",
    "verbosity": 0,
    "krylov_type": "cg",
    "coarsening_type": "smoothed_aggregation",
    "smoother_type": "ilu0",
    "tolerance": 1e-3,
}


@contextmanager
def silent() -> Iterator[None]:
    """Send to nowhere what is printed, from compiled code too: a package's banner."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def kratos_modules() -> tuple[Any, Any]:
    """KratosMultiphysics and its StructuralMechanicsApplication, without their banners."""
    with silent():
        km, sma = map(
            import_module,
            ("KratosMultiphysics", "KratosMultiphysics.StructuralMechanicsApplication"),
        )
    km.Logger.GetDefaultOutput().SetSeverity(km.Logger.Severity.WARNING)
    return km, sma


def kratos_solid(
    scene: Scene, cells: NDArray[np.int64], loaded: NDArray[np.int64]
) -> tuple[Any, Any]:
    """Return a Kratos model and its part with some cells of a scene and point loads on nodes.

    Numbers in Kratos are those of the scene plus one.
    """
    km, sma = kratos_modules()
    material = common_material(scene)
    model = km.Model()
    part = model.CreateModelPart("solid")
    part.ProcessInfo[km.DOMAIN_SIZE] = 3
    for variable in (km.DISPLACEMENT, km.REACTION, km.VOLUME_ACCELERATION, sma.POINT_LOAD):
        part.AddNodalSolutionStepVariable(variable)
    nodes = np.union1d(scene.mesh.cells[cells], loaded)
    for i, point in zip(nodes.tolist(), scene.mesh.points[nodes].tolist(), strict=True):
        part.CreateNewNode(i + 1, *point)
    properties = part.CreateNewProperties(1)
    properties[km.YOUNG_MODULUS], properties[km.POISSON_RATIO] = material.young_pa, material.poisson
    properties[km.CONSTITUTIVE_LAW] = sma.LinearElastic3DLaw()
    for i, cell in zip(cells.tolist(), (scene.mesh.cells[cells] + 1).tolist(), strict=True):
        part.CreateNewElement("TotalLagrangianElement3D8N", i + 1, cell, properties)
    for i in loaded.tolist():
        part.CreateNewCondition("PointLoadCondition3D1N", i + 1, [i + 1], properties)
    for axis in "XYZ":
        displacement = getattr(km, f"DISPLACEMENT_{axis}")
        km.VariableUtils().AddDof(displacement, getattr(km, f"REACTION_{axis}"), part)
        for node in np.intersect1d(scene.fixed_nodes, nodes).tolist():
            part.GetNode(node + 1).Fix(displacement)
    return model, part


def kratos_newton(part: Any, criterion: Any, builder: Any) -> Any:
    """Newton's method without line search, in Kratos."""
    km, _ = kratos_modules()
    scheme = km.ResidualBasedIncrementalUpdateStaticScheme()
    reactions, new_dofs, move_mesh = False, False, True  # this element takes F from the moved mesh
    strategy = km.ResidualBasedNewtonRaphsonStrategy(
        part, scheme, criterion, builder, MAX_STEPS, reactions, new_dofs, move_mesh
    )
    for part_of_solver in (criterion, builder, strategy):
        part_of_solver.SetEchoLevel(0)
    strategy.Initialize()
    strategy.Check()
    return strategy


class Kratos(Contender):
    """Kratos' Newton with one of its linear solvers."""

    def __init__(self, scene: Scene, name: str, linear_solver: dict[str, Any]) -> None:
        self._km, sma = kratos_modules()
        km = self._km
        self.name = f"Kratos, {name}"
        self._load_variable, self._utilities = sma.POINT_LOAD, km.VariableUtils()
        self._model, self._part = kratos_solid(
            scene, np.arange(scene.mesh.n_cells), np.arange(scene.mesh.n_nodes)
        )
        solver = km.LinearSolverFactory().Create(km.Parameters(json.dumps(linear_solver)))
        self._strategy = kratos_newton(
            self._part,
            km.ResidualCriteria(TOLERANCE, 0.0),
            km.ResidualBasedBlockBuilderAndSolver(solver),
        )

    def prepare(self, forces: Array) -> None:
        for node, force in zip(self._part.Nodes, forces.tolist(), strict=True):
            node.SetSolutionStepValue(self._load_variable, force)
        self._utilities.SetHistoricalVariableToZero(self._km.DISPLACEMENT, self._part.Nodes)
        self._utilities.UpdateCurrentToInitialConfiguration(self._part.Nodes)

    def solve(self) -> int:
        self._strategy.InitializeSolutionStep()
        self._strategy.Predict()
        converged = self._strategy.SolveSolutionStep()
        self._strategy.FinalizeSolutionStep()
        if not converged:
            raise DisagreementError(f"{self.name} does not converge in {MAX_STEPS} steps.")
        return int(self._part.ProcessInfo[self._km.NL_ITERATION_NUMBER])

    def displacement(self) -> Array:
        return np.array(
            self._utilities.GetSolutionStepValuesVector(
                self._part.Nodes, self._km.DISPLACEMENT, 0, 3
            )
        ).reshape(-1, 3)
