"""The whole nonlinear solve beside other finite-element codes, under one dead load.

Longer than 400 lines because the codes stand beside the rules that they are compared by.

    python -m tests.benchmarks.peers --dataset beam-coarse --loads 5 --rounds 3

Every contender gets the same nodes, 8-node hexahedra with 2 x 2 x 2 Gauss points, supports and
nodal forces, the Saint Venant-Kirchhoff law, plain Newton from zero displacement, and the same
threads. It stops when the residual on the free dofs is at most 1e-8 of the load on them. Meshes,
patterns and whatever else does not depend on the load are set up before the clock starts, by an
untimed solve. For each load every contender runs once a round, in an order that rotates. Afterwards
our residual and a reference solved to 1e-10 check each answer, and nothing is printed if one is
wrong.

mor-bench
    `FullOrderModel.solve` as it is, with several of its solvers. `auto` is the default: an
    accelerated iteration with the rest-state factor, which all solves share, and no tangent. The
    others are Newton's method, its first step with that factor.
felupe
    Its `newtonraphson` with `tol` related to the load instead of the reactions, which only changes
    when it stops. felupe has no Saint Venant-Kirchhoff law in closed form: its strain-based and its
    differentiated ones (`MaterialStrain`, `Hyperelastic`) give the same iterations, but a solve
    takes about 1.5 times as long on beam-coarse. So it gets the closed form below as a `Material`.
    Linear solvers: SciPy's `spsolve` (felupe's default), `pypardiso.spsolve`, and "tuned Pardiso":
    Cholesky of the upper triangle (mtype 2), analysed once per pattern.
Kratos
    Release build of the package index. `TotalLagrangianElement3D8N` with `LinearElastic3DLaw`,
    linear between second Piola-Kirchhoff stress and Green-Lagrange strain; `ResidualCriteria`,
    whose ratio is to the load for a start at rest; reactions off, printing off. Linear solvers:
    amgcl with Kratos' defaults (GMRES, aggregation, ILU(0), 1e-6), and tuned: conjugate gradients,
    smoothed aggregation, ILU(0), 1e-3. Its sparse LU is left out: several times slower on
    beam-fine.

Steps are Newton iterations, and back-solves with the rest-state factor for `auto`.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, ClassVar

import numpy as np
import scipy.sparse as sp
import typer
from numpy.typing import NDArray
from pydantic import Field
from rich.console import Console
from rich.table import Table
from scipy.sparse.linalg import spsolve

import mor_bench
from mor_bench.cli.option_groups import with_options
from mor_bench.machine import describe_machine
from mor_bench.mechanics.model import SOLVERS, FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.options import CommandLine, Options
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import SolverName

Array = NDArray[np.float64]
LinearSolve = Callable[[Any, Array], Array]

TOLERANCE = 1e-8
REFERENCE_TOLERANCE = 1e-10
MAX_RESIDUAL = 1.01 * TOLERANCE
"""The residuals of two codes differ by round-off."""
MAX_DIFFERENCE = 1e-6
MAX_STEPS = 30
OWN_SOLVERS: tuple[SolverName, ...] = ("auto", "rotated-pcg", "cholesky", "pardiso")
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


class DisagreementError(RuntimeError):
    """A contender did not solve the problem that the others solved."""


class Contender(ABC):
    """A code that solves one scene under one load at a time. Only `solve` is timed."""

    name: str

    @abstractmethod
    def prepare(self, forces: Array) -> None:
        """Take (n_nodes, 3) nodal forces, N, and go back to rest."""

    @abstractmethod
    def solve(self) -> int:
        """Solve, and return the number of Newton steps."""

    @abstractmethod
    def displacement(self) -> Array:
        """(n_nodes, 3) of the last solve, m."""


class Ours(Contender):
    """The full-order model with one of its solvers."""

    def __init__(self, scene: Scene, solver: SolverName) -> None:
        self.name = f"mor-bench, {solver}"
        self._model = FullOrderModel(scene, solver)
        self._free, self._u = scene.free_dofs, np.zeros(scene.mesh.n_dofs)

    def prepare(self, forces: Array) -> None:
        self._load = forces.ravel()[self._free]

    def solve(self) -> int:
        solution = self._model.solve(self._load, options=NewtonOptions(TOLERANCE))
        self._u[self._free] = solution.displacement
        return solution.iterations

    def displacement(self) -> Array:
        return self._u.reshape(-1, 3).copy()


def common_material(scene: Scene) -> SaintVenantKirchhoff:
    """The law of a scene that all sides can solve."""
    if (
        not isinstance(scene.material, SaintVenantKirchhoff)
        or scene.selective
        or scene.mesh.cells.shape[1] != 8
    ):
        raise ValueError(
            f"{scene.name}: the peers are set up for Saint Venant-Kirchhoff in fully integrated "
            "8-node hexahedra only."
        )
    return scene.material


def stress(mu: float, lmbda: float, x: list[Array]) -> list[Array]:
    """Return the stress P = F S, (3, 3, n_points, n_cells), and no state variables."""
    return [np.einsum("iM...,MJ...->iJ...", x[0], second_stress(mu, lmbda, x[0])), x[1]]


def second_stress(mu: float, lmbda: float, F: Array) -> Array:
    """S = λ tr(E) I + 2 μ E."""
    S = mu * np.einsum("mI...,mJ...->IJ...", F, F)
    trace = 0.5 * lmbda * (np.einsum("II...->...", S) / mu - 3)
    for i in range(3):
        S[i, i] += trace - mu
    return np.asarray(S)


def elasticity(mu: float, lmbda: float, x: list[Array]) -> list[Array]:
    """dP/dF = λ F_iJ F_kL + μ (F_iL F_kJ + (F Fᵀ)_ik δ_JL) + δ_ik S_JL."""
    F = x[0]
    A = lmbda * np.einsum("iJ...,kL...->iJkL...", F, F)
    A += mu * np.einsum("iL...,kJ...->iJkL...", F, F)
    B, S = mu * np.einsum("iM...,kM...->ik...", F, F), second_stress(mu, lmbda, F)
    for i in range(3):
        A[:, i, :, i] += B
        A[i, :, i] += S
    return [A]


class TunedPardiso:
    """Pardiso's Cholesky factorisation of the upper triangle, analysed once per pattern."""

    def __init__(self) -> None:
        self._analysed: list[tuple[Any, tuple[Any, Any]]] = []

    def __call__(self, matrix: sp.csr_matrix, rhs: Array) -> Array:
        from pypardiso import PyPardisoSolver

        upper = sp.triu(matrix, format="csr")
        upper.sort_indices()
        for pardiso, pattern in self._analysed:
            if all(map(np.array_equal, pattern, (upper.indptr, upper.indices))):
                pardiso.set_phase(23)
                break
        else:
            pardiso = PyPardisoSolver(mtype=2, phase=13)
            self._analysed.append((pardiso, (upper.indptr, upper.indices)))
        return np.asarray(pardiso._call_pardiso(upper, rhs))


def default_pardiso() -> LinearSolve:
    """pypardiso's `spsolve` with its defaults."""
    from pypardiso import spsolve as solve

    return partial(solve)


class Felupe(Contender):
    """felupe's Newton with one of several linear solvers."""

    def __init__(self, scene: Scene, name: str, make_solver: Callable[[], LinearSolve]) -> None:
        import felupe

        self.name = f"felupe, {name}"
        self._felupe, self._solver, self._free = felupe, make_solver(), scene.free_dofs
        material = common_material(scene)
        mesh = felupe.Mesh(scene.mesh.points, scene.mesh.cells, "hexahedron")
        self._field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        fixed = np.isin(np.arange(scene.mesh.n_nodes), scene.fixed_nodes)
        self._dof0, self._dof1 = felupe.dof.partition(
            self._field, {"fixed": felupe.Boundary(self._field[0], mask=fixed)}
        )
        law = felupe.Material(
            *(
                partial(function, material.lame_mu, material.lame_lambda)
                for function in (stress, elasticity)
            )
        )
        self._body = felupe.SolidBody(law, self._field)
        self._load = felupe.PointLoad(self._field, np.arange(scene.mesh.n_nodes))

    def prepare(self, forces: Array) -> None:
        self._field[0].values = np.zeros_like(forces)
        self._load.update(forces)
        self._size = float(np.linalg.norm(forces.ravel()[self._free]))

    def _check(
        self, *, dx: Array, f: Array, ftol: float, dof1: Any, **_: Any
    ) -> tuple[float, float, bool]:
        residual = float(np.linalg.norm(f[dof1])) / self._size
        return float(np.linalg.norm(dx)), residual, residual <= ftol

    def solve(self) -> int:
        result = self._felupe.newtonraphson(
            x0=self._field,
            items=[self._body, self._load],
            dof0=self._dof0,
            dof1=self._dof1,
            solver=self._solver,
            check=self._check,
            tol=TOLERANCE,
            maxiter=MAX_STEPS,
            verbose=0,
        )
        self._u = result.x[0].values
        return int(result.iterations)

    def displacement(self) -> Array:
        return np.array(self._u)


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


@dataclass(frozen=True)
class Entry:
    """A contender that may run: what it needs, and how it is made."""

    label: str
    needs: tuple[str, ...]
    make: Callable[[Scene], Contender]

    @property
    def missing(self) -> list[str]:
        """Distributions that are not installed."""
        return [name for name in self.needs if not installed(name)]


def installed(distribution: str) -> bool:
    try:
        version(distribution)
    except PackageNotFoundError:
        return False
    return True


KRATOS = ("KratosMultiphysics", "KratosStructuralMechanicsApplication")
TUNED_AMGCL = {
    "solver_type": "amgcl",
    "verbosity": 0,
    "krylov_type": "cg",
    "coarsening_type": "smoothed_aggregation",
    "smoother_type": "ilu0",
    "tolerance": 1e-3,
}
PEERS = (
    Entry("felupe, SuperLU", ("felupe",), lambda scene: Felupe(scene, "SuperLU", lambda: spsolve)),
    Entry(
        "felupe, Pardiso",
        ("felupe", "pypardiso"),
        lambda scene: Felupe(scene, "Pardiso", default_pardiso),
    ),
    Entry(
        "felupe, tuned Pardiso",
        ("felupe", "pypardiso"),
        lambda scene: Felupe(scene, "tuned Pardiso", TunedPardiso),
    ),
    Entry(
        "Kratos, amgcl",
        KRATOS,
        lambda scene: Kratos(scene, "amgcl", {"solver_type": "amgcl", "verbosity": 0}),
    ),
    Entry("Kratos, tuned amgcl", KRATOS, lambda scene: Kratos(scene, "tuned amgcl", TUNED_AMGCL)),
)


def own_entry(solver: SolverName) -> Entry:
    return Entry(
        f"mor-bench, {solver}",
        ("pypardiso",) if solver == "pardiso" else (),
        lambda scene: Ours(scene, solver),
    )


def pick_loads(scene: Scene, n: int) -> tuple[list[int], Array]:
    """Return numbers and forces (n, n_nodes, 3), N, of n samples with evenly spread magnitudes.

    A turn loads each patch once. Patches at supports are left out, where most of the force goes
    into the support.
    """
    drawn = draw_loads(scene, 0, len(scene.patch_nodes))
    usable = np.flatnonzero(~np.isin(scene.patch_nodes, scene.fixed_nodes))
    by_size = usable[np.linalg.norm(drawn.vectors[usable], axis=(1, 2)).argsort()]
    chosen = by_size[((np.arange(n) + 0.5) / n * len(by_size)).astype(int)]
    return chosen.tolist(), drawn[chosen].nodal_forces(scene.patch_weights)


@dataclass
class Row:
    """What one contender did, for each load."""

    name: str
    times_ms: list[list[float]] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    differences: list[float] = field(default_factory=list)

    residual_name: ClassVar[str] = "relative residual"

    @property
    def medians_ms(self) -> Array:
        return np.median(self.times_ms, axis=1)

    @property
    def shown_steps(self) -> str:
        """The fewest and the most steps."""
        return "-".join(map(str, sorted({min(self.steps), max(self.steps)})))

    def check(self, residual: float, u: Array, expected: Array) -> None:
        """Record the residual of an answer and its difference from the expected one.

        Raises
        ------
        DisagreementError
            If one of them is above its tolerance.
        """
        self.residuals.append(residual)
        self.differences.append(float(np.linalg.norm(u - expected) / np.linalg.norm(expected)))
        if not (residual <= MAX_RESIDUAL and self.differences[-1] <= MAX_DIFFERENCE):
            raise DisagreementError(
                f"{self.name} solves another problem: its {self.residual_name} is "
                f"{residual:.2g} (allowed: {TOLERANCE:g}), its displacement differs by "
                f"{self.differences[-1]:.2g} (allowed: {MAX_DIFFERENCE:g})."
            )


def timed(contender: Contender, forces: Array) -> tuple[float, int]:
    contender.prepare(forces)
    gc.disable()
    try:
        start = perf_counter()
        steps = contender.solve()
        return 1e3 * (perf_counter() - start), steps
    finally:
        gc.enable()


def compare(scene: Scene, forces: Array, contenders: Sequence[Contender], rounds: int) -> list[Row]:
    """Time the contenders and check what they answer.

    Parameters
    ----------
    scene : Scene
    forces : (n_loads, n_nodes, 3) float64
        N.
    contenders : sequence of Contender
    rounds : int
        Solves of each load by each contender.

    Returns
    -------
    list of Row
        In the order of the contenders.

    Raises
    ------
    DisagreementError
        If the residual of an answer is above the tolerance, or its displacement is not that of the
        reference.
    """
    model, free = FullOrderModel(scene), scene.free_dofs
    rows = [Row(contender.name) for contender in contenders]
    for contender in contenders:
        timed(contender, forces[0])
    for load in forces:
        target = load.ravel()[free]
        reference = model.solve(target, options=NewtonOptions(REFERENCE_TOLERANCE)).displacement
        for row in rows:
            row.times_ms.append([])
        for turn in range(rounds):
            for i in np.roll(np.arange(len(rows)), -turn).tolist():
                contender, row = contenders[i], rows[i]
                time_ms, steps = timed(contender, load)
                row.times_ms[-1].append(time_ms)
                if turn == 0:
                    row.steps.append(steps)
                    u = contender.displacement().ravel()[free]
                    residual = np.linalg.norm(target - model.force(u).force)
                    row.check(float(residual / np.linalg.norm(target)), u, reference)
    return rows


def print_rows(console: Console, rows: Sequence[Row]) -> None:
    """Times with their checks, and how many times as long as the first contender each takes."""
    times = Table(title="One solve, from rest")
    ratios = Table(title=f"Times as long as {rows[0].name}, per load")
    for table, columns in (
        (times, ("median ms", "min ms", "steps", "residual", "difference")),
        (ratios, ("median", "min", "max")),
    ):
        table.add_column("contender")
        for column in columns:
            table.add_column(column, justify="right")
    for row in rows:
        checks = (f"{max(row.residuals):.1e}", f"{max(row.differences):.1e}")
        times.add_row(
            row.name,
            f"{np.median(row.medians_ms):.2f}",
            f"{np.min(row.times_ms):.2f}",
            row.shown_steps,
            *checks,
        )
        ratio = row.medians_ms / rows[0].medians_ms
        ratios.add_row(
            row.name, *(f"{value:.2f}" for value in (np.median(ratio), ratio.min(), ratio.max()))
        )
    console.print(times, ratios)


def pin_threads(module: str, threads: int) -> None:
    """Start the running module anew with this many threads in every library, unless it has been."""
    pinned = dict.fromkeys(THREAD_VARIABLES, str(threads))
    if any(
        os.environ.get(name) != value for name, value in pinned.items()
    ):  # libraries read them when they are loaded
        os.execve(
            sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], {**os.environ, **pinned}
        )


class TimingOptions(Options):
    """Options of the comparisons with other codes."""

    loads: Annotated[int, Field(ge=1, description="Loads of each dataset.")] = 5
    rounds: Annotated[int, Field(ge=1, description="Solves of each load.")] = 3
    threads: Annotated[int, Field(ge=1, description="Threads of every contender.")] = 1
    report: Annotated[
        Path | None,
        Field(description="Also write everything to this file."),
        CommandLine("--json", metavar="FILE"),
    ] = None

    def write(self, content: dict[str, Any]) -> None:
        """Write the report, if it is wanted."""
        if self.report is not None:
            whole = {"machine": describe_machine(), "threads": self.threads, **content}
            self.report.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


@contextmanager
def ends_at_disagreement(console: Console) -> Iterator[None]:
    """Say why there is no comparison, and exit, if a contender solves another problem."""
    try:
        yield
    except DisagreementError as error:
        console.print(f"no comparison: {error}", style="red", markup=False)
        raise typer.Exit(1) from None


def installed_entries(console: Console, solvers: Sequence[str]) -> list[Entry]:
    """Return our solvers with these names, and the installed peers; say which are skipped."""
    unknown = set(solvers) - set(SOLVERS)
    if unknown:
        raise typer.BadParameter(
            f"--solver must be one of {', '.join(SOLVERS)}; got {', '.join(sorted(unknown))}."
        )
    entries = [*(own_entry(name) for name in SOLVERS if name in solvers), *PEERS]
    for entry in entries:
        if entry.missing:
            console.print(
                f"{entry.label}: skipped, not installed: pip install {' '.join(entry.missing)}",
                markup=False,
            )
    return [entry for entry in entries if not entry.missing]


def compare_on(
    name: str, entries: Sequence[Entry], options: TimingOptions, console: Console
) -> dict[str, Any]:
    """Compare on one dataset, print the tables, and return their content."""
    scene = mor_bench.load_scene(name)
    samples, forces = pick_loads(scene, options.loads)
    norms = [float(np.linalg.norm(load.ravel()[scene.free_dofs])) for load in forces]
    console.rule(
        f"{name}: {scene.mesh.n_cells} cells, {len(scene.free_dofs)} unknowns, "
        f"{options.threads} thread(s)"
    )
    sizes = zip(samples, norms, strict=True)
    shown = ", ".join(f"sample {i} |f| = {norm:.3g} N" for i, norm in sizes)
    console.print(f"Loads: {shown}", highlight=False)
    with ends_at_disagreement(console):
        rows = compare(scene, forces, [entry.make(scene) for entry in entries], options.rounds)
    print_rows(console, rows)
    contenders = [
        {**vars(row), "times_as_long": float(np.median(row.medians_ms / rows[0].medians_ms))}
        for row in rows
    ]
    return {"samples": samples, "load_norms_n": norms, "contenders": contenders}


@with_options
def main(
    dataset: Annotated[
        list[str] | None,
        typer.Option(
            help="Repeat for more; by default beam-coarse and beam-fine.", show_default=False
        ),
    ] = None,
    solver: Annotated[
        list[str] | None,
        typer.Option(help=f"Our solvers; by default {', '.join(OWN_SOLVERS)}.", show_default=False),
    ] = None,
    *,
    options: TimingOptions,
) -> None:
    """Time the full-order model beside other finite-element codes."""
    pin_threads("tests.benchmarks.peers", options.threads)
    console = Console()
    entries = installed_entries(console, solver or OWN_SOLVERS)
    names = dataset or ["beam-coarse", "beam-fine"]
    options.write({"datasets": {n: compare_on(n, entries, options, console) for n in names}})


if __name__ == "__main__":
    typer.run(main)
