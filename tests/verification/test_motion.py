"""Prescribed displacements of a tool: closed forms, balance of forces, and the same equilibria."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.discretisation_error import refine
from mor_bench.measure.reaction_errors import ReactionErrors
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.test_sets import spec_of_set
from mor_bench.specs import load_dataset_spec, load_generated_spec

from .scenes import reactions

YOUNG_PA = 500.0
TIGHT = NewtonOptions(1e-12)


def bar(**changed: Any) -> Scene:
    """Return a bar of 2 x 1 x 1 m that does not contract; a tool holds its end."""
    return load_scene(
        {
            "name": "bar",
            "title": "Bar with a moved end",
            "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]},
            "material": material_table("saint-venant-kirchhoff", YOUNG_PA, 0.0),
            "supports": [{"region": "x-min"}],
            "loads": {
                "kind": "displacement",
                "region": "x-max",
                "magnitude_m": [0.1, 0.6],
                "samples": 40,
            },
            "split": {"by": "sample"},
            **changed,
        }
    )


def solved(scene: Scene, motion: list[float]) -> Solution:
    """Return the equilibrium after a motion of the tool, (3,), m."""
    values = np.zeros((scene.mesh.n_nodes, 3))
    values[scene.observed_nodes] = motion
    (found,) = ObservedModel(scene).solve_many(values.reshape(1, -1)[:, scene.free_dofs], TIGHT)
    assert isinstance(found, Solution), found
    return found


@pytest.mark.parametrize("stretch", [0.8, 1.1, 1.4])
def test_the_force_that_stretches_a_bar_has_its_closed_form(stretch: float) -> None:
    scene = bar()
    u = solved(scene, [2.0 * (stretch - 1), 0.0, 0.0]).displacement
    force = ToolForces(scene)(u[None])[0].sum(axis=0)
    # Without contraction, P = λ E (λ² - 1) / 2 on 1 m².
    exact = stretch * YOUNG_PA * (stretch**2 - 1) / 2
    np.testing.assert_allclose(force, [exact, 0.0, 0.0], atol=1e-9 * YOUNG_PA)


def test_the_reactions_of_the_supports_balance_the_tool() -> None:
    scene = bar(material=material_table("neo-hookean", YOUNG_PA, 0.4))
    found = solved(scene, [0.3, -0.4, 0.2]).displacement
    u = np.zeros(scene.mesh.n_dofs)
    u[scene.free_dofs] = found
    tool = ToolForces(scene)(found[None])[0]
    others = reactions(scene, tool, u.reshape(-1, 3))
    size = float(np.linalg.norm(tool.sum(axis=0)))
    held = others[scene.fixed_nodes].sum(axis=0)
    np.testing.assert_allclose(held, -tool.sum(axis=0), atol=1e-10 * size)
    others[scene.fixed_nodes] = 0.0
    assert np.abs(others).max() < 1e-10 * size


def test_a_tool_moves_a_heavy_body_on_springs() -> None:
    scene = bar(
        gravity={"density_kg_m3": 5.0, "acceleration_m_s2": [0.5, -1.0, -2.0]},
        springs=[{"region": "z-min", "stiffness_n_m3": 100.0}],
        material=material_table("neo-hookean", YOUNG_PA, 0.4),
    )
    u = solved(scene, [0.3, -0.4, 0.2]).displacement
    tool = ToolForces(scene)(u[None])[0]
    others = FullOrderModel(scene).force(u).force - tool.ravel()[scene.free_dofs]
    assert np.abs(others).max() < 1e-10 * np.abs(tool).sum()
    light = solved(bar(material=material_table("neo-hookean", YOUNG_PA, 0.4)), [0.3, -0.4, 0.2])
    assert np.linalg.norm(u - light.displacement) > 0.01 * np.linalg.norm(u)


def test_the_forces_of_the_tool_give_the_same_equilibrium() -> None:
    scene = bar(material=material_table("saint-venant-kirchhoff", YOUNG_PA, 0.3))
    u = solved(scene, [0.2, 0.3, -0.1]).displacement
    forces = ToolForces(scene)(u[None]).reshape(-1)[scene.free_dofs]
    plain = load_scene({**scene.spec.model_dump(), "loads": None, "split": {}})
    again = FullOrderModel(plain).solve(forces, options=TIGHT).displacement
    assert np.abs(again - u).max() < 1e-9 * np.abs(u).max()


def test_a_drawn_motion_moves_all_nodes_of_the_tool_alike() -> None:
    scene = bar()
    drawn = draw_loads(scene, 0, 40)
    values = drawn.nodal_forces(scene.patch_weights)
    assert scene.observed_nodes is not None
    lengths = np.linalg.norm(drawn.vectors[:, 0], axis=1)
    assert lengths.min() >= 0.1
    assert lengths.max() <= 0.6
    assert np.ptp(lengths) > 0.3
    np.testing.assert_array_equal(
        values[:, scene.observed_nodes],
        np.broadcast_to(drawn.vectors, (40, len(scene.observed_nodes), 3)),
    )
    others = np.setdiff1d(np.arange(scene.mesh.n_nodes), scene.observed_nodes)
    assert not values[:, others].any()


def test_reaction_errors_compare_resultants() -> None:
    scene = bar()
    u = np.zeros((2, scene.mesh.n_dofs))
    for row, size in zip(u, (0.2, 0.4), strict=True):
        row[scene.free_dofs] = solved(scene, [size, 0.0, 0.0]).displacement
    references = u.reshape(2, -1, 3)
    errors = ReactionErrors(scene)
    np.testing.assert_allclose(errors(references, references), 0.0)
    wrong = references.copy()
    wrong[0] = references[1]
    wrong[1] = np.nan
    force = [ToolForces(scene)(row[None, scene.free_dofs])[0, :, 0].sum() for row in u]
    np.testing.assert_allclose(errors(wrong, references), [force[1] / force[0] - 1, np.inf])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"split": {"by": "region"}}, "`split.by` must be 'sample' or 'direction'"),
        ({"observed": {"region": "z-max"}}, "`observed` must be absent"),
        ({"tests": {"unseen_region": "z-max"}}, "`tests.unseen_region` must be absent"),
        ({"tests": {"paper_magnitude_n": [0, 1]}}, "`tests.paper_magnitude_n` must be absent"),
        ({"supports": [{"region": "surface"}]}, "must be apart from all supports"),
        ({"supports": [{"region": "z-min", "components": ["z"]}]}, "6 of its 9 nodes|3 of its 9"),
    ],
)
def test_contradictions_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        bar(**changed)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"magnitude_n": [0.0, 1.0]},
            "`loads.magnitude_n`; did you mean 'magnitude_m'",
        ),
        ({"magnitude_m": [2.0, 1.0]}, "the lower bound must not exceed"),
        ({"kind": "displacements"}, "'pressure' or 'contact'; got 'displacements'"),
        ({"region": {"box_m": [[0.6, 0.4, 0.4], [0.9, 0.6, 0.6]]}}, "no node"),
    ],
)
def test_bad_plans_are_refused(changed: dict[str, Any], message: str) -> None:
    loads = bar().spec.model_dump()["loads"]
    with pytest.raises(SpecError, match=message):
        bar(loads={**loads, **changed})


def test_a_tool_that_holds_every_free_node_is_refused() -> None:
    geometry = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [1, 1, 1]}
    with pytest.raises(SpecError, match="every free node"):
        bar(geometry=geometry)


def test_a_scene_of_forces_has_no_tool_and_a_tool_no_discretisation_error() -> None:
    with pytest.raises(UnsupportedSceneError, match="no tool moves the body"):
        ToolForces(load_scene("beam-tiny"))
    spec = load_generated_spec(bar().spec.model_dump())
    with pytest.raises(UnsupportedSceneError, match="for forces only"):
        refine(spec)
    with pytest.raises(InvalidInputError, match="its loads are no forces on patches"):
        spec_of_set(spec, "several-forces")


def test_plans_of_forces_keep_their_digests() -> None:
    assert load_dataset_spec("beam-tiny").physics()["loads"]["kind"] == "force"
    assert "magnitude" not in load_generated_spec("beam-tiny").model_dump()["loads"]


@pytest.mark.slow
def test_a_run_gives_the_error_of_the_reaction(tmp_path: Path, cache: Path) -> None:
    path = tmp_path / "bar.toml"
    path.write_text(
        """title = "Bar with a moved end"
[geometry]
shape = "box"
size_m = [2.0, 1.0, 1.0]
cells = [4, 2, 2]
[material]
law = "saint-venant-kirchhoff"
young_pa = 500.0
poisson = 0.3
[[supports]]
region = "x-min"
[loads]
kind = "displacement"
region = "x-max"
magnitude_m = [0.1, 0.6]
samples = 60
[split]
by = "sample"
""",
        encoding="utf-8",
    )
    methods = ["fem", "linear-fem", "pca-regression-linear", "pod"]
    made = mor_bench.run([path], methods, out=tmp_path / "out", cache=cache, profile="quick")
    rows = {row.method: row for row in made.rows}
    assert rows["pod"].status == "skipped"
    for name in methods[:3]:
        error = rows[name].error
        assert error is not None
        assert np.isfinite(error.reaction_rel_median)
    exact, linear = rows["fem"].error, rows["linear-fem"].error
    assert exact
    assert linear
    assert linear.reaction_rel_median > linear.rel_l2_median > exact.rel_l2_median
