"""Supports of single components: closed forms, felupe, balance of the reactions, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

import mor_bench
from mor_bench.errors import SpecError, UnconstrainedBodyError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics import model as model_module
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.symmetry import mirrors
from mor_bench.specs import load_generated_spec

from .laws_and_elements import EVERY, discretisation, piola, quick_first
from .scenes import reactions
from .test_independent_library import compare

Array = NDArray[np.float64]
PLANES = [{"region": f"{axis}-min", "components": [axis]} for axis in "xyz"]
ISOTROPIC = [case for case in EVERY if case[0] != "holzapfel-gasser-ogden"]
STRETCH = 1.2
ROLLERS: list[dict[str, Any]] = [
    {"region": "x-min", "components": ["z", "x"]},
    {"region": {"box_m": [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]]}, "components": ["y"]},
]


def block(law: str = "saint-venant-kirchhoff", **changed: Any) -> Scene:
    """Return a block of 2 x 1 x 1 m on three planes of symmetry."""
    return load_scene(
        {
            "name": "block",
            "title": "Block on planes of symmetry",
            "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [3, 2, 2]},
            "material": material_table(law, 500.0, 0.4),
            "supports": PLANES,
            **changed,
        }
    )


def stretched(scene: Scene) -> tuple[Array, Array]:
    """Return the forces, N, that stretch a block uniformly along x, and its displacements, m."""
    assert scene.material is not None

    def stress(width: float) -> Array:
        return piola(scene.material, np.diag([STRETCH, width, width]))  # type: ignore[arg-type]

    width = float(brentq(lambda width: stress(width)[1, 1], 0.7, 1.1, xtol=1e-15))
    end = scene.surface.within(np.flatnonzero(scene.mesh.points[:, 0] == 2.0))
    end = end[:, -3:] if end.shape[1] == 6 else end  # only the middles of six nodes carry
    forces = np.zeros((scene.mesh.n_nodes, 3))
    np.add.at(forces[:, 0], end, stress(width)[0, 0] / end.size)
    return forces, scene.mesh.points * (np.array([STRETCH, width, width]) - 1.0)


def error_of(scene: Scene, solver: Any = None) -> float:
    """Return the largest error of the solution for a uniformly stretched block, m."""
    (forces, exact), found = stretched(scene), np.zeros(scene.mesh.n_dofs)
    found[scene.free_dofs] = (
        FullOrderModel(scene, solver)
        .solve(forces.ravel()[scene.free_dofs], options=NewtonOptions(1e-11))
        .displacement
    )
    return float(np.abs(found.reshape(-1, 3) - exact).max())


@pytest.mark.parametrize(("law", "kind"), quick_first(ISOTROPIC))
def test_a_block_on_three_planes_of_symmetry_stretches_uniformly(
    law: str, kind: tuple[str, bool]
) -> None:
    scene = block(law, discretisation=discretisation(kind))
    assert len(scene.fixed_nodes) == 1
    assert error_of(scene) <= 1e-10


@pytest.mark.parametrize("solver", ["rotated-pcg", "jacobi-pcg", "cholesky", "superlu"])
def test_every_solver_solves_for_single_components(solver: str) -> None:
    assert error_of(block(), solver) <= 1e-10


@pytest.mark.parametrize("solver", ["auto", "rotated-pcg"])
def test_multigrid_solves_for_single_components(
    monkeypatch: pytest.MonkeyPatch, solver: str
) -> None:
    monkeypatch.setattr(model_module, "MAX_BAND_ENTRIES", 0)
    size = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [12, 6, 6]}
    assert isinstance(FullOrderModel(block(geometry=size)).rest_factor, MultigridFactor)
    assert error_of(block(geometry=size), solver) <= 1e-10


def rolling() -> Scene:
    """Return beam-tiny with an end and an edge on rollers."""
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    return load_scene({**spec, "supports": ROLLERS})


def test_solutions_on_rollers_agree_with_felupe() -> None:
    compare(rolling(), 4)


def test_reactions_on_rollers_balance_the_load() -> None:
    scene = rolling()
    forces = scene.patch_weights.toarray()[5][:, None] * np.array([0.3, -0.5, 0.8])
    u = np.zeros(scene.mesh.n_dofs)
    load = forces.ravel()[scene.free_dofs]
    u[scene.free_dofs] = (
        FullOrderModel(scene).solve(load, options=NewtonOptions(1e-12)).displacement
    )
    held = reactions(scene, forces, u.reshape(-1, 3))
    size = float(np.linalg.norm(forces))
    assert np.abs(held.ravel()[scene.free_dofs]).max() <= 1e-10 * size
    place = scene.mesh.points + u.reshape(-1, 3)
    np.testing.assert_allclose((held + forces).sum(axis=0), 0.0, atol=1e-10 * size)
    moment = np.cross(place, held + forces).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=2e-10 * size)


def test_refined_meshes_keep_the_held_components() -> None:
    tetrahedra = block(discretisation={"element": "tetrahedron"})
    quadratic = block(discretisation={"element": "tetrahedron", "order": 2})
    for scene in (block(), tetrahedra, quadratic):
        # Without a grid, the mesh itself is divided.
        finer = refined(replace(scene, mesh=Mesh(scene.mesh.points, scene.mesh.cells)))
        expected = np.abs(finer.mesh.points) < 1e-12
        np.testing.assert_array_equal(finer.fixed_dofs, np.flatnonzero(expected))


def test_observed_displacements_reproduce_a_solution_on_rollers() -> None:
    scene = rolling()
    spec = scene.generated.model_dump(mode="json")
    observed = load_scene({**spec, "observed": {"region": "z-max"}})
    assert observed.observed_nodes is not None
    forces = scene.patch_weights.toarray()[8][:, None] * np.array([0.0, 0.5, 1.0])
    assert np.isin(np.flatnonzero(forces.any(axis=1)), observed.observed_nodes).all()
    options = NewtonOptions(1e-11)
    exact = FullOrderModel(scene).solve(forces.ravel()[scene.free_dofs], options=options)
    found = ObservedModel(observed).solve_many(exact.displacement[None], options)[0]
    np.testing.assert_allclose(
        found.displacement,  # type: ignore[union-attr]
        exact.displacement,
        atol=1e-9 * np.abs(exact.displacement).max(),
    )


def test_planes_of_symmetry_and_rollers_do_not_mirror_the_scene() -> None:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    assert [mirror.axis for mirror in mirrors(mor_bench.load_scene("beam-tiny"))] == [1]
    roller = {"region": {"box_m": [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]}, "components": ["z"]}
    assert mirrors(load_scene({**spec, "supports": [*spec["supports"], roller]})) == []


@pytest.mark.parametrize(
    ("components", "message"),
    [
        (["x", "w"], r"`supports\[0\].components\[1\]` must be 'x', 'y' or 'z'; got 'w'"),
        (["x", "x"], r"`supports\[0\].components`: one to three different"),
        ([], r"`supports\[0\].components`: one to three different components"),
        ("x", r"`supports\[0\].components` must be a valid tuple"),
    ],
)
def test_wrong_components_are_refused(components: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        block(supports=[{"region": "x-min", "components": components}])


def test_rollers_that_leave_a_motion_free_name_it() -> None:
    with pytest.raises(UnconstrainedBodyError, match="translation z") as raised:
        FullOrderModel(block(supports=PLANES[:2]))
    assert raised.value.free_motions == ("translation z",)


def test_supports_of_all_components_do_not_change_the_digest() -> None:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    named = [{**support, "components": ["z", "y", "x"]} for support in spec["supports"]]
    digest = load_generated_spec("beam-tiny").digest()
    assert load_scene({**spec, "supports": named}).spec.digest() == digest
    assert rolling().spec.digest() != digest
