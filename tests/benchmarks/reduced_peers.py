"""Our reduced-order models beside those of Kratos, with the same basis, mesh, law and loads.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
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
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import list_suite, load_method_spec
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pod import PODGalerkin
from tests.benchmarks.contenders import (
    TOLERANCE,
    Array,
    Row,
    TimingOptions,
    ends_at_disagreement,
    installed,
    pin_threads,
    timed,
)
from tests.benchmarks.kratos_reduced import (
    BUILDERS,
    KRATOS_ROM,
    KratosReduced,
    Reduced,
    Twin,
    kratos_cubature,
    reduced_residual,
)

METHODS = ("pod", "hpod", "pod-tensor")
SAME_AS_POD = ("pod-tensor",)
"""Methods that solve the equations of `pod` in another way."""
TURN_MS = 10.0
"""A contender that is faster than this solves several times in its turn."""


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
    pin_threads("tests.benchmarks.reduced_peers", options.threads, avx2=options.avx2)
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
