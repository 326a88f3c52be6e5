"""Forces of the supports and of a tool on the body, from displacements."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import constant_forces, discretisation_of
from mor_bench.mechanics.model import rest_displacement
from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.mechanics.pressed import PressedModel
from mor_bench.mechanics.pressed_facets import PressedFacets
from mor_bench.scene.scene import Scene
from mor_bench.scene.scene_at import scene_at
from mor_bench.specs import NO_EQUATIONS

Array = NDArray[np.float64]


class Reactions:
    """Computes the forces of the supports, f_int(u) - f, along the directions that they hold.

    The internal force contains that of springs. Weight and constant pressures count to the forces,
    and pressures that follow the surface act on the deformed one. So at an equilibrium, the
    reactions, these forces and those of the springs on the body have no resultant and no moment.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    UnsupportedSceneError
        If the scene's equations are unknown, or its material or shape varies between samples.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.material is None:
            raise UnsupportedSceneError(f"{scene.name}: {NO_EQUATIONS}.")
        if scene.parameter_names:
            raise UnsupportedSceneError(
                f"{scene.name}: each sample has its own body; use `reaction_forces` with "
                "`parameters`."
            )
        body, n_dofs = discretisation_of(scene), scene.mesh.n_dofs
        numbers = np.arange(n_dofs).reshape(-1, 3)
        self._scene, self._assembler = scene, Assembler(body, numbers, n_dofs)
        self._rest, self._constant = np.zeros(n_dofs), constant_forces(scene).ravel()
        if (rest := rest_displacement(scene)) is not None:
            self._rest = rest.ravel()
        self._pressed: tuple[PressedModel, PressedFacets] | None = None
        if scene.follows:
            points = scene.mesh.points + self._rest.reshape(-1, 3)
            pattern = self._assembler.pattern
            facets = PressedFacets(points, scene.pressed_facets, numbers, pattern)
            self._pressed = PressedModel(scene), facets

    def __call__(self, displacements: Array, forces: Array) -> Array:
        """Return the reactions (n, n_nodes, 3), N; zero where nothing is held.

        Parameters
        ----------
        displacements, forces : (n, n_nodes, 3) float64
            Displacements, m, and forces, N, as of `Snapshots`: without the rest state and pre-load.

        Raises
        ------
        InvalidInputError
            If a shape is wrong.
        """
        shape = (len(displacements), self._scene.mesh.n_nodes, 3)
        if displacements.shape != shape or forces.shape != shape:
            raise InvalidInputError(
                f"displacements and forces must have shape (n, {shape[1]}, 3); "
                f"got {displacements.shape} and {forces.shape}."
            )
        scene, rows = self._scene, zip(displacements, forces, strict=True)
        whole = np.array([self._residual(u.ravel(), f.ravel()) for u, f in rows])
        whole = whole.reshape(len(displacements), scene.mesh.n_dofs)
        return np.asarray((whole - scene.at_all_dofs(scene.at_free_dofs(whole))).reshape(shape))

    def _residual(self, u: Array, force: Array) -> Array:
        if self._pressed is not None:
            model, facets = self._pressed
            pressures = model.pressures_of(self._scene.at_free_dofs(force[None])[0])
            force = facets.force(u, pressures)
        internal = self._assembler.force(self._rest + u).force
        return np.asarray(internal - self._constant - force)


def reaction_forces(
    scene: Scene,
    displacements: ArrayLike,
    forces: ArrayLike,
    parameters: ArrayLike | None = None,
) -> Array:
    """Return the forces of the supports on the body, N, as an array of the displacements' shape.

    Parameters
    ----------
    scene : Scene
    displacements, forces : (n_nodes, 3) or (n, n_nodes, 3)
        As for `Reactions`, which is faster for many calls.
    parameters : (n_parameters,) or (n, n_parameters), optional
        Sampled parameters of the bodies; required in a scene that has some.

    Raises
    ------
    InvalidInputError
        If a shape is wrong, or parameters are missing or not expected.

    Examples
    --------
    The reactions balance the load, here one of 0.5 N:

    >>> import mor_bench, numpy as np
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> forces = np.zeros((63, 3))
    >>> forces[scene.patch_nodes[-1]] = [0.0, 0.0, -0.5]
    >>> u = mor_bench.load_method("fem").fit(scene).predict(forces)
    >>> bool(np.isclose(reaction_forces(scene, u, forces)[:, 2].sum(), 0.5))
    True
    """
    u, f = np.asarray(displacements, dtype=np.float64), np.asarray(forces, dtype=np.float64)
    if u.ndim not in (2, 3) or u.shape != f.shape:
        raise InvalidInputError(
            "displacements and forces must have the same shape (n_nodes, 3) or (n, n_nodes, 3); "
            f"got {u.shape} and {f.shape}."
        )
    many = u.reshape(-1, *u.shape[-2:]), f.reshape(-1, *f.shape[-2:])
    values = checked_parameters(scene, parameters, u.shape[:-2])
    if values is None:
        return Reactions(scene)(*many).reshape(u.shape)
    found = np.empty_like(many[0])
    bodies, of = np.unique(values, axis=0, return_inverse=True)
    for number, body in enumerate(bodies):
        rows = np.flatnonzero(of == number)
        found[rows] = Reactions(scene_at(scene, body))(many[0][rows], many[1][rows])
    return found.reshape(u.shape)


def tool_forces(
    scene: Scene, displacements: ArrayLike, parameters: ArrayLike | None = None
) -> Array:
    """Return the forces of a moved tool, or of an instrument, on the body, N.

    They are zero at the nodes that it does not hold or press. Minus their sum is what a haptic
    device feels.

    Parameters
    ----------
    scene : Scene
        A scene with loads of kind "displacement" or "contact".
    displacements : (n_nodes, 3) or (n, n_nodes, 3)
        At equilibrium, m, as a method predicts them.
    parameters : (n_parameters,) or (n, n_parameters), optional
        Sampled parameters of the bodies; required in a scene that has some.

    Returns
    -------
    array of the displacements' shape

    Raises
    ------
    InvalidInputError
        If a shape is wrong, or parameters are missing or not expected.
    UnsupportedSceneError
        If nothing moves or presses the body.

    Examples
    --------
    A tool on the liver holds a part of it in the place of the rest:

    >>> import mor_bench, numpy as np
    >>> from mor_bench.snapshots.given import ObservedDisplacements
    >>> scene = mor_bench.load_scene("liver-grasped")
    >>> moved = np.zeros((scene.mesh.n_nodes, 3))
    >>> moved[scene.observed_nodes] = [0.0, 0.0, 1e-3]
    >>> given = ObservedDisplacements(moved, scene.observed_nodes)
    >>> u = mor_bench.load_method("fem").fit(scene).predict(given)
    >>> bool(tool_forces(scene, u)[:, 2].sum() > 0)
    True
    """
    u = np.asarray(displacements, dtype=np.float64)
    shape = (scene.mesh.n_nodes, 3)
    if u.ndim not in (2, 3) or u.shape[-2:] != shape:
        raise InvalidInputError(
            f"displacements must have shape {shape} or (n, {shape[0]}, 3); got {u.shape}."
        )
    values = checked_parameters(scene, parameters, u.shape[:-2])
    free = scene.at_free_dofs(u.reshape(-1, scene.mesh.n_dofs))
    return ToolForces(scene)(free, values).reshape(u.shape)


def checked_parameters(
    scene: Scene, parameters: ArrayLike | None, batch: tuple[int, ...]
) -> Array | None:
    """Return the parameters (n, n_parameters) of the bodies of a batch; None without any."""
    names = scene.parameter_names
    if parameters is None and not names:
        return None
    expected = (*batch, len(names))
    if parameters is None or not names or np.shape(parameters) != expected:
        got = "none" if parameters is None else f"shape {np.shape(parameters)}"
        wanted = f"of shape {expected}, one column for each of {', '.join(names)}"
        raise InvalidInputError(
            f"{scene.name}: `parameters` must be {wanted if names else 'left out'}; got {got}."
        )
    return np.asarray(parameters, dtype=np.float64).reshape(-1, len(names))
