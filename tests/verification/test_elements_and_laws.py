"""Every material law on every element, against laws of mechanics and closed forms."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.hard_cases.setups import (
    cantilever,
    dense,
    distorted_box,
    free_assembler,
    patch_test_error,
    tip,
)
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.materials import Material, NeoHookean, SaintVenantKirchhoff
from mor_bench.scene.mesh import Mesh, box_mesh

from .laws_and_elements import (
    COMPRESSIBLE,
    ELEMENTS,
    EVERY,
    ISOTROPIC,
    LAWS,
    manufactured_error,
    mesh_options,
    piola,
    quick_first,
    unit_box,
)
from .scenes import scene_of

Array = NDArray[np.float64]


def warped(element: str, cells: tuple[int, int, int] = (2, 2, 2)) -> Mesh:
    return distorted_box(cells, **mesh_options(element))


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_taylor_remainders_of_energy_and_force_are_of_second_order(
    law: str, kind: tuple[str, bool]
) -> None:
    model = free_assembler(warped(kind[0]), LAWS[law], kind[1])
    worst = np.inf
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, direction = 0.02 * rng.normal(size=model.n_dofs), 0.1 * rng.normal(size=model.n_dofs)
        state, values = model.force_and_tangent(u)
        stiffness = dense(model, values)
        remainders: list[tuple[float, float]] = []
        for h in (1e-1, 1e-4):
            there = model.force(u + h * direction)
            energy = there.energy_j - state.energy_j - h * direction @ state.force
            force = there.force - state.force - h * stiffness @ direction
            remainders.append((float(abs(energy)), float(np.linalg.norm(force))))
        worst = min(worst, *np.log10(np.divide(remainders[0], remainders[1])) / 3)
    assert worst >= 1.95


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_rest_is_stress_free_with_six_zero_modes_and_rotations_cost_nothing(
    law: str, kind: tuple[str, bool]
) -> None:
    mesh = warped(kind[0])
    model = free_assembler(mesh, LAWS[law], kind[1])
    state, tangent = model.force_and_tangent(np.zeros(mesh.n_dofs))
    stiffness = dense(model, tangent)
    size = np.linalg.norm(stiffness, 2)
    assert np.abs(state.force).max() <= 1e-14 * size
    values = np.linalg.eigvalsh(stiffness)
    assert (np.abs(values) <= 1e-12 * values[-1]).sum() == 6
    for rotation in Rotation.random(20, random_state=1).as_matrix():
        u = (mesh.points @ rotation.T - mesh.points).ravel()
        assert np.linalg.norm(model.force(u).force) <= 1e-12 * size * np.linalg.norm(u)


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_a_patch_of_warped_cells_is_exact_for_linear_fields(
    law: str, kind: tuple[str, bool]
) -> None:
    assert patch_test_error(warped(kind[0], (3, 3, 3)), LAWS[law], kind[1]) <= 1e-12


def homogeneous(
    gradient: Array, law: Material, element: str, selective: bool
) -> tuple[Array, float]:
    """Return stress and energy density of a unit cube under a deformation gradient."""
    mesh = unit_box(2, element)
    state = free_assembler(mesh, law, selective).force(
        (mesh.points @ (gradient - np.eye(3)).T).ravel()
    )
    forces = state.force.reshape(-1, 3)
    return np.stack(
        [forces[mesh.points[:, axis] == 1.0].sum(axis=0) for axis in range(3)], axis=1
    ), state.energy_j


@pytest.mark.parametrize("kind", ELEMENTS)
def test_homogeneous_states_of_saint_venant_kirchhoff_match_hand_computed_values(
    kind: tuple[str, bool],
) -> None:
    law = SaintVenantKirchhoff(500.0, 0.4)
    p, energy = homogeneous(
        np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), law, *kind
    )
    np.testing.assert_allclose(
        p, [[133.9286, 156.25, 0.0], [89.2857, 133.9286, 0.0], [0.0, 0.0, 89.2857]], atol=1e-4
    )
    assert energy == pytest.approx(30.69196, abs=1e-5)
    p, _ = homogeneous(
        np.diag([2.0, np.sqrt(0.1), np.sqrt(0.1)]), SaintVenantKirchhoff(1.0, 0.3), *kind
    )
    np.testing.assert_allclose(p, np.diag([3.0, 0.0, 0.0]), atol=1e-13)


STATES = {
    "general": np.array([[1.1, 0.2, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 1.05]]),
    "shear": np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "stretch": np.diag([1.5, 0.9, 0.8]),
    "hydrostatic": 0.8 * np.eye(3),
    "almost hydrostatic": np.diag([0.8, 0.8 + 1e-9, 0.8]),
}


@pytest.mark.parametrize("state", list(STATES))
@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_stress_of_homogeneous_states_matches_the_closed_forms(
    law: str, kind: tuple[str, bool], state: str
) -> None:
    p, energy = homogeneous(STATES[state], LAWS[law], *kind)
    np.testing.assert_allclose(p, piola(LAWS[law], STATES[state]), rtol=1e-10, atol=1e-9)
    # The energy is the work of the stress along a straight path from rest.
    places, weights = np.polynomial.legendre.leggauss(12)
    way = np.eye(3) + (0.5 + 0.5 * places[:, None, None]) * (STATES[state] - np.eye(3))
    work = 0.5 * weights @ np.einsum("nij,ij->n", piola(LAWS[law], way), STATES[state] - np.eye(3))
    assert energy == pytest.approx(work, rel=1e-9)


@pytest.mark.parametrize("law", list(LAWS))
def test_the_tangent_is_exact_where_two_stretches_are_equal(law: str) -> None:
    """At equal stretches the derivative of the principal stresses is a limit."""
    model = free_assembler(box_mesh((1.0, 1.0, 1.0), (2, 2, 2)), LAWS[law])
    points = box_mesh((1.0, 1.0, 1.0), (2, 2, 2)).points
    u, direction = (
        (points * [0.3, -0.1, -0.1]).ravel(),
        np.random.default_rng(0).normal(size=model.n_dofs),
    )
    here = dense(model, model.force_and_tangent(u)[1]) @ direction
    ahead, behind = (model.force(u + h * direction).force for h in (1e-5, -1e-5))
    np.testing.assert_allclose(here, (ahead - behind) / 2e-5, atol=1e-6 * np.abs(here).max())


@pytest.mark.parametrize("kind", ELEMENTS)
def test_hydrostatic_stress_of_saint_venant_kirchhoff_matches_its_closed_form(
    kind: tuple[str, bool],
) -> None:
    law = SaintVenantKirchhoff(500.0, 0.4)
    for alpha in (0.7, 0.95, 1.3):
        expected = (3 * law.lame_lambda + 2 * law.lame_mu) / 2 * (alpha**3 - alpha)
        np.testing.assert_allclose(
            homogeneous(alpha * np.eye(3), law, *kind)[0],
            expected * np.eye(3),
            rtol=1e-12,
            atol=1e-10,
        )


@pytest.mark.parametrize("kind", ELEMENTS)
def test_stress_of_saint_venant_kirchhoff_is_least_at_one_over_root_three(
    kind: tuple[str, bool],
) -> None:
    """This holds in confined compression, uniaxial stress and hydrostatic compression."""
    law, h = SaintVenantKirchhoff(500.0, 0.4), 1e-4

    def side(alpha: float) -> float:
        return float(np.sqrt(1 - law.poisson * (alpha**2 - 1)))

    ways: tuple[Callable[[float], list[float]], ...] = (
        lambda a: [a, 1, 1],
        lambda a: [a, side(a), side(a)],
        lambda a: [a, a, a],
    )
    for way in ways:
        below, at, above = (
            homogeneous(np.diag(way(1 / np.sqrt(3) + s)), law, *kind)[0][0, 0] for s in (-h, 0.0, h)
        )
        assert (above - below) / (2 * h) == pytest.approx(0.0, abs=1e-5 * abs(at))
        assert above > at < below
    assert homogeneous(np.diag([1 / np.sqrt(3), 1, 1]), law, *kind)[0][0, 0] == pytest.approx(
        -206.19652, abs=1e-5
    )


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_the_derivative_of_the_force_is_symmetric(law: str, kind: tuple[str, bool]) -> None:
    """Reciprocity follows from forces alone; the tangent's matrix is symmetric too."""
    mesh = warped(kind[0])
    model = free_assembler(mesh, LAWS[law], kind[1])
    rng = np.random.default_rng(0)
    stretched = mesh.points * (0.4, 0.0, -0.2)  # far from the kink where fibres become slack
    closer = 0.25 if "quadratic" in kind[0] else 1.0  # as their nodes are
    u, one, other = (
        stretched.ravel() + closer * 0.02 * rng.normal(size=model.n_dofs),
        rng.normal(size=model.n_dofs),
        rng.normal(size=model.n_dofs),
    )

    def slope(direction: Array, h: float = closer * 5e-4) -> Array:
        force = [model.force(u + k * h * direction).force for k in (-2, -1, 1, 2)]
        return np.asarray((force[0] - 8 * force[1] + 8 * force[2] - force[3]) / (12 * h))

    stiffness = dense(model, model.force_and_tangent(u)[1])
    size = np.linalg.norm(stiffness, 2) * np.linalg.norm(one) * np.linalg.norm(other)
    assert abs(one @ slope(other) - other @ slope(one)) <= 1e-9 * size
    assert abs(one @ slope(other) - one @ stiffness @ other) <= 1e-9 * size
    assert np.abs(stiffness - stiffness.T).max() <= 1e-14 * np.abs(stiffness).max()


@pytest.mark.parametrize("law", ISOTROPIC)
def test_every_law_is_hookes_at_small_strains(law: str) -> None:
    """At rest the tangent is that of linear elasticity with the law's Poisson ratio."""
    material = LAWS[law]
    tension = 1e-6
    stretch = np.diag(
        [
            1 + tension,
            1 - material.poisson_at_rest * tension,
            1 - material.poisson_at_rest * tension,
        ]
    )
    p, _ = homogeneous(stretch, material, "hexahedron", False)
    assert abs(p[1, 1]) <= 1e-4 * p[0, 0]
    assert material.poisson_at_rest == pytest.approx(
        {"mooney-rivlin": 0.39535, "yeoh": 0.39535, "ogden": 0.42744}.get(law, 0.4), abs=1e-4
    )


def test_the_vectorised_kernel_is_the_general_one() -> None:
    class Renamed(NeoHookean):
        """Saint Venant-Kirchhoff under another class, so that the general kernel evaluates it."""

        law = 0

    mesh = warped("hexahedron", (3, 2, 2))
    u = 0.03 * np.random.default_rng(0).normal(size=mesh.n_dofs)
    for selective in (False, True):
        (fast, k), (slow, l) = (
            free_assembler(mesh, law, selective).force_and_tangent(u)
            for law in (SaintVenantKirchhoff(500.0, 0.4), Renamed(500.0, 0.4))
        )
        np.testing.assert_allclose(
            fast.force, slow.force, atol=1e-12 * np.abs(slow.force).max() * 10
        )
        np.testing.assert_allclose(k, l, atol=1e-13 * np.abs(l).max() * 10)
        assert fast.energy_j == pytest.approx(slow.energy_j, rel=1e-13)
        assert fast.min_det_f == pytest.approx(slow.min_det_f, rel=1e-13)


def slow_unless(quick: Callable[..., bool], cases: Iterable[Any]) -> list[Any]:
    """Mark every third case as slow and the others as nightly, except those for quick feedback."""
    late = (pytest.mark.slow, pytest.mark.nightly, pytest.mark.nightly)
    return [
        pytest.param(*case, marks=() if quick(*case) else late[n % 3])
        for n, case in enumerate(cases)
    ]


@pytest.mark.parametrize(
    ("law", "kind"),
    slow_unless(
        lambda law, kind: law == "neo-hookean" and not kind[1],
        [c for c in EVERY if c[1][0] != "tetrahedron" or c[0] == "saint-venant-kirchhoff"],
    ),
)
def test_manufactured_solution_converges_at_the_right_order(
    law: str, kind: tuple[str, bool]
) -> None:
    """T4 needs finer meshes: its L2 order is 1.95 from 14 to 20 cells."""
    material = COMPRESSIBLE[law]
    n = {"hexahedron": (6, 12), "tetrahedron": (16, 20)}.get(kind[0], (4, 8))
    coarse, fine = (manufactured_error(cells, *kind, material) for cells in n)
    order = np.log(np.divide(coarse, fine)) / np.log(n[1] / n[0])
    degree = 2 if "quadratic" in kind[0] else 1
    assert order[0] >= degree + 1 - 0.05 * degree
    assert order[1] >= degree - 0.05 * degree


@pytest.fixture(scope="module")
def slender() -> FullOrderModel:
    return cantilever([20.0, 1.0, 1.0], [160, 1, 8], 0.0)


ELASTICA = {0.25: (0.082746, 0.004118), 1.0: (0.301721, 0.056433), 10.0: (0.810609, 0.554996)}


@pytest.mark.parametrize(
    "load", slow_unless(lambda load: load == 1.0, [(load,) for load in ELASTICA])
)
def test_slender_beams_follow_the_elastica(slender: FullOrderModel, load: float) -> None:
    """Bisshopp and Drucker 1945: deflections of a cantilever over its length, by PL²/EI."""
    deflection = tip(slender, -load * 1000.0 / 20.0**2) / 20.0
    down, back = ELASTICA[load]
    assert -deflection[2] == pytest.approx(down, rel=0.02)
    assert -deflection[0] == pytest.approx(back, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "kind"), quick_first(itertools.product(ISOTROPIC, ELEMENTS[:2])))
def test_every_law_follows_the_elastica(law: str, kind: tuple[str, bool]) -> None:
    """Strains of a slender beam are small, so PL²/EI = 1 bends all laws alike."""
    model = cantilever([20.0, 1.0, 1.0], [160, 1, 6], 0.0, "selective" if kind[1] else "full", law)
    deflection = tip(model, -1000.0 / 20.0**2) / 20.0
    assert -deflection[2] == pytest.approx(ELASTICA[1.0][0], rel=0.02)
    assert -deflection[0] == pytest.approx(ELASTICA[1.0][1], rel=0.02)


@pytest.mark.filterwarnings("ignore::mor_bench.errors.LockingWarning")
@pytest.mark.parametrize(
    ("poisson", "law"),
    slow_unless(
        lambda poisson, law: poisson == 0.499 and law == "saint-venant-kirchhoff",
        itertools.product([0.48, 0.499, 0.4999], LAWS),
    ),
)
def test_selective_integration_cures_volumetric_locking(poisson: float, law: str) -> None:
    """As ν → 1/2 a short cantilever stiffens without bound only with full integration."""
    size, cells = [4.0, 1.0, 1.0], [12, 3, 3]
    reference = tip(cantilever(size, cells, 0.3, law=law), -50.0)[2]
    full = tip(cantilever(size, cells, poisson, law=law), -50.0)[2]
    selective = tip(cantilever(size, cells, poisson, "selective", law), -50.0)[2]
    assert selective / reference == pytest.approx(1.0, abs=0.08)
    if poisson >= 0.499:
        assert full / reference < 0.75


def test_slender_beam_of_hundred_to_one_locks_with_long_cells_only() -> None:
    """PL²/EI = 0.6 has the exact w/L = 0.19235."""
    length, deflections = 100.0, []
    for n_cells in (200, 800):
        beam = cantilever([length, 1.0, 1.0], [n_cells, 1, 2], 0.0)
        deflections.append(-tip(beam, -0.6 * 1000.0 / length**2)[2] / length)
    assert 0.5 * 0.19235 < deflections[0] < 0.19235
    assert deflections[1] == pytest.approx(0.19235, rel=0.03)


@pytest.mark.parametrize(
    ("law", "kind"),
    slow_unless(lambda law, kind: law == "saint-venant-kirchhoff", EVERY),
)
def test_huge_loads_end_in_a_valid_answer_or_a_typed_error(
    law: str, kind: tuple[str, bool]
) -> None:
    scene = scene_of(law, kind)
    model = FullOrderModel(scene)
    weights = scene.patch_weights.toarray()[-1][:, None]
    solved = 0
    for size, axis in itertools.product((1.0, 20.0), range(3)):
        load = (weights * -size * np.eye(3)[axis]).ravel()[scene.free_dofs]
        try:
            solution = model.solve(load)
        except SolverError:
            continue
        solved += 1
        state = model.force(solution.displacement)
        assert state.min_det_f > 0
        assert np.linalg.norm(load - state.force) <= 1e-8 * np.linalg.norm(load)
    assert solved >= 3


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (
            [[0, 1, 2, 3, 4]],
            r"\(n_cells, 8\) for H8, .* or \(n_cells, 10\) for T10; got \(1, 5\)",
        ),
        ([[0, 2, 1, 4]], r"cell 0 is inverted or degenerate"),
        ([[0, 1, 2, 3]], r"cell 0 is inverted or degenerate"),
        ([[0, 1, 1, 4]], r"cell 0 is inverted or degenerate"),
    ],
)
def test_impossible_cells_are_refused(cells: list[list[int]], message: str) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
    with pytest.raises(InvalidInputError, match=message):
        free_assembler(Mesh(points, np.array(cells)))
