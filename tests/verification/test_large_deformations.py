"""Linear responses to large loads are bent before the iteration, which then stays fast."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mor_bench
from mor_bench.errors import SolverError
from mor_bench.hard_cases.setups import distorted_box
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.pattern import build_pattern
from mor_bench.mechanics.warping import Warp, warp_of
from mor_bench.scene.scene import Scene

from .laws_and_elements import quick_first
from .scenes import patch_load, relative_residual, scene_of

Array = NDArray[np.float64]


def warp_of_box(tetrahedra: bool, held: tuple[tuple[int, int], ...] = ()) -> tuple[Warp, Array]:
    """Return the warp of a box, whose node 0 at the origin is fixed, and its other nodes.

    Further components, (node, axis), may be held.
    """
    mesh = distorted_box((3, 2, 2), tetrahedra)
    element = element_of(mesh.cells)
    free = np.ones((mesh.n_nodes, 3), dtype=bool)
    free[0] = False
    for node, axis in held:
        free[node, axis] = False
    number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, free.sum())
    pattern, _ = build_pattern(number, mesh.cells, int(free.sum()))
    gradients, det_j = shape_gradients(mesh.points, mesh.cells, element.centre[None])
    nodes = np.where(mesh.cells == 0, mesh.n_nodes - 1, mesh.cells - 1).astype(np.int32)
    turning = nodes, gradients[:, 0], det_j[:, 0] * element.weights.sum()
    warp = warp_of(mesh.points, mesh.cells, turning, pattern, np.arange(mesh.n_nodes - 1))
    assert warp is not None
    return warp, mesh.points[1:]


@pytest.mark.parametrize("tetrahedra", [False, True])
@pytest.mark.parametrize("angle", [1e-5, 0.3, 2.0])
def test_a_uniform_spin_and_strain_become_a_rotation_and_the_strain(
    tetrahedra: bool, angle: float
) -> None:
    """Closed form: F = exp(ω) (I + ε)."""
    warp, x = warp_of_box(tetrahedra)
    spin = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    skew = np.cross(spin, np.eye(3)).T
    strain = 0.1 * angle * np.array([[1.0, 0.3, 0.0], [0.3, -0.5, 0.2], [0.0, 0.2, 0.4]])
    linear = np.append(x @ (skew + strain).T, np.zeros((1, 3)), axis=0)
    wanted = Rotation.from_rotvec(spin).as_matrix() @ (np.eye(3) + strain) - np.eye(3)
    np.testing.assert_allclose(warp(linear), x @ wanted.T, rtol=0, atol=3e-5 * angle)


def test_held_components_stay_where_they_are() -> None:
    held = ((1, 0), (2, 0), (5, 2))
    warp, x = warp_of_box(False, held)
    linear = np.append(np.cross([0.2, 0.5, 0.3], x), np.zeros((1, 3)), axis=0)
    for node, axis in held:
        linear[node - 1, axis] = 0.0
    bent = warp(linear)
    assert all(bent[node - 1, axis] == 0.0 for node, axis in held)
    assert np.abs(bent - linear[:-1]).max() < 0.3


def bendable() -> Scene:
    """Return a beam with patches on its whole end."""
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    spec["geometry"] = {"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [20, 5, 5]}
    spec["loads"] |= {"region": "x-max", "patch_area_m2": 1.0}
    return mor_bench.load_scene(spec)


@pytest.fixture(scope="module")
def bending() -> FullOrderModel:
    model = FullOrderModel(bendable())
    model.prepare()
    return model


@pytest.mark.parametrize(
    ("newton", "least", "most"), [(1.0, 0.4, 13), (2.0, 0.8, 17), (4.5, 1.8, 27)]
)
def test_large_bending_takes_few_iterations_to_the_same_answer(
    bending: FullOrderModel, newton: float, least: float, most: int
) -> None:
    """The unbent response needs 40 iterations or Newton's method beyond 1 m of the 4 m."""
    load = patch_load(bending.scene, 12, [0.0, 0.3 * newton, -0.95 * newton])
    found = bending.solve(load)
    assert np.abs(found.displacement).max() >= least
    assert found.iterations <= most
    assert relative_residual(bending, load, found.displacement) <= 1e-8
    direct = FullOrderModel(bending.scene, "cholesky").solve(load, options=NewtonOptions(1e-10))
    size = np.abs(direct.displacement).max()
    assert np.abs(found.displacement - direct.displacement).max() <= 1e-8 * size


def test_large_loads_have_the_same_answers_alone_and_among_others(bending: FullOrderModel) -> None:
    loads = np.stack(
        [patch_load(bending.scene, 12, [0.0, 0.0, newton]) for newton in (0.01, 1.0, -2.0, 4.0)]
    )
    for load, among in zip(loads, bending.solve_many(loads), strict=True):
        assert isinstance(among, Solution)
        alone = bending.solve(load)
        assert (alone.displacement == among.displacement).all()
        assert alone.iterations == among.iterations


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_every_law_and_element_ends_at_the_same_answer_from_a_bent_start(
    law: str, kind: tuple[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(law, kind)
    load = patch_load(scene, -1, [0.5, -1.0, 3.0])
    plain = FullOrderModel(scene).solve(load, options=NewtonOptions(1e-10))
    monkeypatch.setattr("mor_bench.mechanics.accelerated.STRETCHED", 0.0)
    bent = FullOrderModel(scene).solve(load, options=NewtonOptions(1e-10))
    size = np.abs(plain.displacement).max()
    assert np.abs(plain.displacement - bent.displacement).max() <= 1e-7 * size


def test_no_unstable_column_is_accepted_from_a_bent_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Euler's load is about 1 N; a straight column beyond it is unstable."""
    monkeypatch.setattr("mor_bench.mechanics.accelerated.STRETCHED", 0.0)
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    spec["geometry"] = {"shape": "box", "size_m": [10.0, 1.0, 1.0], "cells": [20, 2, 2]}
    spec["loads"] |= {"region": "x-max", "patch_area_m2": 1.0}
    spec["material"] = {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.3}
    model = FullOrderModel(mor_bench.load_scene(spec))
    for push in ([-1.2, 0.0, 0.0], [-2.0, 0.0, 0.02], [-1.5, 0.03, 0.01], [-1.2, 0.0, 0.5]):
        load = patch_load(model.scene, 4, push)
        try:
            u = model.solve(load).displacement
        except SolverError:
            continue
        assert relative_residual(model, load, u) <= 1e-8
        BandedCholesky(model.assembler.pattern).factor(model.linearise(u)[1])
