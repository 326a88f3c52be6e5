"""The whole nonlinear solve beside other finite-element codes, under one dead load.

    python -m tests.benchmarks.peers --dataset beam-coarse --loads 5 --rounds 3
    python -m tests.benchmarks.peers --dataset beam-fine --amplitude 0.5 --amplitude 2 \\
        --peer "felupe, Pardiso"

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
    takes about 1.5 times as long on beam-coarse. So it gets a closed form as a `Material`.
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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from scipy.sparse.linalg import spsolve

import mor_bench
from mor_bench.cli.option_groups import with_options
from mor_bench.mechanics.model import SOLVERS, FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import SolverName
from tests.benchmarks.contenders import (
    TOLERANCE,
    Array,
    Contender,
    Row,
    TimingOptions,
    ends_at_disagreement,
    installed,
    pin_threads,
    timed,
)
from tests.benchmarks.felupe_peer import Felupe, TunedPardiso, default_pardiso
from tests.benchmarks.kratos_peer import KRATOS, TUNED_AMGCL, Kratos

REFERENCE_TOLERANCE = 1e-10
OWN_SOLVERS: tuple[SolverName, ...] = ("auto", "rotated-pcg", "cholesky", "pardiso")


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


def bending_loads(scene: Scene, amplitudes: Sequence[float]) -> Array:
    """Return uniform loads (n, n_nodes, 3), N, on the face x-max that move it so far, m.

    They point along y. Each is found to 0.1 % by a secant in the size of the load.
    """
    x, free, model = scene.mesh.points, scene.free_dofs, FullOrderModel(scene)
    on_end = np.isclose(x[:, 0], x[:, 0].max())
    corners = on_end[scene.mesh.cells]
    facets = scene.mesh.cells[corners.sum(axis=1) == 4], corners[corners.sum(axis=1) == 4]
    weights = np.bincount(facets[0][facets[1]], minlength=len(x)).astype(float)
    unit = np.zeros_like(x)
    unit[:, 1] = weights / weights.sum()

    def moved(size: float) -> float:
        u = np.zeros(scene.mesh.n_dofs)
        u[free] = model.solve(size * unit.ravel()[free]).displacement
        return float(np.linalg.norm(u.reshape(-1, 3)[on_end].mean(axis=0)))

    size, found, loads = 1e-3, moved(1e-3), []
    for amplitude in sorted(amplitudes):
        while abs(found - amplitude) > 1e-3 * amplitude:
            size *= amplitude / found
            found = moved(size)
        loads.append(size * unit)
    return np.stack(loads)


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
    name: str,
    entries: Sequence[Entry],
    amplitudes: Sequence[float],
    options: TimingOptions,
    console: Console,
) -> dict[str, Any]:
    """Compare on one dataset, print the tables, and return their content."""
    scene = mor_bench.load_scene(name)
    if amplitudes:
        samples, forces = list(range(len(amplitudes))), bending_loads(scene, amplitudes)
    else:
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
    chosen = {"amplitudes_m": sorted(amplitudes)} if amplitudes else {"samples": samples}
    size = {"n_unknowns": len(scene.free_dofs)}
    return {**size, **chosen, "load_norms_n": norms, "contenders": contenders}


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
    amplitude: Annotated[
        list[float] | None,
        typer.Option(
            help="Instead of the dataset's loads: one on the end face that moves it so far, m. "
            "Repeat for more.",
            show_default=False,
        ),
    ] = None,
    peer: Annotated[
        list[str] | None,
        typer.Option(help="Only these peers, by label; by default all.", show_default=False),
    ] = None,
    *,
    options: TimingOptions,
) -> None:
    """Time the full-order model beside other finite-element codes."""
    pin_threads("tests.benchmarks.peers", options.threads, avx2=options.avx2)
    console = Console()
    entries = installed_entries(console, solver or OWN_SOLVERS)
    if peer is not None:
        entries = [one for one in entries if one not in PEERS or one.label in peer]
    names, far = dataset or ["beam-coarse", "beam-fine"], amplitude or []
    options.write({"datasets": {n: compare_on(n, entries, far, options, console) for n in names}})


if __name__ == "__main__":
    typer.run(main)
