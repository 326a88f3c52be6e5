"""Hard cases of the full-order model: loads, materials, shapes and meshes that are ill-suited."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import (
    IllConditionedWarning,
    InvertedElementError,
    LimitPointError,
    LockingWarning,
    SolverError,
    UnconstrainedBodyError,
)
from mor_bench.hard_cases.case import Outcome, Subject, hard_case, judged, scene_of, wrongly_handled
from mor_bench.hard_cases.setups import (
    LAW,
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
from mor_bench.measure.mesh_limit import limit_of
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

KINDS = {
    "H8": (False, False, 1),
    "H8 selective": (False, True, 1),
    "T4": (True, False, 1),
    "T10": (True, False, 2),
}
"""Elements by name, with flags for tetrahedra and for selective integration, and the order."""

SLENDER_EXACT = 0.19235
"""Tip deflection over length of the elastica at PL²/EI = 0.6 (Bisshopp and Drucker 1945)."""


def full_order(method: Surrogate) -> bool:
    """Return whether a method is the full-order model, with any solver."""
    return isinstance(method, FullFEM)


def as_shipped(method: Surrogate) -> bool:
    """Return whether a method is the full-order model with its default solver.

    Cases that do not depend on the solver are tried once.
    """
    return isinstance(method, FullFEM) and method.solver is None


def _solver(subject: Subject) -> SolverName | None:
    solver: SolverName | None = subject.fresh().parameters["solver"]
    return solver


@contextmanager
def _caught(kind: type[Warning]) -> Iterator[list[str]]:
    """Collect the messages of the warnings of a kind."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield found
    found += [str(warning.message) for warning in caught if issubclass(warning.category, kind)]


@hard_case(
    "inversion",
    as_shipped,
    "refused as inverted or without equilibrium beyond the limit load, never answered",
)
def inversion(subject: Subject) -> Outcome:
    """Compress a confined cell beyond its limit load, in one step and in ten."""
    inverted, not_found, wrong = 0, 0, []
    for kind, (tetrahedra, selective, order) in KINDS.items():
        for factor, steps in product((1.01, 1.5, 3.0), (1, 10)):
            column, q = confined_column(LAW, tetrahedra, selective, order), None
            for level in factor * np.arange(1, steps + 1) / steps:
                try:
                    q = solve_equilibrium(column, np.array([level * LIMIT_PA]), q).displacement
                except SolverError as error:
                    inverted += isinstance(error, InvertedElementError)
                    not_found += not isinstance(error, InvertedElementError)
                    if level <= 1:
                        wrong.append(f"{kind}: refused at {level:.3g} of the limit")
                else:
                    if level > 1:
                        stretch = f"with stretch {1 + q[0]:.3g}"
                        wrong.append(f"{kind}: answered at {level:.3g} of the limit {stretch}")
    summary = (
        f"beyond the limit, {inverted} loads were refused as inverted and {not_found} as without "
        "equilibrium"
    )
    return judged(
        not wrong,
        "; ".join([summary, *wrong[:3]]),
        **{"inverted": inverted, "no equilibrium": not_found, "wrong": len(wrong)},
    )


@hard_case("snap-through", as_shipped, "limit point reported with its lowest tangent eigenvalue")
def snap_through(subject: Subject) -> Outcome:
    """Compare the limit load of an arch with the top of its displacement-driven path."""
    arch = make_arch()
    limit, exact = limit_load(arch.problem, arch.load), arch.greatest_reaction()
    if limit is None:
        return judged(
            False, f"no limit found; the displacement-driven path has one at {exact:.6g} N"
        )
    beyond, named = "1.5 times the limit was answered", False
    try:
        solve_on_path(arch.problem, 1.5 * limit.factor * arch.load)
    except SolverError as error:
        beyond = str(error)
        named = (
            isinstance(error, LimitPointError)
            and error.load_factor is not None
            and error.lowest_eigenvalue is not None
            and abs(1.5 * error.load_factor - 1) <= 1e-6
        )
    off = abs(limit.factor / exact - 1)
    happened = (
        f"limit {limit.factor:.6g} N, {off:.0e} from the top of the displacement-driven path; "
        f"lowest eigenvalue {limit.lowest_eigenvalue:.1e}"
    )
    return judged(
        off <= 1e-6 and 0 < limit.lowest_eigenvalue < 1e-3 and named,
        happened if named else f"{happened}; beyond it: {beyond}",
        limit_n=limit.factor,
        exact_n=exact,
        lowest_eigenvalue=limit.lowest_eigenvalue,
    )


@hard_case(
    "near-incompressible",
    full_order,
    "converges; locking reported and cured by selective integration, and by T10",
)
def near_incompressible(subject: Subject) -> Outcome:
    """Bend a cantilever of nearly incompressible material with full and selective H8, and T10."""
    solver, size, cells = _solver(subject), [4.0, 1.0, 1.0], [12, 3, 3]
    reference = tip(cantilever(size, cells, 0.3, solver=solver), -50.0)[2]
    shown, good, measured = [], True, {}
    for poisson in (0.48, 0.49, 0.499, 0.4999):
        ratios = []
        for integration in ("full", "selective", "T10"):
            with _caught(LockingWarning) as locking:
                mesh = [8, 2, 2] if integration == "T10" else cells
                model = cantilever(size, mesh, poisson, integration, solver=solver)
            load = tip_load(model, -50.0)
            solution = model.solve(load)
            rest = np.linalg.norm(load - model.force(solution.displacement).force)
            good &= float(rest / np.linalg.norm(load)) <= 1e-8 and solution.min_det_f > 0
            good &= bool(locking) == (integration == "full")
            ratios.append(float(tip(model, -50.0)[2] / reference))
        good &= max(abs(ratio - 1) for ratio in ratios[1:]) <= 0.08
        shown.append(f"{poisson}: {', '.join(f'{ratio:.2f}' for ratio in ratios)}")
        for name, ratio in zip(("full", "selective", "t10"), ratios, strict=True):
            measured[f"{name}_{poisson}"] = ratio
    return judged(
        good,
        "tip deflection over that at ν = 0.3, with full and selective H8 and with T10, by ν: "
        + "; ".join(shown),
        **measured,
    )


@hard_case("slender", full_order, "terminates; locking reported")
def slender(subject: Subject) -> Outcome:
    """Bend a 100:1 beam; compare its locking with the discretisation error from refinement.

    The reported discretisation error must not be much smaller than the actual error. T10, whose
    edges do not lock in bending, must come close on a coarser mesh.
    """
    length, solver = 100.0, _solver(subject)
    deflections, ends = [], []
    for level in range(3):
        model = cantilever([length, 1.0, 1.0], [50 * 2**level, 1, 2], 0.0, solver=solver)
        end = tip(model, -0.6 * 1000.0 / length**2)
        deflections.append(float(-end[2] / length))
        ends.append(end[None])
    force = -0.6 * 1000.0 / length**2
    quadratic = cantilever([length, 1.0, 1.0], [50, 1, 1], 0.0, "T10", solver=solver)
    t10 = float(-tip(quadratic, force)[2] / length)
    limit = limit_of(ends)[0]
    reported = float(np.linalg.norm(ends[0] - limit) / np.linalg.norm(limit))
    actual = 1 - deflections[0] / SLENDER_EXACT
    happened = (
        f"w/L {', '.join(f'{w:.4f}' for w in deflections)} with 50, 100 and 200 cells along the "
        f"beam; exact {SLENDER_EXACT}; locking of the first {actual:.0%}, reported by refinement "
        f"{reported:.0%}; T10 {t10:.4f} with 50 cells"
    )
    good = (
        deflections[0] < deflections[1] < deflections[2] < 1.02 * SLENDER_EXACT
        and reported >= 0.5 * actual
        and abs(t10 / SLENDER_EXACT - 1) <= 0.05
    )
    return judged(
        good, happened, deflections=deflections, exact=SLENDER_EXACT, reported=reported, t10=t10
    )


@hard_case("huge-step", full_order, "converges or cuts back; cut-backs counted")
def huge_step(subject: Subject) -> Outcome:
    """Apply a large load at once, and a load beyond the limit with at most three cut-backs."""
    scene = scene_of(subject.scenes.spec, material=material_table("neo-hookean", 500.0, 0.4))
    model = FullOrderModel(scene, _solver(subject))
    force = scene.patch_weights[[-1]].toarray()[0][:, None] * np.array([-20.0, 0.0, -20.0])
    load = force.ravel()[scene.free_dofs]
    solution, q = model.solve(load), None
    for level in np.linspace(0.05, 1.0, 20):
        q = model.solve(level * load, start=q).displacement
    assert q is not None
    off = float(np.abs(solution.displacement - q).max() / np.abs(q).max())
    cuts_beyond, beyond = _cuts_beyond_the_limit(max_cuts=3)
    return judged(
        off <= 1e-6 and cuts_beyond == 4,
        f"{solution.iterations} iterations and {solution.cuts} cut-backs; within {off:.0e} of 20 "
        f"small steps; beyond the limit load: {beyond}",
        off=off,
        iterations=solution.iterations,
        cuts=solution.cuts,
    )


def _cuts_beyond_the_limit(max_cuts: int) -> tuple[int | None, str]:
    """Return the cut-backs that a refused solve reports, and its message."""
    load, options = np.array([3 * LIMIT_PA]), NewtonOptions(max_cuts=max_cuts)
    try:
        solve_equilibrium(confined_column(), load, options=options)
    except SolverError as error:
        return error.cuts, str(error)
    return None, "answered"


@hard_case("distortion", as_shipped, "patch test within 1e-12")
def distortion(subject: Subject) -> Outcome:
    """Run the patch test on distorted meshes of every element."""
    errors = {
        kind: patch_test_error(
            distorted_box((2 if order == 2 else 3,) * 3, tetrahedra, order=order),
            selective=selective,
        )
        for kind, (tetrahedra, selective, order) in KINDS.items()
    }
    shown = ", ".join(f"{kind} {error:.1e}" for kind, error in errors.items())
    return judged(
        max(errors.values()) <= 1e-12,
        f"largest error of the patch test on a body of 1 m, in m: {shown}",
        **errors,
    )


@hard_case(
    "stiffness-contrast",
    as_shipped,
    "correct answer; condition number reported, with a warning if few digits are left",
)
def stiffness_contrast(subject: Subject) -> Outcome:
    """Stretch bars with a stiffness ratio of a million, and build a very slender beam."""
    off, conditions, reported = 0.0, [], []
    for tetrahedra, selective, order in KINDS.values():
        bars = make_bars(tetrahedra, selective, order=order)
        off = max(off, float(np.abs(bars.end_displacement() / (Bars.stretch - 1) - 1).max()))
        values, factor = bars.rest
        reported.append(condition_number(bars.assembler.pattern, values, factor))
        conditions.append(reported[-1] / float(np.linalg.cond(dense(bars.assembler, values))))
    warned = []
    for length in (20.0, 1000.0):
        with _caught(IllConditionedWarning) as found:
            _ = cantilever([length, 1.0, 1.0], [160, 1, 1], 0.0).rest_factor
        warned.append(bool(found))
    words = ["warned" if found else "not warned" for found in warned]
    digits = int(15.9 - np.log10(max(reported)))
    happened = (
        f"stretch of the soft bar within {off:.1e}; condition number up to {max(reported):.1e}, "
        f"{min(conditions):.2f} to {max(conditions):.2f} of the true one, which leaves {digits} "
        f"digits and needs no warning; {words[0]} of a beam of 20:1, {words[1]} of one of 1,000:1"
    )
    good = off <= 2e-6 and min(conditions) >= 0.1 and max(conditions) <= 1.01
    return judged(
        good and warned == [False, True],
        happened,
        relative_error=off,
        condition_ratios=conditions,
    )


ROTATIONS = ("rotation about x", "rotation about y", "rotation about z")
FREE: dict[str, tuple[list[Any], tuple[str, ...]]] = {
    "no support": ([], ("translation x", "translation y", "translation z", *ROTATIONS)),
    "one node": ([{"region": {"sphere_m": [[0.0, 0.0, 0.0], 0.01]}}], ROTATIONS),
    "one edge": ([{"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}}], ROTATIONS[2:]),
}
"""Supports that leave rigid motions free, and these motions."""


@hard_case("unconstrained", as_shipped, "clear error that names the free rigid motions")
def unconstrained(subject: Subject) -> Outcome:
    """Build models of bodies that can move freely."""
    wrong = []
    for held, (supports, motions) in FREE.items():
        scene = scene_of(subject.scenes.spec, supports=supports)
        try:
            FullOrderModel(scene)
            wrong.append(f"{held}: accepted")
        except UnconstrainedBodyError as error:
            missing = [motion for motion in motions if motion not in error.free_motions]
            wrong += [f"{held}: {motion} not named" for motion in missing]
    return judged(
        not wrong,
        "; ".join(wrong) or f"{', '.join(FREE)}: refused, every free motion named",
        wrong=len(wrong),
    )


def _bad_meshes() -> dict[str, Callable[[], object]]:
    """Return attempts to use bad meshes, in a model and as read from a file."""
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))

    def with_point(value: float) -> Mesh:
        points = mesh.points.copy()
        points[4, 1] = value
        return replace(mesh, points=points)

    turned = replace(mesh, cells=mesh.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]])
    attempts: dict[str, Callable[[], object]] = {}
    for name, bad in {
        "NaN": with_point(np.nan),
        "infinity": with_point(np.inf),
        "flat cells": replace(mesh, points=mesh.points * [1.0, 1.0, 0.0]),
        "cells of five nodes": replace(mesh, cells=mesh.cells[:, :5]),
    }.items():
        attempts[f"{name}, in a model"] = partial(free_assembler, bad)
        attempts[f"{name}, in a file"] = partial(tidied, bad.points, bad.cells)
    attempts["cells inside out, in a model"] = partial(free_assembler, turned)
    attempts["a missing node, in a file"] = partial(tidied, mesh.points, mesh.cells + 1)
    return attempts


@hard_case("bad-mesh", as_shipped, "typed error")
def bad_mesh(subject: Subject) -> Outcome:
    """Use meshes with NaN, infinity, flat or inverted cells, and wrong connectivity."""
    meshes = _bad_meshes()
    with np.errstate(invalid="ignore"):
        wrong = wrongly_handled(meshes)
    happened = f"{len(meshes)} of {len(meshes)} refused with a typed error: {'; '.join(meshes)}"
    return judged(not wrong, "; ".join(wrong) or happened, wrong=len(wrong))


CASES = (
    inversion,
    snap_through,
    near_incompressible,
    slender,
    huge_step,
    distortion,
    stiffness_contrast,
    unconstrained,
    bad_mesh,
)
