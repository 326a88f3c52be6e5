"""Every law on every element, with full and with selective integration: laws of mechanics and closed forms."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mor_bench
from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.elements import H8, T4, shape_gradients
from mor_bench.mechanics.linear import BandedCholesky
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.materials import Material, MooneyRivlin, NeoHookean, Ogden, SaintVenantKirchhoff
from mor_bench.scene.mesh import Mesh, box_mesh

from .test_full_order import dense, free_assembler

Array = NDArray[np.float64]
LAWS: dict[str, Material] = {
    "saint-venant-kirchhoff": SaintVenantKirchhoff(500.0, 0.4),
    "neo-hookean": NeoHookean(500.0, 0.4),
    "mooney-rivlin": MooneyRivlin(70.0, 20.0, 800.0),
    "ogden": Ogden((100.0, -20.0), (2.1, -1.7), 800.0),
}
ELEMENTS = [("hexahedron", False), ("hexahedron", True), ("tetrahedron", False)]
EVERY = list(itertools.product(LAWS, ELEMENTS))


def warped(element: str, cells: tuple[int, int, int] = (2, 2, 2), seed: int = 0) -> Mesh:
    """A unit box whose inner nodes are moved by up to 0.3 of a cell's edge (0.15 with tetrahedra, which are thinner)."""
    mesh = box_mesh((1.0, 1.0, 1.0), cells, element == "tetrahedron")
    inner = np.all((mesh.points > 1e-9) & (mesh.points < 1 - 1e-9), axis=1)
    reach = (0.15 if element == "tetrahedron" else 0.3) / np.array(cells)
    points = mesh.points.copy()
    points[inner] += np.random.default_rng(seed).uniform(-1, 1, (int(inner.sum()), 3)) * reach
    return Mesh(points, mesh.cells)


def assembler(mesh: Mesh, law: Material, selective: bool = False) -> Assembler:
    return Assembler(mesh.points, mesh.cells, np.arange(mesh.n_dofs).reshape(-1, 3), mesh.n_dofs, law, selective=selective)


@pytest.mark.parametrize(("law", "kind"), EVERY)
def test_taylor(law: str, kind: tuple[str, bool]) -> None:
    model = assembler(warped(kind[0]), LAWS[law], kind[1])
    worst = np.inf
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u, direction = 0.02 * rng.normal(size=model.n_dofs), 0.1 * rng.normal(size=model.n_dofs)
        state, values = model.force_and_tangent(u)
        stiffness = dense(model, values)
        steps = [1e-1, 1e-2, 1e-3, 1e-4]
        there = [model.force(u + h * direction) for h in steps]
        energy = np.array([abs(s.energy_j - state.energy_j - h * direction @ state.force) for h, s in zip(steps, there, strict=True)])
        force = np.array([np.linalg.norm(s.force - state.force - h * stiffness @ direction) for h, s in zip(steps, there, strict=True)])
        worst = min(worst, *(np.log10(remainder[0] / remainder[-1]) / 3 for remainder in (energy, force)))
    assert worst >= 1.95


@pytest.mark.parametrize(("law", "kind"), EVERY)
def test_rest_is_stress_free_with_six_zero_modes_and_rotations_cost_nothing(law: str, kind: tuple[str, bool]) -> None:
    mesh = warped(kind[0])
    model = assembler(mesh, LAWS[law], kind[1])
    state, tangent = model.force_and_tangent(np.zeros(mesh.n_dofs))
    stiffness = dense(model, tangent)
    size = np.linalg.norm(stiffness, 2)
    assert np.abs(state.force).max() <= 1e-14 * size
    values = np.linalg.eigvalsh(stiffness)
    assert (np.abs(values) <= 1e-12 * values[-1]).sum() == 6
    for rotation in Rotation.random(100, random_state=1).as_matrix():
        u = (mesh.points @ rotation.T - mesh.points).ravel()
        assert np.linalg.norm(model.force(u).force) <= 1e-12 * size * np.linalg.norm(u)


@pytest.mark.parametrize(("law", "kind"), EVERY)
def test_patch_of_warped_cells(law: str, kind: tuple[str, bool]) -> None:
    mesh = warped(kind[0], (3, 3, 3))
    gradient = np.eye(3) + np.array([[0.1, 0.05, -0.02], [0.03, -0.08, 0.04], [0.0, 0.06, 0.07]])
    exact = mesh.points @ (gradient - np.eye(3)).T
    outer = np.any((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9), axis=1)
    model = assembler(mesh, LAWS[law], kind[1])
    inner = np.flatnonzero(np.repeat(~outer, 3))
    u = exact.ravel().copy()
    u[inner] += 0.01 * np.random.default_rng(0).normal(size=len(inner)) * 0.3
    for _ in range(12):
        state, values = model.force_and_tangent(u)
        u[inner] -= np.linalg.solve(dense(model, values)[np.ix_(inner, inner)], state.force[inner])
    assert np.abs(u.reshape(-1, 3) - exact).max() <= 1e-12


def homogeneous(gradient: Array, law: Material, element: str, selective: bool) -> tuple[Array, float]:
    """First Piola-Kirchhoff stress and energy density of a unit cube under the deformation gradient F, from nodal forces."""
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2), element == "tetrahedron")
    state = assembler(mesh, law, selective).force((mesh.points @ (gradient - np.eye(3)).T).ravel())
    forces = state.force.reshape(-1, 3)
    return np.stack([forces[mesh.points[:, axis] == 1.0].sum(axis=0) for axis in range(3)], axis=1), state.energy_j


@pytest.mark.parametrize("kind", ELEMENTS)
def test_homogeneous_states_of_saint_venant_kirchhoff(kind: tuple[str, bool]) -> None:
    law = SaintVenantKirchhoff(500.0, 0.4)
    p, energy = homogeneous(np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), law, *kind)
    np.testing.assert_allclose(p, [[133.9286, 156.25, 0.0], [89.2857, 133.9286, 0.0], [0.0, 0.0, 89.2857]], atol=1e-4)
    assert energy == pytest.approx(30.69196, abs=1e-5)
    p, _ = homogeneous(np.diag([2.0, np.sqrt(0.1), np.sqrt(0.1)]), SaintVenantKirchhoff(1.0, 0.3), *kind)
    np.testing.assert_allclose(p, np.diag([3.0, 0.0, 0.0]), atol=1e-13)


@pytest.mark.parametrize("kind", ELEMENTS)
def test_homogeneous_states_of_the_other_laws(kind: tuple[str, bool]) -> None:
    """P = F S by hand: neo-Hookean in any F; isochoric shear of Mooney-Rivlin; principal stretches of Ogden."""
    gradient = np.array([[1.1, 0.2, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 1.05]])
    neo = NeoHookean(500.0, 0.4)
    inverse, log_j = np.linalg.inv(gradient).T, np.log(np.linalg.det(gradient))
    expected = neo.lame_mu * (gradient - inverse) + neo.lame_lambda * log_j * inverse
    np.testing.assert_allclose(homogeneous(gradient, neo, *kind)[0], expected, rtol=1e-11, atol=1e-10)

    mooney, k = MooneyRivlin(70.0, 20.0, 800.0), 0.5
    p, energy = homogeneous(np.array([[1.0, k, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), mooney, *kind)
    assert p[0, 1] == pytest.approx(2 * (70.0 + 20.0) * k, rel=1e-12)
    assert energy == pytest.approx((70.0 + 20.0) * k**2, rel=1e-12)

    ogden, stretch = Ogden((100.0, -20.0), (2.1, -1.7), 800.0), np.array([1.3, 0.9, 1.05])
    volume = stretch.prod()
    bar = stretch * volume ** (-1 / 3)
    own = sum(mu * (bar**alpha - (bar**alpha).mean()) for mu, alpha in zip(ogden.mu_pa, ogden.alpha, strict=True))
    np.testing.assert_allclose(np.diag(homogeneous(np.diag(stretch), ogden, *kind)[0]), (own + 800.0 * (volume - 1) * volume) / stretch, rtol=1e-11)


@pytest.mark.parametrize("law", list(LAWS))
def test_small_strains_are_hookes(law: str) -> None:
    """At rest the tangent is that of linear elasticity with the law's Poisson ratio."""
    material = LAWS[law]
    tension = 1e-6
    stretch = np.diag([1 + tension, 1 - material.poisson_at_rest * tension, 1 - material.poisson_at_rest * tension])
    p, _ = homogeneous(stretch, material, "hexahedron", False)
    assert abs(p[1, 1]) <= 1e-4 * p[0, 0]
    assert material.poisson_at_rest == pytest.approx({"mooney-rivlin": 0.39535, "ogden": 0.42744}.get(law, 0.4), abs=1e-4)


def test_the_vectorised_kernel_is_the_general_one() -> None:
    class Renamed(NeoHookean):
        """Saint Venant-Kirchhoff by its number, so that the general kernel evaluates it."""

        law = 0

    mesh = warped("hexahedron", (3, 2, 2))
    u = 0.03 * np.random.default_rng(0).normal(size=mesh.n_dofs)
    for selective in (False, True):
        (fast, k), (slow, l) = (
            assembler(mesh, law, selective).force_and_tangent(u) for law in (SaintVenantKirchhoff(500.0, 0.4), Renamed(500.0, 0.4))
        )
        np.testing.assert_allclose(fast.force, slow.force, atol=1e-12 * np.abs(slow.force).max() * 10)
        np.testing.assert_allclose(k, l, atol=1e-13 * np.abs(l).max() * 10)
        assert fast.energy_j == pytest.approx(slow.energy_j, rel=1e-13)
        assert fast.min_det_f == pytest.approx(slow.min_det_f, rel=1e-13)


def manufactured_error(n: int, element: str) -> tuple[float, float]:
    """L2 and H1 error on n³ cells for u = 0.05 sin(πx) sin(πy) sin(πz) (1, -1, 0.5), whose body force is integrated."""
    law, direction = SaintVenantKirchhoff(1.0, 0.3), 0.05 * np.array([1.0, -1.0, 0.5])

    def field(x: Array) -> Array:
        return np.asarray(np.sin(np.pi * x).prod(axis=-1)[..., None] * direction)

    def gradient(x: Array) -> Array:
        s, c = np.sin(np.pi * x), np.cos(np.pi * x)
        d = np.pi * np.stack([c[..., 0] * s[..., 1] * s[..., 2], s[..., 0] * c[..., 1] * s[..., 2], s[..., 0] * s[..., 1] * c[..., 2]], axis=-1)
        return np.asarray(direction[:, None] * d[..., None, :])

    def piola(x: Array) -> Array:
        deformation = np.eye(3) + gradient(x)
        strain = 0.5 * (np.swapaxes(deformation, -1, -2) @ deformation - np.eye(3))
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        return np.asarray(deformation @ (law.lame_lambda * trace * np.eye(3) + 2 * law.lame_mu * strain))

    def body_force(x: Array) -> Array:
        h, total = 1e-3, np.zeros(x.shape)
        for j in range(3):
            e = h * np.eye(3)[j]
            total -= ((8 * (piola(x + e) - piola(x - e)) - piola(x + 2 * e) + piola(x - 2 * e)) / (12 * h))[..., j]
        return total

    mesh = box_mesh((1.0, 1.0, 1.0), (n, n, n), element == "tetrahedron")
    kind = H8 if element == "hexahedron" else T4
    if kind is H8:
        places = np.array(list(itertools.product((-1, 1), repeat=3))) / np.sqrt(3.0)
        corners = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
        shape, weights = np.prod(1 + places[:, None] * corners, axis=2) / 8, np.ones(8)
        terms = 1 + places[:, None] * corners
        derivatives = np.stack([corners[:, i] * np.prod(np.delete(terms, i, axis=2), axis=2) for i in range(3)], axis=2) / 8
    else:
        a, b = 0.58541020, 0.13819660
        shape, weights = np.full((4, 4), b) + (a - b) * np.eye(4), np.full(4, 1 / 24)
        derivatives = np.repeat(T4.derivatives, 4, axis=0)
    gradients, det_j = shape_gradients(mesh.points, mesh.cells, derivatives)
    volume = det_j * weights
    x = np.einsum("qa,cai->cqi", shape, mesh.points[mesh.cells])
    outer = np.any((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9), axis=1)
    free = int((~outer).sum())
    dofs = np.full((mesh.n_nodes, 3), 3 * free)
    dofs[~outer] = np.arange(3 * free).reshape(-1, 3)
    load = np.zeros(3 * free + 1)
    np.add.at(load, dofs[mesh.cells], np.einsum("qa,cq,cqi->cai", shape, volume, body_force(x)))
    model = Assembler(mesh.points, mesh.cells, dofs, 3 * free, law)
    solver, u = BandedCholesky(model.pattern), np.zeros(3 * free)
    for _ in range(6):
        state, values = model.force_and_tangent(u)
        u += solver.factor(values).solve(load[:-1] - state.force)
    nodal = np.append(u, 0.0)[dofs][mesh.cells]
    difference = np.einsum("qa,cai->cqi", shape, nodal) - field(x)
    slope = np.einsum("cai,cqaj->cqij", nodal, gradients) - gradient(x)
    return float(np.sqrt((volume[..., None] * difference**2).sum())), float(np.sqrt((volume[..., None, None] * slope**2).sum()))


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
def test_manufactured_solution_converges_at_the_right_order(element: str) -> None:
    """On these meshes T4 is not yet in its asymptotic range: L2 order 1.88."""
    coarse, fine = manufactured_error(7, element), manufactured_error(14, element)
    assert np.log2(coarse[0] / fine[0]) >= (1.95 if element == "hexahedron" else 1.85)
    assert np.log2(coarse[1] / fine[1]) >= 0.95


def cantilever(size: list[float], cells: list[int], poisson: float, integration: str = "full") -> FullOrderModel:
    spec: dict[str, Any] = {
        "geometry": {"shape": "box", "size_m": size, "cells": cells},
        "discretisation": {"integration": integration},
        "material": {"law": "saint-venant-kirchhoff", "young_pa": 12e3, "poisson": poisson},
        "supports": [{"region": "x-min"}],
        "loads": {"region": "x-max", "kind": "force", "patch_area_m2": size[1] * size[2], "samples_per_patch": 1, "magnitude_n": [0.0, 1.0]},
        "needs": {"error": 0.01, "latency_ms": 1.0},
    }
    return FullOrderModel(mor_bench.load_scene(spec))


def tip(model: FullOrderModel, force_z: float) -> Array:
    """Mean displacement of the end face under a force spread over it."""
    scene = model.scene
    load = np.zeros((scene.mesh.n_nodes, 3))
    load[:, 2] = scene.patch_weights.toarray()[0] * force_z
    u = np.zeros(scene.mesh.n_dofs)
    u[scene.free_dofs] = model.solve(load.ravel()[scene.free_dofs]).displacement
    end = scene.mesh.points[:, 0] == scene.mesh.points[:, 0].max()
    return np.asarray(u.reshape(-1, 3)[end].mean(axis=0))


@pytest.fixture(scope="module")
def slender() -> FullOrderModel:
    return cantilever([20.0, 1.0, 1.0], [160, 1, 8], 0.0)


ELASTICA = {0.25: (0.082746, 0.004118), 0.5: (0.162144, 0.015919), 1.0: (0.301721, 0.056433), 2.0: (0.493457, 0.160642),
            3.0: (0.603253, 0.254420), 5.0: (0.713792, 0.387628), 10.0: (0.810609, 0.554996)}  # fmt: skip


@pytest.mark.parametrize("load", list(ELASTICA))
def test_elastica(slender: FullOrderModel, load: float) -> None:
    """Bisshopp and Drucker 1945: dead tip load P on a slender cantilever, by PL²/EI; deflections over the length."""
    deflection = tip(slender, -load * 1000.0 / 20.0**2) / 20.0
    down, back = ELASTICA[load]
    assert -deflection[2] == pytest.approx(down, rel=0.02)
    assert -deflection[0] == pytest.approx(back, rel=0.02)


@pytest.mark.parametrize("poisson", [0.48, 0.49, 0.499, 0.4999])
def test_selective_integration_cures_volumetric_locking(poisson: float) -> None:
    """A short cantilever stiffens without bound as ν → 1/2 with full integration, and hardly at all with selective."""
    reference = tip(cantilever([4.0, 1.0, 1.0], [16, 4, 4], 0.3), -50.0)[2]
    full = tip(cantilever([4.0, 1.0, 1.0], [16, 4, 4], poisson), -50.0)[2]
    selective = tip(cantilever([4.0, 1.0, 1.0], [16, 4, 4], poisson, "selective"), -50.0)[2]
    assert selective / reference == pytest.approx(1.0, abs=0.06)
    if poisson >= 0.499:
        assert full / reference < 0.75


def test_slender_beam_of_hundred_to_one_terminates() -> None:
    """PL²/EI = 0.6, exact w/L = 0.19235; with one cell over the height it locks in shear, but it ends."""
    length = 100.0
    deflection = -tip(cantilever([length, 1.0, 1.0], [200, 1, 2], 0.0), -0.6 * 1000.0 / length**2)[2] / length
    assert 0.5 * 0.19235 < deflection < 0.19235


def test_stiffness_contrast_of_a_million_passes_the_patch_test_in_tension() -> None:
    """Two bars in series, the second a million times softer: all of the stretch is in it."""
    mesh = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))
    law = SaintVenantKirchhoff(1.0, 0.0)
    fixed = mesh.points[:, 0] == 0
    dofs = np.full((mesh.n_nodes, 3), 3 * int((~fixed).sum()))
    dofs[~fixed] = np.arange(3 * int((~fixed).sum())).reshape(-1, 3)
    model = Assembler(mesh.points, mesh.cells, dofs, 3 * int((~fixed).sum()), law, np.array([1e6, 1.0]))
    alpha = 1.2
    load = np.zeros((mesh.n_nodes, 3))
    load[mesh.points[:, 0] == 2.0, 0] = 0.5 * (alpha**3 - alpha) / 4
    u = np.zeros(model.n_dofs)
    for _ in range(12):
        state, values = model.force_and_tangent(u)
        u += BandedCholesky(model.pattern).factor(values).solve(load[~fixed].ravel() - state.force)
    end = u.reshape(-1, 3)[mesh.points[~fixed][:, 0] == 2.0, 0]
    np.testing.assert_allclose(end, alpha - 1, rtol=2e-6)


@pytest.mark.parametrize("law", list(LAWS))
@pytest.mark.parametrize("kind", ELEMENTS)
def test_huge_loads_end_in_a_valid_answer_or_a_typed_error(law: str, kind: tuple[str, bool]) -> None:
    parameters: dict[str, dict[str, Any]] = {
        "saint-venant-kirchhoff": {"young_pa": 500.0, "poisson": 0.4},
        "neo-hookean": {"young_pa": 500.0, "poisson": 0.4},
        "mooney-rivlin": {"c10_pa": 70.0, "c01_pa": 20.0, "bulk_pa": 800.0},
        "ogden": {"mu_pa": [100.0, -20.0], "alpha": [2.1, -1.7], "bulk_pa": 800.0},
    }
    spec = mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json")
    spec["discretisation"] = {"element": kind[0], "integration": "selective" if kind[1] else "full"}
    scene = mor_bench.load_scene({**spec, "material": {"law": law, **parameters[law]}})
    model = FullOrderModel(scene)
    weights = scene.patch_weights.toarray()[-1][:, None]
    solved = 0
    for size, axis in itertools.product((1.0, 20.0), range(3)):
        try:
            solution = model.solve((weights * -size * np.eye(3)[axis]).ravel()[scene.free_dofs])
        except SolverError:
            continue
        solved += 1
        assert solution.min_det_f > 0
    assert solved >= 3


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([[0, 1, 2, 3, 4]], r"cells must have shape \(n_cells, 8\) for H8 or \(n_cells, 4\) for T4; got \(1, 5\)"),
        ([[0, 2, 1, 4]], r"cell 0 is inverted or degenerate"),
        ([[0, 1, 2, 3]], r"cell 0 is inverted or degenerate"),
        ([[0, 1, 1, 4]], r"cell 0 is inverted or degenerate"),
    ],
)
def test_impossible_cells_are_refused(cells: list[list[int]], message: str) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
    with pytest.raises(InvalidInputError, match=message):
        free_assembler(Mesh(points, np.array(cells)))
