"""The rest state of a body under its pre-load: gravity and constant pressures."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import LockingWarning, SolverError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import constant_forces
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.scene.constant_pressures import followers_of
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]

REST_TOLERANCE = 1e-12
"""Residual of the rest state, relative to the pre-load."""


class Solver(Protocol):
    """A model of a scene that solves for loads beside the pre-load."""

    assembler: Assembler

    def solve(
        self, load: Array, start: Array | None = None, options: NewtonOptions = NewtonOptions()
    ) -> Solution: ...


def solved_at_rest(scene: Scene, model_of: Callable[[Scene, SolverName | None], Solver]) -> Array:
    """Return the displacements (n_dofs,), m, of the rest state.

    Pressures that follow the surface act in increments: the tangent at the begin of an increment is
    that under the pressure at its end, which may be too large.

    Parameters
    ----------
    scene : Scene
        A scene with a pre-load.
    model_of : callable
        Returns the model of a scene with a solver's name.

    Raises
    ------
    SolverError
        If there is no stable equilibrium.
    """
    followers, steps = followers_of(scene.constant_pressures), LoadSteps(1.0)
    load = scene.at_free_dofs(constant_forces(scene).reshape(1, -1))[0]
    kept = scene.generated.constant_pressures if followers else ()
    alone = {"gravity": None, "constant_pressures": kept, "loads": None}
    spec, u = scene.generated.model_copy(update=alone), np.zeros(scene.mesh.n_dofs)
    options = NewtonOptions(REST_TOLERANCE)
    while not steps.complete:
        part = [replace(each, pressure_pa=steps.target * each.pressure_pa) for each in followers]
        light = replace(scene, spec=spec, constant_pressures=tuple(part))
        if followers:
            light.memo["rest"] = u
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LockingWarning)  # the model under the pre-load warns
            model = model_of(light, "auto")
        try:
            lacking = steps.target * load - model.assembler.force_at_rest
            found = model.solve(lacking, options=options)
        except SolverError:
            steps.cut()
            if not followers or steps.cuts > options.max_cuts:
                raise
            continue
        u = u + scene.at_all_dofs(found.displacement[None])[0]
        steps.accept()
    return u
