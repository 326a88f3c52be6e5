"""Hard cases of the full-order model: loads that have no equilibrium, materials, shapes and meshes that are ill-suited."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import (
    IllConditionedWarning,
    InvertedElementError,
    LockingWarning,
    MorBenchError,
    NoEquilibriumError,
    SolverError,
    UnconstrainedBodyError,
)
from mor_bench.hard_cases.case import Case, Outcome, Subject, judged, refused, scene_of
from mor_bench.hard_cases.setups import (
    LIMIT_PA,
    Bars,
    cantilever,
    confined_column,
    dense,
    distorted_box,
    free_assembler,
    make_arch,
    make_bars,
    material_table,
    patch_test_error,
    tip,
    tip_load,
)
from mor_bench.measure.discretisation_error import limit_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.mechanics.rotated import condition_number
from mor_bench.mechanics.stability import limit_load, solve_on_path
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.soundness import tidied
from mor_bench.specs import SolverName
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.fem import FullFEM

Array = NDArray[np.float64]

KINDS = {"H8": (False, False), "H8 selective": (False, True), "T4": (True, False)}
"""Elements: whether of tetrahedra, and whether integrated selectively."""

SLENDER_EXACT = 0.19235
"""Tip deflection over the length of the elastica at PL²/EI = 0.6, from elliptic integrals (Bisshopp and Drucker 1945)."""


def full_order(method: Surrogate) -> bool:
    """The full-order model, with any solver."""
    return isinstance(method, FullFEM)


def as_shipped(method: Surrogate) -> bool:
    """The full-order model with its own solver; what does not depend on the solver is tried once."""
    return isinstance(method, FullFEM) and method.solver is None


def _solver(subject: Subject) -> SolverName | None:
    solver: SolverName | None = subject.fresh().parameters["solver"]
    return solver


@contextmanager
def _caught(kind: type[Warning]) -> Iterator[list[str]]:
    """The messages of the warnings of a kind that were given meanwhile."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield found
    found += [str(warning.message) for warning in caught if issubclass(warning.category, kind)]


def inversion(subject: Subject) -> Outcome:
    counts = {"inverted": 0, "no equilibrium": 0}
    wrong = []
    for kind, (tetrahedra, selective) in KINDS.items():
        for factor in (1.01, 1.5, 3.0):
            for steps in (1, 10):
                column, q = confined_column(tetrahedra=tetrahedra, selective=selective), None
                for level in factor * np.arange(1, steps + 1) / steps:
                    try:
                        q = solve_equilibrium(column, np.array([level * LIMIT_PA]), q).displacement
                    except SolverError as error:
                        counts[
                            "inverted"
                            if isinstance(error, InvertedElementError)
                            else "no equilibrium"
                        ] += 1
                        if level <= 1:
                            wrong.append(f"{kind}: refused at {level:.3g} of the limit")
                    else:
                        if level > 1:
                            wrong.append(
                                f"{kind}: answered at {level:.3g} of the limit with stretch {1 + q[0]:.3g}"
                            )
    told = f"{counts['inverted']} loads beyond the limit ended as inverted, {counts['no equilibrium']} as no-equilibrium"
    return judged(not wrong, "; ".join([told, *wrong[:3]]), **counts, wrong=len(wrong))


def snap_through(subject: Subject) -> Outcome:
    arch = make_arch()
    limit, exact = limit_load(arch.problem, arch.load), arch.greatest_reaction()
    if limit is None:
        return judged(False, f"no limit found; under a prescribed displacement it is {exact:.6g} N")
    beyond = "1.5 times the limit was answered"
    try:
        solve_on_path(arch.problem, 1.5 * limit.factor * arch.load)
    except NoEquilibriumError as error:
        beyond = str(error)
    named = (
        re.search(r"ends at \S+ of the load, where the lowest tangent eigenvalue is \S+ of", beyond)
        is not None
    )
    off = abs(limit.factor / exact - 1)
    happened = f"limit {limit.factor:.6g} N, {off:.0e} from the top of the displacement-driven path; lowest eigenvalue {limit.lowest_eigenvalue:.1e}"
    good = off <= 1e-6 and 0 < limit.lowest_eigenvalue < 1e-3 and named
    happened += "" if named else f"; beyond it: {beyond}"
    return judged(
        good,
        happened,
        limit_n=limit.factor,
        exact_n=exact,
        lowest_eigenvalue=limit.lowest_eigenvalue,
    )


def near_incompressible(subject: Subject) -> Outcome:
    solver, size, cells = _solver(subject), [4.0, 1.0, 1.0], [12, 3, 3]
    reference = tip(cantilever(size, cells, 0.3, solver=solver), -50.0)[2]
    told, good, measured = [], True, {}
    for poisson in (0.48, 0.49, 0.499, 0.4999):
        ratios = []
        for integration in ("full", "selective"):
            with _caught(LockingWarning) as locking:
                model = cantilever(size, cells, poisson, integration, solver=solver)
            load = tip_load(model, -50.0)
            solution = model.solve(load)
            residual = float(
                np.linalg.norm(load - model.force(solution.displacement).force)
                / np.linalg.norm(load)
            )
            good &= (
                residual <= 1e-8
                and solution.min_det_f > 0
                and bool(locking) == (integration == "full")
            )
            ratios.append(float(tip(model, -50.0)[2] / reference))
        good &= abs(ratios[1] - 1) <= 0.08
        told.append(f"{poisson}: {ratios[0]:.2f}, {ratios[1]:.2f}")
        measured[f"full_{poisson}"], measured[f"selective_{poisson}"] = ratios
    return judged(
        good,
        f"tip deflection over that of ν = 0.3, full and selective integration, by ν: {'; '.join(told)}",
        **measured,
    )


def slender(subject: Subject) -> Outcome:
    """The suite reports the locking of a mesh as its discretisation error, by refinement; it must not be told too small."""
    length, solver = 100.0, _solver(subject)
    deflections, ends = [], []
    for level in range(3):
        model = cantilever([length, 1.0, 1.0], [50 * 2**level, 1, 2], 0.0, solver=solver)
        end = tip(model, -0.6 * 1000.0 / length**2)
        deflections.append(float(-end[2] / length))
        ends.append(end[None])
    limit = limit_of(ends)[0]
    reported = float(np.linalg.norm(ends[0] - limit) / np.linalg.norm(limit))
    actual = 1 - deflections[0] / SLENDER_EXACT
    happened = f"w/L {', '.join(f'{w:.4f}' for w in deflections)} with 50, 100, 200 cells along it; exact {SLENDER_EXACT}; "
    happened += f"locking of the first {actual:.0%}, reported by refinement {reported:.0%}"
    good = (
        deflections[0] < deflections[1] < deflections[2] < 1.02 * SLENDER_EXACT
        and reported >= 0.5 * actual
    )
    return judged(good, happened, deflections=deflections, exact=SLENDER_EXACT, reported=reported)


def huge_step(subject: Subject) -> Outcome:
    scene = scene_of(subject.scenes.spec, material=material_table("neo-hookean", 500.0, 0.4))
    model = FullOrderModel(scene, _solver(subject))
    force = scene.patch_weights[[-1]].toarray()[0][:, None] * np.array([-20.0, 0.0, -20.0])
    load = force.ravel()[scene.free_dofs]
    solution, q = model.solve(load), None
    for level in np.linspace(0.05, 1.0, 20):
        q = model.solve(level * load, start=q).displacement
    assert q is not None
    off = float(np.abs(solution.displacement - q).max() / np.abs(q).max())
    happened = f"{solution.iterations} iterations and {solution.cuts} cut-backs to within {off:.0e} of 20 small steps"
    said = _told_beyond_the_limit(3)
    good = off <= 1e-6 and "4 cut-backs" in said
    return judged(
        good,
        f"{happened}; beyond the limit load: {said}",
        off=off,
        iterations=solution.iterations,
        cuts=solution.cuts,
    )


def _told_beyond_the_limit(max_cuts: int) -> str:
    try:
        solve_equilibrium(
            confined_column(), np.array([3 * LIMIT_PA]), options=NewtonOptions(max_cuts=max_cuts)
        )
    except SolverError as error:
        return str(error)
    return "answered"


def distortion(subject: Subject) -> Outcome:
    errors = {
        kind: patch_test_error(distorted_box((3, 3, 3), tetrahedra), selective=selective)
        for kind, (tetrahedra, selective) in KINDS.items()
    }
    told = ", ".join(f"{kind} {error:.1e}" for kind, error in errors.items())
    return judged(
        max(errors.values()) <= 1e-12,
        f"largest error of the patch test on 1 m, m: {told}",
        **errors,
    )


def stiffness_contrast(subject: Subject) -> Outcome:
    worst, conditions, told = 0.0, [], []
    for tetrahedra, selective in KINDS.values():
        bars = make_bars(tetrahedra, selective)
        worst = max(worst, float(np.abs(bars.end_displacement() / (Bars.stretch - 1) - 1).max()))
        values, factor = bars.rest
        told.append(condition_number(bars.assembler.pattern, values, factor))
        conditions.append(told[-1] / float(np.linalg.cond(dense(bars.assembler, values))))
    said = []
    for length in (20.0, 1000.0):
        with _caught(IllConditionedWarning) as found:
            _ = cantilever([length, 1.0, 1.0], [160, 1, 1], 0.0).rest_factor
        said.append(bool(found))
    warned = ["warned" if found else "not warned" for found in said]
    happened = f"stretch of the soft bar right to {worst:.1e}; condition number told as up to {max(told):.1e}, {min(conditions):.2f} to "
    happened += f"{max(conditions):.2f} of the true one, which leaves {int(15.9 - np.log10(max(told)))} digits and no warning; {warned[0]} of a beam 20 "
    happened += f"times as long as high, {warned[1]} of one 1,000 times"
    good = (
        worst <= 2e-6
        and min(conditions) >= 0.1
        and max(conditions) <= 1.01
        and said == [False, True]
    )
    return judged(good, happened, relative_error=worst, condition_ratios=conditions)


FREE = {
    "no support": (
        [],
        "translation x, translation y, translation z, rotation about x, rotation about y, rotation about z",
    ),
    "one node": (
        [{"region": {"sphere_m": [[0.0, 0.0, 0.0], 0.01]}}],
        "rotation about x, rotation about y, rotation about z",
    ),
    "one edge": ([{"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}}], "rotation about z"),
}
"""Supports that leave rigid motions free, and which."""


def unconstrained(subject: Subject) -> Outcome:
    wrong = []
    for held, (supports, modes) in FREE.items():
        scene = scene_of(subject.scenes.spec, supports=supports)
        try:
            FullOrderModel(scene)
            wrong.append(f"{held}: taken")
        except UnconstrainedBodyError as error:
            wrong += [
                f"{held}: {mode} not named" for mode in modes.split(", ") if mode not in str(error)
            ]
    return judged(
        not wrong,
        "; ".join(wrong) or f"{', '.join(FREE)}: refused, every free motion named",
        wrong=len(wrong),
    )


def _bad_meshes() -> dict[str, Callable[[], object]]:
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))

    def with_point(value: float) -> Mesh:
        points = mesh.points.copy()
        points[4, 1] = value
        return replace(mesh, points=points)

    flat = replace(mesh, points=mesh.points * [1.0, 1.0, 0.0])
    turned = replace(mesh, cells=mesh.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]])
    short = replace(mesh, cells=mesh.cells[:, :5])
    found: dict[str, Callable[[], object]] = {}
    for name, bad in {
        "NaN": with_point(np.nan),
        "infinity": with_point(np.inf),
        "flat cells": flat,
        "five-noded cells": short,
    }.items():
        found[f"{name}, in a model"] = lambda bad=bad: free_assembler(bad)  # type: ignore[misc]
        found[f"{name}, in a file"] = lambda bad=bad: tidied(bad.points, bad.cells)  # type: ignore[misc]
    found["cells inside out, in a model"] = lambda: free_assembler(turned)
    found["a node that is not there, in a file"] = lambda: tidied(mesh.points, mesh.cells + 1)
    return found


def bad_mesh(subject: Subject) -> Outcome:
    bad = _bad_meshes()
    with np.errstate(invalid="ignore"):
        wrong = [
            f"{name} {what}"
            for name, attempt in bad.items()
            if (what := refused(attempt, MorBenchError))
        ]
    return judged(
        not wrong,
        "; ".join(wrong)
        or f"{len(bad)} of {len(bad)} refused with a typed error: {'; '.join(bad)}",
        wrong=len(wrong),
    )


CASES = (
    Case(
        "inversion",
        "",
        "inverted or no-equilibrium beyond the limit load, never ok",
        as_shipped,
        inversion,
    ),
    Case(
        "snap-through",
        "",
        "limit point reported, lowest tangent eigenvalue given",
        as_shipped,
        snap_through,
    ),
    Case(
        "near-incompressible",
        "",
        "converges; locking reported, selective integration cures it",
        full_order,
        near_incompressible,
    ),
    Case("slender", "", "terminates; locking reported", full_order, slender),
    Case("huge-step", "", "converges or cuts back; cut-backs counted", full_order, huge_step),
    Case("distortion", "", "patch test within 1e-12", as_shipped, distortion),
    Case(
        "stiffness-contrast",
        "",
        "right answer; condition number told, and warned of where few digits are left",
        as_shipped,
        stiffness_contrast,
    ),
    Case(
        "unconstrained",
        "",
        "clear error that names the free rigid modes",
        as_shipped,
        unconstrained,
    ),
    Case("bad-mesh", "", "typed error", as_shipped, bad_mesh),
)
