"""Bodies with sampled parameters that a tool moves, or an instrument presses.

A displacement acts on all bodies alike. So the equilibria do not depend on Young's modulus, where
it scales all forces, as the default stiffness of a contact does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import NoEquilibriumError, SolverError, SpecError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.observed import (
    LinearResponse,
    ObservedModel,
    forward_model,
    generating_model,
    linear_response,
)
from mor_bench.mechanics.parametric import (
    Bodies,
    Generator,
    LastUsed,
    Made,
    OneBody,
    ParametricModel,
    ParametricResponse,
)
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]


class _PerBody(Generic[Made]):
    """What a function makes of the scene of each body; the last ones are kept."""

    def __init__(self, scene: Scene, make: Callable[[Scene], Made]) -> None:
        _ = scene.observed_nodes  # those of all bodies
        self.bodies, self._make = Bodies(scene), make
        self._kept: LastUsed[Made] = LastUsed()

    def of(self, parameters: Array) -> Made:
        """Return it for a body, (n_parameters,), or for one with the same displacements."""
        shared = self.bodies.shared(parameters)[0]
        return self._kept.of(shared, lambda: self._make(self.bodies.at(shared)))


class MovedBodies:
    """Full-order models of bodies whose input is the displacement of a tool or an instrument.

    Parameters
    ----------
    scene : Scene
        A scene with sampled parameters, and a moved tool or an instrument.
    solver : str, optional
        As for `FullOrderModel`.
    """

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        self.scene = scene
        self._models: _PerBody[FullOrderModel | ObservedModel] = _PerBody(
            scene, lambda body: forward_model(body, solver)
        )

    def prepare(self) -> None:
        """Prepare the model of the body in the scene's file."""
        self._models.of(self._models.bodies.reference)

    def solve_many(
        self, given: Array, parameters: Array, options: NewtonOptions = NewtonOptions()
    ) -> list[Solution | SolverError]:
        """Solve for displacements (m, n_free), m, on bodies with parameters (m, n_parameters).

        Returns solutions or errors. It is an error too if an instrument penetrates a body at rest.
        """
        found: list[Solution | SolverError] = []
        for row, own in zip(given, parameters, strict=True):
            try:
                found += self._models.of(own).solve_many(row[None], options)
            except SolverError as error:
                found.append(error)
            except SpecError as error:
                found.append(NoEquilibriumError(str(error)))
        return found


class MovedResponse:
    """The linear response of each body to the displacement of a tool or an instrument.

    Parameters
    ----------
    scene : Scene
        As for `MovedBodies`.
    """

    def __init__(self, scene: Scene) -> None:
        self._responses: _PerBody[LinearResponse] = _PerBody(scene, linear_response)

    def respond(self, given: Array, parameters: Array) -> Array:
        """Return responses (n, n_dofs), m, to displacements of this shape on the bodies."""
        out = np.zeros(given.shape)
        for answer, row, own in zip(out, given, parameters, strict=True):
            answer[:] = self._responses.of(own).respond(row[None])[0]
        return out


class ToolForces:
    """Forces of a moved tool, or an instrument, on its nodes: the internal forces there.

    Their sum is minus the reaction that the tool feels. Foundations resist, and the pre-load acts,
    as part of the internal forces. At an equilibrium they are the forces of the contact.

    Parameters
    ----------
    scene : Scene
        A scene with a moved tool, or an instrument that presses.
    """

    def __init__(self, scene: Scene) -> None:
        moved = scene.motion or scene.contact
        if moved is None or scene.observed_nodes is None:
            raise UnsupportedSceneError(f"{scene.name}: no tool moves the body.")
        self._scene, self._nodes = scene, scene.observed_nodes
        self._bodies = ParametricModel(scene) if scene.parameter_names else None
        self._model = self._bodies.reference if self._bodies else FullOrderModel(scene)

    def __call__(self, displacements: Array, parameters: Array | None = None) -> Array:
        """Return the forces (n, n_nodes, 3), N, at displacements (n, n_free) of the free dofs, m.

        They are zero at all other nodes, and NaN where the displacements are not finite. Sampled
        parameters (n, n_parameters) of the bodies are required in a scene that has some.
        """
        scene = self._scene
        forces = np.zeros((len(displacements), scene.mesh.n_nodes, 3))
        for number, (row, u) in enumerate(zip(forces, displacements, strict=True)):
            model = self._model
            if self._bodies is not None and parameters is not None:
                model = self._bodies.model_of(parameters[number])
            finite = bool(np.isfinite(u).all())
            force = model.force(u).force if finite else np.full(len(u), np.nan)
            row[self._nodes] = scene.at_all_dofs(force[None]).reshape(-1, 3)[self._nodes]
        return forces


def parametric_model(
    scene: Scene, solver: SolverName | None = None
) -> ParametricModel | MovedBodies:
    """Return the models of bodies with sampled parameters, for forces or for displacements."""
    moved = scene.observed_nodes is not None
    return MovedBodies(scene, solver) if moved else ParametricModel(scene, solver)


def parametric_response(scene: Scene) -> ParametricResponse | MovedResponse:
    """Return the linear response of bodies with sampled parameters."""
    moved = scene.observed_nodes is not None
    return MovedResponse(scene) if moved else ParametricResponse(scene)


def generator_of(scene: Scene) -> Generator:
    """Return the model whose input are a scene's sampled loads and parameters."""
    return parametric_model(scene) if scene.parameter_names else OneBody(generating_model(scene))
