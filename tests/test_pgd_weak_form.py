"""PGD from the weak form: its grids, the equations that it solves, and what it converges to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, OutOfTimeError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.method_loading import load_fitted
from mor_bench.reduction.alternating_directions import decompose, rank_one
from mor_bench.reduction.load_grid import interval_rule, load_grid, sphere_rule
from mor_bench.reduction.weak_form import Family, Term, WeakForm
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.monomials import by_degree, monomial_indices
from mor_bench.surrogates.pgd import SeparatedLoad
from mor_bench.surrogates.pgd_weak_form import WeakFormPGD
from tests.relative_errors import median_error, relative_l2

Array = NDArray[np.float64]

PRESSURE = {"kind": "pressure", "regions": ["z-max"], "magnitude_pa": [0.0, 1.0], "samples": 4}


def scene_of(**changes: Any) -> Scene:
    """Return beam-tiny with other keys in its tables."""
    content = load_generated_spec("beam-tiny").model_dump(mode="json")
    for table, keys in changes.items():
        content[table] = {**content[table], **keys}
    return mor_bench.load_scene(content)


@pytest.fixture(scope="module")
def few() -> Scene:
    """Two patches."""
    return scene_of(loads={"n_patches": 2})


def weak_of(scene: Scene, linear: bool = True) -> WeakForm:
    """Return the weak form with terms of degrees two and three, and one if there is no base."""
    grid = load_grid(scene, 4, 3)
    directions = by_degree(grid.directions, monomial_indices(3, 3))
    sizes = (grid.magnitudes / grid.magnitudes[-1])[:, None]
    degrees = (2, 3) if linear else (1, 2, 3)
    families = [Family(directions[j], sizes ** np.arange(j, 4, 2)) for j in degrees]
    return WeakForm(FullOrderModel(scene), grid, families, linear)


def some_terms(weak: WeakForm, n: int) -> tuple[Array, Array, Array]:
    """Return random X of a hundredth of the body, P, and coefficients of D M."""
    generator = np.random.default_rng(0)
    vectors = 0.01 * generator.normal(size=(n, weak.n_free))
    positions = generator.normal(size=(n, weak.n_patches))
    terms = []
    for k in range(n):
        family = weak.families[k % len(weak.families)]
        sizes = (family.directions.shape[1],), (family.powers.shape[1],)
        direction, power = (generator.normal(size=size) for size in sizes)
        terms.append(Term(k % len(weak.families), positions[k], direction, power))
    return vectors, positions, np.stack([weak.coefficients(term) for term in terms])


def test_the_mean_over_directions_is_exact_for_polynomials() -> None:
    points, weights = sphere_rule(4)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0)
    x, y, z = points.T
    assert len(points) == 32
    # The mean of x^a y^b z^c, all even, is (a-1)!! (b-1)!! (c-1)!! / (a+b+c+1)!!.
    for value, mean in (
        (np.ones(32), 1.0),
        (x**2, 1 / 3),
        (z**6, 1 / 7),
        (x**2 * y**2 * z**2, 1 / 105),
        (x**4 * y**2, 3 / 105),
        (x**3 * y**3 * z, 0.0),
        (z**7, 0.0),
    ):
        assert weights @ value == pytest.approx(mean, abs=1e-14)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_mean_over_magnitudes_is_exact_and_includes_the_largest(n: int) -> None:
    points, weights = interval_rule(n)
    assert (points > 0).all()
    assert points[-1] == 1.0
    assert (weights > 0).all()
    for degree in range(2 * n - 1):
        assert weights @ points**degree == pytest.approx(1 / (degree + 1), abs=1e-13)
    assert weights @ points ** (2 * n - 1) != pytest.approx(1 / (2 * n), abs=1e-6)


def test_every_load_of_the_grid_is_a_load_of_the_scene(few: Scene) -> None:
    grid = load_grid(few, 3, 2)
    assert grid.weights.sum() == pytest.approx(1.0)
    assert np.linalg.norm(grid.vectors, axis=1).max() == few.generated.load_plan.magnitude[1]
    weights = few.patch_weights.toarray()
    for patch in range(2):
        nodal = weights[patch][:, None] * grid.vectors[7]
        expected = few.at_free_dofs(nodal.reshape(1, -1))[0]
        np.testing.assert_allclose(grid.vectors[7] @ grid.forces[patch], expected, atol=1e-14)


def test_without_terms_the_linear_response_has_half_the_energy_of_its_work() -> None:
    """Under tiny loads the body is linear, and every load has the same weight."""
    weak = weak_of(scene_of(loads={"n_patches": 2, "magnitude_n": [0.0, 1e-6]}))
    balance = weak.balance(*(array[:0] for array in some_terms(weak, 1)))
    assert balance.energy == pytest.approx(-0.5, rel=1e-5)
    assert balance.relative < 1e-5


def test_the_residuals_are_the_derivative_of_the_energy(few: Scene) -> None:
    """Along X, P, and the coefficients of D M; central differences of a polynomial."""
    weak = weak_of(few)
    terms = some_terms(weak, 3)
    residuals = weak.balance(*terms).residuals
    vectors, positions, coefficients = terms
    products = positions[:, :, None] * coefficients[:, None, :]
    generator = np.random.default_rng(1)
    changes = [0.01 * generator.normal(size=array.shape) for array in terms]
    slopes = (
        -np.einsum("kpi,pin,kn->", products, residuals, changes[0]),
        -np.einsum("kp,ki,pin,kn->", changes[1], coefficients, residuals, vectors),
        -np.einsum("kp,ki,pin,kn->", positions, changes[2], residuals, vectors),
    )
    for which, slope in enumerate(slopes):
        ends = []
        for sign in (-1.0, 1.0):
            moved = list(terms)
            moved[which] = terms[which] + sign * 1e-3 * changes[which]
            ends.append(weak.balance(*moved).energy)
        assert (ends[1] - ends[0]) / 2e-3 == pytest.approx(slope, rel=1e-5)


def test_alternating_directions_find_a_residual_of_one_term() -> None:
    """R = K₀X ω P D M on the grid; the gain is half the squared norm of X P D M."""
    weak = weak_of(scene_of(loads={"n_patches": 5}))
    generator = np.random.default_rng(2)
    force = generator.normal(size=(weak.n_free,))
    x = weak.respond(force[None])[0]
    position, direction = generator.normal(size=(5,)), generator.normal(size=(10,))
    true = Term(1, position, direction, np.ones(1))
    product = np.outer(true.position, weak.coefficients(true))
    pushed = np.einsum("pij,pj->pi", weak.gram, product)
    found = rank_one(weak, pushed[:, :, None] * force, 1)
    assert found is not None
    term, gain = found
    again = np.outer(term.position, weak.coefficients(term))
    cosine = np.sum(product * again) / np.linalg.norm(product) / np.linalg.norm(again)
    assert abs(cosine) == pytest.approx(1.0, abs=1e-6)
    norm = np.einsum("pi,pij,pj->", product, weak.gram, product)
    assert gain == pytest.approx(0.5 * norm * (x @ force), rel=1e-6)


def test_the_energy_falls_with_every_update_and_ends_in_balance(few: Scene) -> None:
    weak = weak_of(few)
    found = decompose(weak, 8, 1e-9)
    n_terms, energy, relative = found.history.T
    assert n_terms[-1] == len(found.terms) == 8
    assert (np.diff(n_terms) >= 0).all()
    assert (np.diff(energy)[:10] < 0).all()
    assert (np.diff(energy) <= 0).all()
    assert relative[-1] < 0.3 * relative[0]
    positions = np.stack([term.position for term in found.terms])
    coefficients = np.stack([weak.coefficients(term) for term in found.terms])
    balance = weak.balance(found.vectors, positions, coefficients)
    assert balance.energy == pytest.approx(energy[-1], rel=1e-12)
    forces = np.einsum("kp,ki,pin->kn", positions, coefficients, balance.residuals)
    start = weak.balance(0 * found.vectors, positions, coefficients)
    before = np.einsum("kp,ki,pin->kn", positions, coefficients, start.residuals)
    assert np.linalg.norm(forces) < 1e-5 * np.linalg.norm(before)


def test_tiny_loads_get_the_linear_response_as_terms_are_added() -> None:
    """Without a base, terms of degree one must reproduce it."""
    scene = scene_of(loads={"magnitude_n": [0.0, 1e-4], "n_patches": 6})
    linear = mor_bench.load_method("linear-fem").fit(scene, None)
    generator = np.random.default_rng(0)
    weights = scene.patch_weights.toarray()
    forces = weights[:, :, None] * generator.normal(size=(6, 1, 3)) * 1e-5
    errors = []
    for n_terms in (3, 8, 18):
        method = WeakFormPGD("none", n_terms, force_degree=2, tolerance=1e-7).fit(scene)
        errors.append(relative_l2(method.predict(forces), linear.predict(forces)).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[-1] <= 1e-3
    base = WeakFormPGD(n_terms=1, force_degree=2).fit(scene)
    assert relative_l2(base.predict(forces), linear.predict(forces)).max() <= 1e-4


def test_more_terms_and_degrees_converge_to_the_full_order_model(few: Scene) -> None:
    """On one patch, for loads that are not in the grid."""
    model = FullOrderModel(few)
    generator = np.random.default_rng(3)
    directions = generator.normal(size=(12, 3))
    vectors = 3.0 * directions / np.linalg.norm(directions, axis=1)[:, None]
    weights = few.patch_weights.toarray()
    forces = weights[np.arange(12) % 2, :, None] * vectors[:, None]
    loads = few.at_free_dofs(forces.reshape(12, -1))
    exact = np.stack([model.solve(f, options=NewtonOptions(1e-10)).displacement for f in loads])
    exact = few.at_all_dofs(exact).reshape(forces.shape)
    linear = mor_bench.load_method("linear-fem").fit(few, None)
    errors = [float(np.median(relative_l2(linear.predict(forces), exact)))]
    for n_terms, degree in ((3, 3), (12, 3), (40, 4)):
        method = WeakFormPGD(n_terms=n_terms, force_degree=degree).fit(few)
        errors.append(float(np.median(relative_l2(method.predict(forces), exact))))
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 0.03 * errors[0]


def test_the_error_falls_with_the_terms_on_every_patch(tiny: Dataset) -> None:
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    errors = [median_error(linear, tiny.test)]
    for n_terms in (4, 20):
        method = WeakFormPGD(n_terms=n_terms, n_magnitudes=2, tolerance=1e-3).fit(tiny.scene)
        errors.append(median_error(method, tiny.test))
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 0.45 * errors[0]


def test_a_load_elsewhere_gets_the_terms_of_the_nearest_patch(few: Scene) -> None:
    method = WeakFormPGD(n_terms=3, force_degree=2).fit(few)
    linear = mor_bench.load_method("linear-fem").fit(few, None)
    centroids = method.centroids_
    points, force = few.mesh.points, np.array([0.3, -0.2, 2.0])
    free = np.setdiff1d(np.arange(len(points)), few.fixed_nodes)
    node = free[np.linalg.norm(points[free] - centroids[1], axis=1).argmin()]
    assert np.linalg.norm(points[node] - centroids[1]) < np.linalg.norm(points[node] - centroids[0])
    elsewhere, on_patch = np.zeros((2, *points.shape))
    elsewhere[node] = force
    on_patch[:] = few.patch_weights.toarray()[1][:, None] * force
    added = [method.predict(f) - linear.predict(f) for f in (elsewhere, on_patch)]
    np.testing.assert_allclose(added[0], added[1], atol=1e-12)
    assert np.abs(added[0]).max() > 1e-3 * np.abs(linear.predict(elsewhere)).max()


def test_other_scenes_are_refused_with_the_reason() -> None:
    several = mor_bench.load_scene("beam-coarse-3-forces")
    assert (
        WeakFormPGD().supports(several) == "it handles one load patch, and here several act at once"
    )
    rubber = scene_of(material={"law": "neo-hookean"})
    assert str(WeakFormPGD().supports(rubber)).endswith("this law is neo-hookean")
    with pytest.raises(UnsupportedSceneError, match="this law is neo-hookean"):
        WeakFormPGD().fit(rubber)
    content = load_generated_spec("beam-tiny").model_dump(mode="json", exclude={"loads", "tests"})
    bare = mor_bench.load_scene({**content, "loads": None})
    assert "no loads are given" in str(WeakFormPGD().supports(bare))
    pressed = mor_bench.load_scene({**content, "loads": PRESSURE, "split": {"by": "sample"}})
    for method in (WeakFormPGD(), SeparatedLoad()):
        assert "here pressures act" in str(method.supports(pressed))


def test_loads_beyond_those_of_the_grid_are_flagged(few: Scene, tmp_path: Path) -> None:
    """The grid has single loads on two patches, in all directions, up to the largest magnitude."""
    method = WeakFormPGD(n_terms=1).fit(few)
    method.save(tmp_path / "model.safetensors")
    weights, along = few.patch_weights.toarray(), np.array([0.6, 0.0, -0.8])
    one, other = weights[:, :, None] * along * method.largest_
    far = np.zeros_like(one)
    far[np.flatnonzero(~weights.any(axis=0))[-1]] = 0.1 * method.largest_ * along
    loads = np.stack([one, other, 0.0 * one, 1.1 * one, 0.5 * (one + other), far])
    wanted = [False, False, False, True, True, True]
    for found in (method, load_fitted(tmp_path / "model.safetensors", WeakFormPGD, few)):
        assert found.out_of_range(loads).tolist() == wanted


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_rings": 3}, "`n_rings` must be larger than `force_degree`, 3; got 3"),
        ({"force_degree": 5, "n_magnitudes": 1}, "`n_magnitudes` must be at least 2, .* got 1"),
    ],
)
def test_a_grid_that_cannot_tell_functions_apart_is_refused(
    few: Scene, parameters: dict[str, Any], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        WeakFormPGD(**parameters).fit(few)


def test_a_fit_that_would_take_too_long_is_refused_early(few: Scene) -> None:
    method = WeakFormPGD(n_terms=1_000_000)
    method.time_limit_s = 5.0
    with pytest.raises(OutOfTimeError, match=r"1000000 terms would take about \d+ s"):
        method.fit(few)
