"""Reduced models as contenders: Kratos' Galerkin models with our modes, cells and weights."""

from __future__ import annotations

import json
from abc import abstractmethod
from contextlib import redirect_stdout
from copy import copy
from importlib import import_module
from io import StringIO
from typing import Any

import numpy as np

from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import ecsw_system
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pod import PODGalerkin
from tests.benchmarks.contenders import MAX_STEPS, TOLERANCE, Array, Contender, DisagreementError
from tests.benchmarks.kratos_peer import (
    KRATOS,
    kratos_modules,
    kratos_newton,
    kratos_solid,
    silent,
)

KRATOS_ROM = (*KRATOS, "KratosRomApplication")
BUILDERS = {"global": "GlobalROMBuilderAndSolver", "elemental": "ROMBuilderAndSolver"}
UNKNOWNS = ["DISPLACEMENT_X", "DISPLACEMENT_Y", "DISPLACEMENT_Z"]

Twin = PODGalerkin | HyperReducedPOD


class Reduced(Contender):
    """A reduced-order model.

    Attributes
    ----------
    twin : PODGalerkin, HyperReducedPOD or None
        The model whose answers it must give.
    n_cells : int or None
        Cells that it integrates over, if it does.
    """

    twin: Twin | None
    n_cells: int | None

    @abstractmethod
    def set_up(self, forces: Array) -> None:
        """Do once what a new load (n_nodes, 3), N, needs, outside of the clock."""


class KratosReduced(Reduced):
    """Kratos' Galerkin model with our modes, over all cells or over our weighted cells."""

    twin: Twin

    def __init__(self, scene: Scene, name: str, twin: Twin, builder: str) -> None:
        self._km, sma = kratos_modules()
        with silent():
            self._rom = import_module("KratosMultiphysics.RomApplication")
        km = self._km
        self.name, self.twin, self._scene, self._builder = (
            f"Kratos {name}, {builder}",
            twin,
            scene,
            BUILDERS[builder],
        )
        self._load_variable, self._utilities = sma.POINT_LOAD, km.VariableUtils()
        modes = np.zeros((scene.mesh.n_dofs, twin.modes_.shape[1]))
        modes[scene.free_dofs] = twin.modes_
        self._modes = modes.reshape(scene.mesh.n_nodes, 3, -1)
        self._cells, self._weights = np.arange(scene.mesh.n_cells), None
        if isinstance(twin, HyperReducedPOD):
            self._cells, self._weights = twin.cells_, twin.weights_
        self.n_cells = len(self._cells)
        self._all_model = km.Model()
        self._all = self._all_model.CreateModelPart("all")
        self._all.AddNodalSolutionStepVariable(km.DISPLACEMENT)
        for i, point in enumerate(scene.mesh.points.tolist(), 1):
            self._all.CreateNewNode(i, *point)
        self._set_basis(self._all)

    def _set_basis(self, part: Any) -> None:
        for node in part.Nodes:
            node.SetValue(self._rom.ROM_BASIS, self._km.Matrix(self._modes[node.Id - 1]))

    def set_up(self, forces: Array) -> None:
        """Make the model of this load, and find how many steps it needs."""
        km, rom = self._km, self._rom
        loaded = np.flatnonzero(forces.any(axis=1))
        self._model, self._part = kratos_solid(self._scene, self._cells, loaded)
        self._set_basis(self._part)
        if self._weights is not None:
            for element, weight in zip(self._part.Elements, self._weights.tolist(), strict=True):
                element.SetValue(rom.HROM_WEIGHT, km.Vector(1, weight))
            for condition in self._part.Conditions:
                condition.SetValue(rom.HROM_WEIGHT, km.Vector(1, 1.0))
        for i in loaded.tolist():
            self._part.GetNode(i + 1).SetSolutionStepValue(self._load_variable, forces[i].tolist())
        settings = {"nodal_unknowns": UNKNOWNS, "number_of_rom_dofs": self._modes.shape[2]}
        solver = km.LinearSolverFactory().Create(
            km.Parameters('{"solver_type": "skyline_lu_factorization"}')
        )  # asked for, not used
        builder = getattr(rom, self._builder)(solver, km.Parameters(json.dumps(settings)))
        never = km.DisplacementCriteria(0.0, 0.0)
        self._strategy = kratos_newton(self._part, never, builder)
        for self._steps in range(1, MAX_STEPS + 1):
            self._strategy.SetMaxIterationNumber(self._steps)
            self.prepare(forces)
            self.solve()
            if reduced_residual(self.twin, self.displacement(), forces) <= TOLERANCE:
                return
        raise DisagreementError(f"{self.name} does not converge in {MAX_STEPS} steps.")

    def prepare(self, forces: Array) -> None:
        for part in (self._part, self._all):
            self._utilities.SetHistoricalVariableToZero(self._km.DISPLACEMENT, part.Nodes)
        self._utilities.UpdateCurrentToInitialConfiguration(self._part.Nodes)

    def solve(self) -> int:
        self._strategy.InitializeSolutionStep()
        self._strategy.Predict()
        self._strategy.SolveSolutionStep()
        self._strategy.FinalizeSolutionStep()
        if self._weights is not None:
            increment = self._rom.ROM_SOLUTION_INCREMENT
            self._all.SetValue(increment, self._part.GetValue(increment))
            self._rom.RomAuxiliaryUtilities.ProjectRomSolutionIncrementToNodes(UNKNOWNS, self._all)
        return int(self._part.ProcessInfo[self._km.NL_ITERATION_NUMBER])

    def displacement(self) -> Array:
        part = self._part if self._weights is None else self._all
        return np.array(
            self._utilities.GetSolutionStepValuesVector(part.Nodes, self._km.DISPLACEMENT, 0, 3)
        ).reshape(-1, 3)


def reduced_residual(model: Twin, displacement: Array, forces: Array) -> float:
    """Return ‖Φᵀ(f - f_int)‖ / ‖Φᵀf‖ of displacements (n_nodes, 3), m, with a model's cubature."""
    free, modes = model.scene_.free_dofs, model.modes_
    load = modes.T @ forces.ravel()[free]
    return float(
        np.linalg.norm(load - model.problem_.force(modes.T @ displacement.ravel()[free]).force)
        / np.linalg.norm(load)
    )


def kratos_cubature(hpod: HyperReducedPOD, snapshots: Snapshots) -> HyperReducedPOD | None:
    """Return our hyper-reduced model with Kratos' cubature; None if that keeps all cells."""
    with silent():
        method = import_module(
            "KratosMultiphysics.RomApplication.empirical_cubature_method"
        ).EmpiricalCubatureMethod
    model, displacements = FullOrderModel(hpod.scene_), snapshots.free_displacements
    chosen = np.unique(
        np.linspace(0, len(displacements) - 1, hpod.n_cubature_snapshots).astype(int)
    )
    system = ecsw_system(
        model.assembler, model.cell_dofs, hpod.modes_, displacements[chosen] @ hpod.modes_
    )
    _, values, vectors = np.linalg.svd(system, full_matrices=False)
    left_out = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
    kept = int((left_out >= hpod.cubature_tolerance * left_out[0]).sum())
    if kept + 1 >= system.shape[1]:  # it selects a cell for each vector and one for the sum
        return None
    selector = method()
    with redirect_stdout(StringIO()):
        selector.SetUp(vectors[:kept].T)
        selector.Run()
    if not selector.success:
        return None
    order = np.argsort(selector.z)
    cubature = {"cells": selector.z[order], "weights": selector.w.ravel()[order]}
    return copy(hpod).restore(hpod.scene_, {"modes": hpod.modes_, **cubature}, hpod.sizes_)
