"""Following pressures without a potential: the whole tangent, and the equilibria it finds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from mor_bench.errors import InvertedElementError, NoEquilibriumError
from mor_bench.mechanics import pressed as pressed_module
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.pressed import PressedModel
from mor_bench.mechanics.unsymmetric import GeneralFactor, is_stable
from mor_bench.scene.scene import Scene

from .test_following_pressure import CLAMPED, FOLLOWING, TIGHT
from .test_pressure import LOADS, YOUNG_PA, forces_of, pressed

Array = NDArray[np.float64]


def beam(region: str = "z-max", loads: dict[str, Any] = FOLLOWING) -> Scene:
    """Return a slender beam, clamped at one end, with a pressure on one side."""
    return pressed(
        geometry={"shape": "box", "size_m": [8.0, 1.0, 1.0], "cells": [16, 2, 2]},
        supports=CLAMPED,
        loads={**loads, "regions": [region]},
    )


def load_of(scene: Scene, pressure: float) -> Array:
    """Return the nodal forces at the free dofs of a pressure on the undeformed body."""
    return np.asarray(scene.at_free_dofs(forces_of(scene, pressure).reshape(1, -1))[0])


def whole(model: PressedModel, q: Array) -> sp.csr_array:
    """Return the whole tangent, of which the symmetric part is not all."""
    found = model.whole_tangent(q, model.linearise(q)[1])
    assert found is not None
    return found


def plain_newton(model: PressedModel, pressure: float) -> Array:
    """Return the equilibrium by full Newton steps, with increments of 0.1 Pa from rest."""
    q = np.zeros(model.n_unknowns)
    for part in 0.1 * np.arange(1, round(pressure / 0.1) + 1):
        now, load = model.under(np.array([part])), load_of(model.scene, part)
        for _ in range(15):
            residual = load - now.force(q).force
            if np.linalg.norm(residual) <= 1e-11 * np.linalg.norm(load):
                break
            q = q + spsolve(sp.csc_matrix(whole(now, q)), residual)
        else:
            raise AssertionError(f"no convergence at {part:.1f} Pa")
    return q


def differences(model: PressedModel, q: Array, step: float = 1e-6) -> Array:
    """Return the derivative (n, n) of the force, by central differences."""
    moves = step * np.eye(model.n_unknowns)
    pairs = [(model.force(q + move).force, model.force(q - move).force) for move in moves]
    return np.stack([(after - before) / (2 * step) for after, before in pairs], axis=1)


@pytest.mark.parametrize("pressure", [1.2, 1.6])
def test_a_beam_bends_until_the_symmetric_part_of_its_tangent_is_indefinite(
    pressure: float,
) -> None:
    model = PressedModel(beam())
    found = model.solve(load_of(model.scene, pressure), options=TIGHT)
    q = found.displacement
    np.testing.assert_allclose(q, plain_newton(model, pressure), atol=1e-8)
    now = model.under(np.array([pressure]))
    assert found.min_det_f == pytest.approx(now.force(q).min_det_f)
    assert found.min_det_f > 0.5
    tangent = differences(now, q)
    np.testing.assert_allclose(whole(now, q).toarray(), tangent, atol=1e-6 * np.abs(tangent).max())
    assert np.linalg.eigvalsh(tangent + tangent.T)[0] < 0.0
    assert np.linalg.eigvals(tangent).real.min() > 0.0


def test_a_pressure_beyond_the_limit_is_refused() -> None:
    model = PressedModel(beam())
    with pytest.raises((InvertedElementError, NoEquilibriumError), match="of the load after"):
        model.solve(load_of(model.scene, 3.0), options=NewtonOptions(max_cuts=4))


def test_large_models_use_the_symmetric_part_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    model = PressedModel(beam())
    monkeypatch.setattr(pressed_module, "LU_UP_TO", 100)
    q = np.zeros(model.n_unknowns)
    assert model.under(np.ones(1)).whole_tangent(q, model.rest_tangent) is None
    with pytest.raises(NoEquilibriumError):
        model.solve(load_of(model.scene, 1.2), options=NewtonOptions(max_cuts=4))


def test_a_column_under_a_tangential_load_does_not_buckle_statically() -> None:
    # Beck, ZAMP 3 (1952): a force that follows the end of a column has no static buckling load.
    euler = np.pi**2 * YOUNG_PA / 12 / (2 * 8.0) ** 2
    dead, following = beam("x-max", LOADS), beam("x-max")
    load = load_of(dead, 6.0 * euler)
    found = PressedModel(following, "cholesky").solve(load, options=TIGHT)
    u = following.at_all_dofs(found.displacement[None]).reshape(-1, 3)
    end = u[following.mesh.points[:, 0] > 8.0 - 1e-9].mean(axis=0)
    np.testing.assert_allclose(end[1:], 0.0, atol=1e-9)
    assert -0.2 < end[0] < -0.1
    model = PressedModel(following).under(np.array([6.0 * euler]))
    tangent = whole(model, found.displacement).toarray()
    assert np.linalg.eigvalsh(tangent + tangent.T)[0] < 0.0
    with pytest.raises(NoEquilibriumError):
        FullOrderModel(dead, "cholesky").solve(load_of(dead, 2.0 * euler))


def test_the_whole_tangent_is_a_derivative_on_oblique_planes() -> None:
    supports = [*CLAMPED, {"region": "x-max", "direction": [0.0, 0.6, 0.8]}]
    scene = pressed(supports=supports, loads={**FOLLOWING, "regions": ["z-max"]})
    assert scene.frames is not None
    model = PressedModel(scene).under(np.array([30.0]))
    q = 0.05 * np.random.default_rng(0).normal(size=model.n_unknowns)
    tangent = differences(model, q)
    np.testing.assert_allclose(
        whole(model, q).toarray(), tangent, atol=1e-7 * np.abs(tangent).max()
    )


@pytest.mark.parametrize(
    ("blocks", "stable"),
    [
        ([1e-3], True),
        ([-1e-3], False),
        ([-0.6], False),
        ([-40.0], False),
        ([-0.5, -0.5], False),
        ([[[-0.1, 2.0], [-2.0, -0.1]]], True),  # flutter needs inertia
        ([[[-0.1, 2.0], [-2.0, -0.1]], -0.05], False),
        ([[[-0.1, 0.1 * k], [-0.1 * k, -0.1]] for k in range(1, 5)], False),  # too many
    ],
)
def test_real_eigenvalues_decide_on_stability(blocks: list[Any], stable: bool) -> None:
    assert is_stable(*matrices(blocks, 60)) is stable


FLUTTER = [[[-0.1, 0.1 * k], [-0.1 * k, -0.1]] for k in range(1, 5)]


@pytest.mark.parametrize(
    ("blocks", "stable"),
    [([1e-3], True), ([-0.05], False), (FLUTTER, True), ([*FLUTTER, -2.0], False)],
)
def test_all_eigenvalues_of_few_unknowns_are_known(blocks: list[Any], stable: bool) -> None:
    assert is_stable(*matrices(blocks, 10)) is stable


def matrices(blocks: list[Any], n: int) -> tuple[sp.csr_array, sp.csr_array]:
    """Return a tangent, with these eigenvalues and positive ones, and the stiffness at rest."""
    generator = np.random.default_rng(0)
    own = scipy.linalg.block_diag(*blocks)
    mu = scipy.linalg.block_diag(own, np.diag(np.geomspace(0.1, 50.0, n - len(own))))
    root = np.eye(n) + 0.3 * generator.normal(size=(n, n))
    vectors = np.eye(n) + 0.05 * generator.normal(size=(n, n))
    rest = root @ root.T
    tangent = rest @ vectors @ mu @ np.linalg.inv(vectors)
    return sp.csr_array(tangent), sp.csr_array(rest)


def test_a_cube_with_five_unknowns_inverts() -> None:
    """One facet is pressed and another pulled, until the cube inverts; the reverse is stable."""
    scene = pressed(
        geometry={"shape": "box", "size_m": [1.0, 1.0, 1.0], "cells": [1, 1, 1]},
        supports=[
            {"region": "x-min"},
            {"region": "y-min"},
            {"region": "z-min", "components": ["z"]},
        ],
        loads={**FOLLOWING, "regions": ["z-max", "x-max"]},
    )
    model = PressedModel(scene)
    assert model.n_unknowns == 5
    areas = scene.patch_weights.toarray().reshape(2, 3, -1).transpose(0, 2, 1)
    load = scene.at_free_dofs((areas[1] - areas[0]).reshape(1, -1))[0]
    model.solve(0.8 * YOUNG_PA * load, options=TIGHT)
    with pytest.raises(InvertedElementError):
        model.solve(-YOUNG_PA * load, options=TIGHT)


def test_a_singular_matrix_has_no_factor() -> None:
    with pytest.raises(NotPositiveDefiniteError):
        GeneralFactor(sp.csr_array(np.ones((3, 3))))
