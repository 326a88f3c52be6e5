"""Equilibria of a parametric scene: each load acts on a body with its own parameters.

The laws of Young's modulus and Poisson's ratio are linear in Young's modulus Y. So without springs
and pre-load, the displacement under a load f with Y is that under f Y₀ / Y with Y₀, exactly. Bodies
that differ in nothing else share one model. Every other body has a model of its own, with the
sparsity pattern of the reference. The reference's factor preconditions its iterations. This takes
less counted work than a factor for each body, except on small meshes at tight tolerances, and where
Poisson's ratio and the shape vary together on a body near incompressibility.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from copy import copy
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SolverError
from mor_bench.mechanics.accelerated import accelerated, run_in_step
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.mechanics.model import FullOrderModel, body_of
from mor_bench.mechanics.newton import NewtonOptions, Solution, checked_load
from mor_bench.mechanics.observed import ObservedModel, linear_response
from mor_bench.scene.scene import Scene
from mor_bench.scene.scene_at import reference_parameters, scale_of, scene_at
from mor_bench.specs import SolverName

Array = NDArray[np.float64]

Made = TypeVar("Made")

MAX_KEPT = 8
"""Number of bodies whose models are kept for further loads."""


class Bodies:
    """The bodies of a parametric scene, with loads that are equivalent on shared ones.

    Parameters
    ----------
    scene : Scene
        A scene with sampled parameters.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.reference = scene, reference_parameters(scene)
        spec, names = scene.generated, scene.parameter_names
        penalty = getattr(spec.loads, "penalty_n_m3", None)  # does not change with the modulus
        others = spec.springs or spec.is_preloaded or penalty is not None
        scales = "young_pa" in names and not others
        self._young = names.index("young_pa") if scales else None

    def shared(self, parameters: Array) -> tuple[Array, float]:
        """Return the parameters of a shared body, and the factor of the load on it."""
        if self._young is None:
            return parameters, 1.0
        found = parameters.copy()
        found[self._young] = self.reference[self._young]
        return found, float(self.reference[self._young] / parameters[self._young])

    @property
    def varied(self) -> list[int]:
        """The numbers of the parameters in which shared bodies differ."""
        return [i for i in range(len(self.reference)) if i != self._young]

    def is_reference(self, parameters: Array) -> bool:
        """Return whether these are the parameters of the body in the scene's file."""
        return bool((parameters == self.reference).all())

    def at(self, parameters: Array) -> Scene:
        """Return the scene with these parameters."""
        return scene_at(self.scene, parameters)


class LastUsed(Generic[Made]):
    """What was made for the bodies that were used last, by their parameters."""

    def __init__(self) -> None:
        self._kept: OrderedDict[bytes, Made] = OrderedDict()

    def of(self, parameters: Array, make: Callable[[], Made]) -> Made:
        """Return what belongs to parameters (n_parameters,); make it if it is not kept."""
        key = parameters.tobytes()
        if key not in self._kept:
            self._kept[key] = make()
            if len(self._kept) > MAX_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


class ParametricModel:
    """Full-order models of the bodies of a parametric scene.

    Parameters
    ----------
    scene : Scene
    solver : str, optional
        As for `FullOrderModel`.
    """

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        self.scene, self.bodies = scene, Bodies(scene)
        self.reference = FullOrderModel(scene, solver)
        self._kept: LastUsed[FullOrderModel] = LastUsed()

    def prepare(self) -> None:
        """Compute the factor that all solves share."""
        self.reference.prepare()

    def assembler_of(self, parameters: Array) -> Assembler:
        """Return the assembler of a body, (n_parameters,)."""
        if self.bodies.is_reference(parameters):
            return self.reference.assembler
        return self._assembler(body_of(self.bodies.at(parameters)), parameters)

    def _assembler(self, body: Discretisation, parameters: Array) -> Assembler:
        return self.reference.assembler.scaled(body, scale_of(self.scene, parameters))

    def model_of(self, parameters: Array) -> FullOrderModel:
        """Return the model of a body, (n_parameters,); the last ones are kept."""
        if self.bodies.is_reference(parameters):
            return self.reference
        return self._kept.of(parameters, lambda: self._made(parameters))

    def _made(self, parameters: Array) -> FullOrderModel:
        found = copy(self.reference)
        found.scene = self.bodies.at(parameters)
        body = body_of(found.scene)
        found.assembler = self._assembler(body, parameters)
        found.extent = found.assembler.extent_m
        found.rest = None if body.rest is None else body.rest.ravel()[found.scene.free_dofs]
        for name in ("rest_tangent", "rest_factor"):  # the rotated factor stays
            vars(found).pop(name, None)
        return found

    def solve_many(
        self,
        loads: Array,
        parameters: Array,
        options: NewtonOptions = NewtonOptions(),
    ) -> list[Solution | SolverError]:
        """Solve for loads (m, n_free), N, on bodies with parameters (m, n_parameters).

        Returns solutions, or the errors that `FullOrderModel.solve` would raise.
        """
        self.prepare()
        pairs = [self.bodies.shared(row) for row in parameters]
        equivalent = [
            checked_load(load * factor, number, self.reference)
            for number, (load, (_, factor)) in enumerate(zip(loads, pairs, strict=True))
        ]
        found: dict[int, Solution] = {}
        inverse = self.reference.accelerator
        moved = [i for i, load in enumerate(equivalent) if load.any()]
        if inverse is not None:
            passes = (
                accelerated(
                    self.model_of(pairs[i][0]), inverse, equivalent[i], None, options.tolerance
                )
                for i in moved
            )
            for number, attempt in run_in_step(inverse, passes):
                if attempt.valid:
                    state = attempt.q, attempt.min_det_f, attempt.iterations, 0
                    found[moved[number]] = Solution(*state)
        return [
            found[i] if i in found else self._solved(equivalent[i], pairs[i][0], options)
            for i in range(len(equivalent))
        ]

    def _solved(
        self, load: Array, parameters: Array, options: NewtonOptions
    ) -> Solution | SolverError:
        try:
            return self.model_of(parameters).solve(load, options=options)
        except SolverError as error:
            return error


class ParametricResponse:
    """The linear response of each body: exact, by a factor of its own stiffness at rest.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self._models = ParametricModel(scene, "cholesky")
        self._reference = linear_response(scene)
        self._free = scene.free_dofs

    def respond(self, loads: Array, parameters: Array) -> Array:
        """Return responses (n, n_dofs), m, to loads (n, n_dofs), N, on bodies (n, n_parameters)."""
        out, bodies = np.zeros(loads.shape), self._models.bodies
        shared = [bodies.shared(row) for row in parameters]
        scaled = loads * np.array([factor for _, factor in shared])[:, None]
        plain = np.array([bodies.is_reference(body) for body, _ in shared], dtype=bool)
        if plain.any():
            out[plain] = self._reference.respond(scaled[plain])
        for i in np.flatnonzero(~plain):
            factor = self._models.model_of(shared[i][0]).rest_factor
            out[i, self._free] = factor.solve(scaled[i, self._free])
        return out


class Generator(Protocol):
    """A model that solves for sampled loads on bodies with sampled parameters."""

    @property
    def scene(self) -> Scene: ...
    def solve_many(self, loads: Array, parameters: Array, /) -> list[Solution | SolverError]: ...


class OneBody:
    """The model of a scene without sampled parameters, as a `Generator`."""

    def __init__(self, model: FullOrderModel | ObservedModel) -> None:
        self.scene, self.model = model.scene, model

    def solve_many(self, loads: Array, parameters: Array, /) -> list[Solution | SolverError]:
        return self.model.solve_many(loads)
