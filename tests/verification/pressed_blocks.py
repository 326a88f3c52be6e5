"""Blocks that a rigid instrument presses, for several test modules."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.contact import ContactModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.specs import DatasetSpec

Array = NDArray[np.float64]

YOUNG_PA = 500.0
TIGHT = NewtonOptions(1e-12)
PLANES = [{"region": f"{axis}-min", "components": [axis]} for axis in "xyz"]
BALL: dict[str, Any] = {"sphere": {"radius_m": 0.4, "centre_m": [0.45, 0.55, 0.9]}}
FLAT: dict[str, Any] = {"plane": {"point_m": [0.0, 0.0, 0.5], "normal": [0.0, 0.0, -2.0]}}


def content(instrument: dict[str, Any] = BALL, **changed: Any) -> dict[str, Any]:
    """Return a block of 1 x 1 x 0.5 m, clamped below and pressed from above, as a dict."""
    loads = {
        "kind": "contact",
        "region": "z-max",
        "instrument": instrument,
        "direction": [0.0, 0.0, -1.0],
        "magnitude_m": [0.01, 0.15],
        "samples": 40,
    }
    loads.update(changed.pop("loads", {}))
    return {
        "name": "block",
        "title": "Block that an instrument presses",
        "geometry": {"shape": "box", "size_m": [1.0, 1.0, 0.5], "cells": [4, 4, 2]},
        "material": material_table("neo-hookean", YOUNG_PA, 0.3),
        "supports": [{"region": "z-min"}],
        "loads": loads,
        "split": {"by": "sample"},
        **changed,
    }


def block(instrument: dict[str, Any] = BALL, **changed: Any) -> Scene:
    """Return the scene of `content`."""
    return load_scene(content(instrument, **changed))


def given(scene: Scene, motion: list[float]) -> Array:
    """Return a displacement of the instrument as a query, (n_nodes, 3), m."""
    values = np.zeros((scene.mesh.n_nodes, 3))
    values[scene.observed_nodes] = motion
    return values


def pressed(
    scene: Scene, motion: list[float], options: NewtonOptions = TIGHT
) -> tuple[ContactModel, Array]:
    """Return the model with the instrument moved by (3,), m, and the equilibrium (n_free,), m."""
    model = ContactModel(scene)
    found = model.solve(given(scene, motion).ravel()[scene.free_dofs], options=options)
    return model.under(np.array(motion)), found.displacement


def graded(cells_per_radius: int, size: float) -> Scene:
    """Return a quarter of a block under a ball, with fine cells in the first 1.5 m of each axis.

    The ball's radius is 20 m, so that an indentation of 0.05 m has a contact radius of 1 m.
    """
    x, h = [0.0], 1.0 / cells_per_radius
    while x[-1] < 1.5 - 1e-9:
        x.append(x[-1] + h)
    while x[-1] < size:
        h *= 1.6
        x.append(x[-1] + h)
    at = np.array(x) * size / x[-1]
    n = len(at) - 1
    whole = block(
        {"sphere": {"radius_m": 20.0, "centre_m": [0.0, 0.0, size + 20.0]}},
        geometry={"shape": "box", "size_m": [size] * 3, "cells": [n] * 3},
        material=material_table("saint-venant-kirchhoff", YOUNG_PA, 0.3),
        supports=PLANES,
    )
    even, points = np.linspace(0.0, size, n + 1), whole.mesh.points.copy()
    points[:, :2] = np.interp(points[:, :2], even, at)
    points[:, 2] = size - np.interp(size - points[:, 2], even, at)
    near = {"box_m": [[0.0, 0.0, size - 0.01], [2.5, 2.5, size + 0.01]]}
    spec = {**whole.generated.model_dump(), "loads": {**whole.generated.model_dump()["loads"]}}
    spec["loads"]["region"] = near
    described = DatasetSpec.model_validate(spec)
    return replace(whole, spec=described, mesh=replace(whole.mesh, points=points))
