"""The body of a parametric scene for one value of each sampled parameter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from mor_bench.errors import InvalidInputError
from mor_bench.scene.materials import make_material
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.scene import Scene
from mor_bench.specs import AXES, material_with

KEPT = ("free_dofs", "output_nodes", "observed_nodes", "patch_weights")
"""Computed properties of a scene that do not depend on its parameters."""


def reference_parameters(scene: Scene) -> NDArray[np.float64]:
    """Return the parameters (n_parameters,) of the body in the scene's file; a scale is 1."""
    material = scene.generated.material.model_dump()
    return np.array([material.get(name, 1.0) for name in scene.parameter_names])


def scene_at(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Return the scene with given parameters, and without sampled ones.

    The mesh is scaled about the origin. Its nodes, cells, supports and the weights of the load
    patches stay the same, so that the same nodal forces belong to the same load.

    Parameters
    ----------
    scene : Scene
    values : (n_parameters,) float64
        Values of ``scene.parameter_names``.

    Raises
    ------
    InvalidInputError
        If the law of the material is not defined for these values.
    """
    named = dict(zip(scene.parameter_names, values.tolist(), strict=True))
    own = {name: value for name, value in named.items() if not name.startswith("scale_")}
    try:
        material = material_with(scene.generated.material, own)
    except ValidationError as error:
        reason = error.errors(include_url=False)[0]["msg"]
        raise InvalidInputError(
            f"{scene.name}: the law has no values for the parameters {own}: {reason}."
        ) from None
    changed = {"parameters": None, "material": material}
    found = replace(
        scene,
        spec=scene.generated.model_copy(update=changed),
        mesh=(mesh := _scaled(scene.mesh, named)),
        material=make_material(material),
        embedded_surface=scene.embedded_surface if mesh is scene.mesh else None,
    )
    vars(found).update({name: vars(scene)[name] for name in KEPT if name in vars(scene)})
    return found


def scale_of(scene: Scene, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the scale (3,) of the mesh for parameters (n_parameters,); 1 where not sampled."""
    return _scale(dict(zip(scene.parameter_names, values.tolist(), strict=True)))


def _scale(named: Mapping[str, float]) -> NDArray[np.float64]:
    return np.array([named.get(f"scale_{axis}", 1.0) for axis in AXES])


def _scaled(mesh: Mesh, named: Mapping[str, float]) -> Mesh:
    factors = _scale(named)
    return mesh if (factors == 1.0).all() else replace(mesh, points=mesh.points * factors)
