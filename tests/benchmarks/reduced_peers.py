"""Our reduced-order models beside those of Kratos, with the same basis, mesh, law and loads.

Longer than 400 lines because the models of Kratos stand beside the rules that they are compared by.

    python -m tests.benchmarks.reduced_peers --dataset beam-fine --modes 3 --modes 20 --train 300
    --loads 5 --rounds 3

The modes Φ are those of `mor_bench.reduction.basis.pod` from the first training snapshots, for all
sides. A contender goes from the nodal forces of a test load to the displacements of all nodes, from
rest, until the reduced residual Φᵀ(f - f_int) is at most 1e-8 of the reduced load Φᵀf. For each
load every contender runs once untimed, then once a round, in an order that rotates. Every answer of
Kratos is compared with that of our model of the same modes, cells and weights, and nothing is
printed if one differs; so these have the same error by construction. Errors are those against the
stored full-order displacements: the mean of the nodal error over nodes and loads, m, and the median
over the loads of the relative l2 norm.

mor-bench
    `predict` as it is, wholly: checks, projection of the forces, solve, expansion to all nodes.
    Methods of the suite by their names, with their file's parameters but `n_modes` and `tolerance`
    as here. `hpod` integrates points of the cells that it keeps, "hpod, whole cells" all of theirs,
    as Kratos does. This and `pod` are the models that Kratos' answers are compared with;
    `pod-tensor` claims the answers of `pod` and is held to them.
Kratos
    Release build of the package index, KratosRomApplication. `TotalLagrangianElement3D8N` with
    `LinearElastic3DLaw`, Φ as ROM_BASIS of the nodes, Galerkin projection by either of its
    builders: "global" (`GlobalROMBuilderAndSolver`, its default, projects the assembled system) and
    "elemental" (`ROMBuilderAndSolver`, projects each element). Only the solution step is timed, and
    for HROM the projection of ROM_SOLUTION_INCREMENT to all nodes. The model is set up for each
    load outside of the clock: conditions only on the nodes that the load acts on, and no loads to
    be written. Neither builder works with `ResidualCriteria`. The residual left by "global" is the
    full one, which a Galerkin projection does not bring to zero: it would never stop. "Elemental"
    leaves none: it stops after one step, whatever is left. So each is told the smallest number of
    Newton steps that brings the reduced residual to the tolerance, found by untimed solves. It
    needs no step to see that it has converged, which favours Kratos.
HROM
    Kratos' hyper-reduced model: HROM_WEIGHT on the selected elements, and no others in the model
    part. Point loads are conditions, which Kratos assembles anew in each step; they keep the weight
    1, so that the reduced load is exact as in ours. With the cells and weights of our "hpod, whole
    cells" (ECSW), and with those of Kratos' own `EmpiricalCubatureMethod` (ECM). The latter gets
    our training matrix, its singular vectors being cut at the same relative tolerance, and the sum
    of weights constrained, as Kratos' own training does; "hpod, ECM cells" is our model with these.

Whoever takes less than 10 ms solves again and again in its turn, as in a running simulation, and
the median counts. Steps are Newton steps in Kratos, and reduced back-solves in ours. A speed-up is
over the faster POD of Kratos, each load's fastest round over the fastest, and the median over the
loads.
"""

from __future__ import annotations

import inspect
import json
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from copy import copy
from dataclasses import dataclass, field
from importlib import import_module
from io import StringIO
from typing import Annotated, Any, ClassVar

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import mor_bench
from mor_bench.cli.option_groups import with_options
from mor_bench.counting import counted
from mor_bench.errors import MissingDependencyError, UnsupportedSceneError
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import ecsw_system
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import list_suite, load_method_spec
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pod import PODGalerkin
from tests.benchmarks.peers import (
    KRATOS,
    MAX_STEPS,
    TOLERANCE,
    Array,
    Contender,
    DisagreementError,
    Row,
    TimingOptions,
    ends_at_disagreement,
    installed,
    kratos_modules,
    kratos_newton,
    kratos_solid,
    pin_threads,
    silent,
    timed,
)

KRATOS_ROM = (*KRATOS, "KratosRomApplication")
METHODS = ("pod", "hpod", "pod-tensor")
SAME_AS_POD = ("pod-tensor",)
"""Methods that solve the equations of `pod` in another way."""
BUILDERS = {"global": "GlobalROMBuilderAndSolver", "elemental": "ROMBuilderAndSolver"}
UNKNOWNS = ["DISPLACEMENT_X", "DISPLACEMENT_Y", "DISPLACEMENT_Z"]
TURN_MS = 10.0
"""A contender that is faster than this solves several times in its turn."""

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


class Ours(Reduced):
    """A fitted method of the suite."""

    def __init__(self, name: str, method: Surrogate, twin: Twin | None) -> None:
        self.name, self.twin, self._method = f"mor-bench, {name}", twin, method
        problem = getattr(method, "problem_", None)
        integrated = getattr(problem, "assembler", None) or getattr(problem, "points", None)
        self.n_cells = None if integrated is None else integrated.n_cells

    def set_up(self, forces: Array) -> None:
        with counted() as cost:
            self._method.predict(forces)
        self._steps = cost.reduced_back_solves

    def prepare(self, forces: Array) -> None:
        self._forces = forces

    def solve(self) -> int:
        self._u = self._method.predict(self._forces)
        return self._steps

    def displacement(self) -> Array:
        return self._u


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


def own_methods(
    scene: Scene,
    snapshots: Snapshots,
    names: Sequence[str],
    n_modes: int,
    say: Callable[[str], None],
) -> dict[str, Surrogate]:
    """Return fitted methods by name; say why others are left out."""
    fitted = {}
    for name in names:
        if name not in list_suite("methods"):
            say(f"{name}: skipped, there is no such method")
            continue
        try:
            knobs = inspect.signature(load_method_spec(name).load_class()).parameters
            if "n_modes" not in knobs:
                say(f"{name}: skipped, it has no parameter `n_modes`")
                continue
            tolerance = {"tolerance": TOLERANCE} if "tolerance" in knobs else {}
            fitted[name] = mor_bench.load_method(name, n_modes=n_modes, **tolerance).fit(
                scene, snapshots
            )
        except (MissingDependencyError, UnsupportedSceneError) as error:
            say(f"{name}: skipped, {error}")
    return fitted


def make_contenders(
    scene: Scene,
    snapshots: Snapshots,
    n_modes: int,
    methods: Sequence[str] = METHODS,
    say: Callable[[str], None] = print,
) -> list[Reduced]:
    """Our methods, and Kratos' models if it is installed.

    Parameters
    ----------
    scene : Scene
    snapshots : Snapshots
        Training samples.
    n_modes : int
    methods : sequence of str
        Names in the suite.
    say : callable
        Told in a line who does not take part, and why.

    Raises
    ------
    ValueError
        If the scene is none that both sides can solve.
    """
    fitted = own_methods(scene, snapshots, list(dict.fromkeys(("pod", *methods))), n_modes, say)
    pod, hpod = (
        fitted["pod"],
        mor_bench.load_method("hpod", n_modes=n_modes, tolerance=TOLERANCE, sampling="cells").fit(
            scene, snapshots
        ),
    )
    assert isinstance(pod, PODGalerkin)
    assert isinstance(hpod, HyperReducedPOD)
    own: list[Reduced] = [
        Ours(name, fitted[name], pod if name in SAME_AS_POD else None)
        for name in methods
        if name in fitted
    ]
    own.append(Ours("hpod, whole cells", hpod, None))
    missing = [name for name in KRATOS_ROM if not installed(name)]
    if missing:
        say(f"Kratos: skipped, not installed: pip install {' '.join(missing)}")
        return own
    peers: list[Reduced] = [KratosReduced(scene, "POD", pod, builder) for builder in BUILDERS]
    peers += [KratosReduced(scene, "HROM, ECSW", hpod, builder) for builder in BUILDERS]
    other = kratos_cubature(hpod, snapshots)
    if other is None:
        say("Kratos HROM, ECM: skipped, its cubature leaves out no cell")
        return [*own, *peers]
    peers.append(KratosReduced(scene, "HROM, ECM", other, "elemental"))
    return [*own, Ours("hpod, ECM cells", other, None), *peers]


@dataclass
class ReducedRow(Row):
    """What one contender did, for each load."""

    n_cells: int | None = None
    errors_m: list[float] = field(default_factory=list)
    relative_l2: list[float] = field(default_factory=list)

    residual_name: ClassVar[str] = "relative reduced residual"

    @property
    def best_ms(self) -> Array:
        return np.asarray(np.min(self.times_ms, axis=1))


def compare(
    forces: Array, references: Array, contenders: Sequence[Reduced], rounds: int
) -> list[ReducedRow]:
    """Time the contenders and check what they answer.

    Parameters
    ----------
    forces : (n_loads, n_nodes, 3) float64
        N.
    references : (n_loads, n_nodes, 3) float64
        Full-order displacements, m.
    contenders : sequence of Reduced
    rounds : int
        Solves of each load by each contender.

    Returns
    -------
    list of ReducedRow
        In the order of the contenders. `residuals` and `differences` are those with the equations
        and the answers of their twins, where there is one; `errors_m` are means over the nodes of
        the Euclidean error.

    Raises
    ------
    DisagreementError
        If an answer is not that of its twin, or leaves a reduced residual above the tolerance.
    """
    rows = [ReducedRow(contender.name, n_cells=contender.n_cells) for contender in contenders]
    for load, reference in zip(forces, references, strict=True):
        for contender, row in zip(contenders, rows, strict=True):
            contender.set_up(load)
            row.times_ms.append([])
        for turn in range(rounds):
            for i in np.roll(np.arange(len(rows)), -turn).tolist():
                contender, row = contenders[i], rows[i]
                time_ms, steps = _turn(contender, load)
                row.times_ms[-1].append(time_ms)
                u = contender.displacement()
                if contender.twin is not None:
                    residual = reduced_residual(contender.twin, u, load)
                    row.check(residual, u, contender.twin.predict(load))
                if turn == 0:
                    row.steps.append(steps)
                    row.errors_m.append(float(np.linalg.norm(u - reference, axis=1).mean()))
                    row.relative_l2.append(
                        float(sample_errors(u[None], reference[None]).relative_l2[0])
                    )
    return rows


def _turn(contender: Reduced, load: Array) -> tuple[float, int]:
    """Return the time of a solve, ms; that of a short one is the median of several."""
    time_ms, steps = timed(contender, load)
    if time_ms >= TURN_MS:
        return time_ms, steps
    return float(
        np.median([timed(contender, load)[0] for _ in range(int(TURN_MS / time_ms) + 1)])
    ), steps


def speed_ups(rows: Sequence[ReducedRow]) -> Array | None:
    """Return speed-ups (n_rows, n_loads) over the faster POD of Kratos; None without Kratos."""
    pods = [row.best_ms for row in rows if row.name.startswith("Kratos POD")]
    if not pods:
        return None
    return np.asarray(np.min(pods, axis=0) / np.array([row.best_ms for row in rows]))


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def print_rows(console: Console, rows: Sequence[ReducedRow], n_modes: int) -> None:
    """Times, checks and errors, the slowest first."""
    times = Table(title=f"r = {n_modes}: from nodal forces to all nodal displacements")
    errors = Table(title=f"r = {n_modes}: checks, largest, and errors against the full order")
    figures = ("cells", "steps", "median ms", "min ms", "speed-up")
    checked = ("residual", "differs by", "error m", "relative l2")
    for table, names in ((times, figures), (errors, checked)):
        table.add_column("contender", no_wrap=True)
        for name in names:
            table.add_column(name, justify="right")
    faster = speed_ups(rows)
    for i in np.argsort([-np.median(row.medians_ms) for row in rows]).tolist():
        row = rows[i]
        times.add_row(
            row.name,
            "" if row.n_cells is None else str(row.n_cells),
            row.shown_steps,
            _digits(float(np.median(row.medians_ms))),
            _digits(float(np.min(row.times_ms))),
            "" if faster is None else _digits(float(np.median(faster[i]))),
        )
        checks = [
            f"{max(values):.1e}" if values else "" for values in (row.residuals, row.differences)
        ]
        errors.add_row(
            row.name, *checks, f"{np.mean(row.errors_m):.3g}", f"{np.median(row.relative_l2):.3g}"
        )
    console.print(times, errors)


@with_options
def main(
    dataset: Annotated[str, typer.Option(help="Name, or path of a TOML.")] = "beam-fine",
    modes: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Repeat for more; by default 3, 10 and 20.", show_default=False),
    ] = None,
    train: Annotated[int, typer.Option(min=1, help="Training snapshots.")] = 300,
    method: Annotated[
        list[str] | None,
        typer.Option(help=f"Our methods; by default {', '.join(METHODS)}.", show_default=False),
    ] = None,
    *,
    options: TimingOptions,
) -> None:
    """Time reduced-order models beside those of Kratos."""
    pin_threads("tests.benchmarks.reduced_peers", options.threads)
    console = Console()
    data = mor_bench.load_dataset(dataset, limit=2 * train)
    if len(data.train) < train or len(data.test) < options.loads:
        raise typer.BadParameter(
            f"the first {2 * train} samples of {dataset} are {len(data.train)} for training and "
            f"{len(data.test)} for tests; "
            f"--train and --loads ask for {train} and {options.loads}."
        )
    scene, snapshots = data.scene, data.train[:train]
    chosen = np.linspace(0, len(data.test) - 1, options.loads).astype(int)
    forces, references = data.test[chosen].forces, data.test[chosen].displacements
    console.rule(
        f"{dataset}: {scene.mesh.n_cells} cells, {len(scene.free_dofs)} unknowns, "
        f"{train} training snapshots, {options.threads} thread(s)"
    )
    report: dict[str, Any] = {"dataset": dataset, "train": train, "modes": {}}
    report["test_samples"] = chosen.tolist()
    said: set[str] = set()

    def say(line: str) -> None:
        if line not in said:
            console.print(line, markup=False)
        said.add(line)

    for n_modes in modes or (3, 10, 20):
        with ends_at_disagreement(console):
            contenders = make_contenders(scene, snapshots, n_modes, method or METHODS, say)
            rows = compare(forces, references, contenders, options.rounds)
        print_rows(console, rows, n_modes)
        report["modes"][n_modes] = [vars(row) for row in rows]
    options.write(report)


if __name__ == "__main__":
    typer.run(main)
