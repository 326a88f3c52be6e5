"""Modal derivatives, the quadratic manifold, static correction and local bases: their laws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction import derivative_modes as derivatives_module
from mor_bench.reduction.derivative_modes import (
    derivative_basis,
    linear_modes,
    modal_derivatives,
    pairs,
)
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.manifold import ManifoldProblem, QuadraticManifold
from mor_bench.reduction.tensors import polynomial_pays
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.local_pod import LocalPOD
from mor_bench.surrogates.quadratic_manifold import QuadraticManifoldGalerkin
from mor_bench.training_options import TrainingOptions
from tests.relative_errors import median_error, relative_l2

LAWS: dict[str, dict[str, Any]] = {
    "saint-venant-kirchhoff": {"young_pa": 500.0, "poisson": 0.4},
    "neo-hookean": {"young_pa": 500.0, "poisson": 0.4},
    "mooney-rivlin": {"c10_pa": 60.0, "c01_pa": 30.0, "bulk_pa": 800.0},
}
NO_SNAPSHOTS: list[tuple[str, dict[str, Any]]] = [
    ("modal-derivatives", {"n_linear": 5, "n_modes": 20}),
    ("quadratic-manifold", {"n_modes": 4}),
]


def tiny_of(law: str) -> Scene:
    content = load_generated_spec("beam-tiny").model_dump(mode="json")
    content["material"] = {"law": law, **LAWS[law]}
    return mor_bench.load_scene(content)


@pytest.mark.parametrize("law", LAWS)
def test_modal_derivatives_follow_from_the_derivative_of_the_tangent(law: str) -> None:
    """K₀ ψᵢⱼ = -(∂K/∂qⱼ) φᵢ, by the central difference of the assembled tangent along a mode."""
    scene = tiny_of(law)
    model = FullOrderModel(scene)
    modes = linear_modes(scene, model, 3).modes
    found = modal_derivatives(model, modes)
    pattern = model.assembler.pattern

    def times(values: np.ndarray, vector: np.ndarray) -> np.ndarray:
        upper = np.zeros((pattern.n, pattern.n))
        upper[pattern.rows, pattern.indices] = values
        return np.asarray((upper + upper.T - np.diag(np.diag(upper))) @ vector)

    h = 1e-4
    for column, (i, j) in enumerate(zip(*pairs(3), strict=True)):
        difference = (
            model.linearise(h * modes[:, j])[1] - model.linearise(-h * modes[:, j])[1]
        ) / (2 * h)
        expected = -model.rest_factor.solve(times(difference, modes[:, i]))
        np.testing.assert_allclose(
            found[:, column], expected, rtol=0, atol=1e-4 * np.abs(expected).max()
        )


def test_differences_of_a_cubic_force_are_exact_for_any_step(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = FullOrderModel(tiny.scene)
    modes = linear_modes(tiny.scene, model, 3).modes
    small = modal_derivatives(model, modes)
    monkeypatch.setattr(derivatives_module, "DIFFERENCE", 1.0)
    np.testing.assert_allclose(
        small, modal_derivatives(model, modes), rtol=0, atol=1e-8 * np.abs(small).max()
    )


def test_the_basis_is_orthonormal_and_holds_modes_and_derivatives(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    basis = derivative_basis(tiny.scene, model, 3, 60)
    assert np.linalg.norm(basis.T @ basis - np.eye(basis.shape[1])) <= 1e-12
    modes = linear_modes(tiny.scene, model, 3).modes
    for held in (modes, modal_derivatives(model, modes)):
        assert np.linalg.norm(held - basis @ (basis.T @ held)) <= 1e-6 * np.linalg.norm(held)


@pytest.mark.parametrize("law", ["saint-venant-kirchhoff", "neo-hookean"])
def test_force_and_tangent_on_the_manifold_are_derivatives_of_its_energy(law: str) -> None:
    scene = tiny_of(law)
    model = FullOrderModel(scene)
    linear = linear_modes(scene, model, 4)
    manifold = QuadraticManifold(linear.modes, modal_derivatives(model, linear.modes))
    rng = np.random.default_rng(0)
    problem = ManifoldProblem(
        GalerkinProblem(model.assembler, linear.modes),
        manifold,
        manifold.curvature(1e-3 * rng.normal(size=model.n_unknowns)),
    )
    q, direction = (
        0.5 * linear.amplitudes_m * rng.normal(size=4),
        linear.amplitudes_m * rng.normal(size=4),
    )
    state, tangent = problem.linearise(q)
    np.testing.assert_allclose(state.force, problem.force(q).force, rtol=1e-10, atol=1e-14)
    h = 1e-4
    there, back = problem.force(q + h * direction), problem.force(q - h * direction)
    assert (there.energy_j - back.energy_j) / (2 * h) == pytest.approx(
        state.force @ direction, rel=1e-6
    )
    expected = (there.force - back.force) / (2 * h)
    np.testing.assert_allclose(
        tangent @ direction, expected, rtol=0, atol=1e-6 * np.abs(expected).max()
    )


@pytest.mark.parametrize(
    ("name", "knobs"), [*NO_SNAPSHOTS, ("local-pod", {"n_clusters": 3, "n_modes": 4})]
)
def test_small_loads_get_the_linear_response(
    name: str, knobs: dict[str, Any], tiny: Dataset
) -> None:
    """Under a load unknown to the basis, the error falls with the square of the load."""
    method = mor_bench.load_method(name, **knobs).fit(
        tiny.scene, tiny.train if name == "local-pod" else None
    )
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    force = np.zeros((tiny.scene.mesh.n_nodes, 3))
    force[-1] = [0.3, -0.2, 0.1]
    for size in (1e-3, 1e-5):
        expected = linear.predict(size * force)
        assert (
            np.abs(method.predict(size * force) - expected).max()
            <= 3 * size * np.abs(expected).max()
        )


def test_the_quadratic_manifold_is_exact_to_second_order(tiny: Dataset) -> None:
    """If Φ contains the linear response, the error is cubic in the load; on Φ alone quadratic."""
    model = FullOrderModel(tiny.scene)
    modes = linear_modes(tiny.scene, model, 3).modes
    linear = GalerkinProblem(model.assembler, modes)
    flat = QuadraticManifold(modes, np.zeros((len(modes), 6)))
    bent = QuadraticManifold(modes, modal_derivatives(model, modes))
    stretched = model.force(1e-6 * modes[:, 0]).force / 1e-6
    options = NewtonOptions(1e-12)
    errors: dict[str, list[float]] = {"flat": [], "bent": []}
    for size in (2e-2, 1e-2):
        exact = model.solve(size * stretched, options=options).displacement
        for name, manifold in (("flat", flat), ("bent", bent)):
            problem = ManifoldProblem(linear, manifold, manifold.curvature(size * stretched))
            q = solve_equilibrium(problem, size * modes.T @ stretched, options=options).displacement
            errors[name].append(float(np.linalg.norm(manifold.at(q)[0] - exact)))
    assert 3.7 <= errors["flat"][0] / errors["flat"][1] <= 4.3
    assert 7.0 <= errors["bent"][0] / errors["bent"][1] <= 9.0


@pytest.mark.parametrize(("name", "knobs"), NO_SNAPSHOTS)
@pytest.mark.parametrize("law", LAWS)
def test_bases_without_snapshots_beat_linear_elasticity_for_every_law(
    name: str, knobs: dict[str, Any], law: str
) -> None:
    scene = tiny_of(law)
    loads = draw_loads(scene, 0, 21)
    forces = loads.nodal_forces(scene.patch_weights)
    exact = mor_bench.load_method("fem", tolerance=1e-8).fit(scene, None).predict(forces)
    errors = {
        method: relative_l2(
            mor_bench.load_method(method, **its).fit(scene, None).predict(forces), exact
        )
        for method, its in ((name, knobs), ("linear-fem", {}))
    }
    assert np.median(errors[name]) <= 0.3 * np.median(errors["linear-fem"])
    assert errors[name].max() <= errors["linear-fem"].max()


@pytest.mark.parametrize("change", [{"integration": "selective"}, {"element": "tetrahedron"}])
@pytest.mark.parametrize(("name", "knobs"), NO_SNAPSHOTS)
def test_nonlinear_bases_work_with_other_elements_and_integration(
    name: str, knobs: dict[str, Any], change: dict[str, str]
) -> None:
    content = load_generated_spec("beam-tiny").model_dump(mode="json")
    content["discretisation"] = {**content["discretisation"], **change}
    scene = mor_bench.load_scene(content)
    forces = draw_loads(scene, 0, 10).nodal_forces(scene.patch_weights)
    exact = mor_bench.load_method("fem", tolerance=1e-8).fit(scene, None).predict(forces)
    found = mor_bench.load_method(name, **knobs).fit(scene, None).predict(forces)
    assert np.median(relative_l2(found, exact)) <= 0.01


def test_a_load_uses_the_basis_of_its_direction(tiny: Dataset) -> None:
    """Scaling a load changes no cluster, and there are no more clusters than directions."""
    method = LocalPOD(n_clusters=4, n_modes=3).fit(tiny.scene, tiny.train)
    assert len(method.problems_) == 4
    loads = tiny.test.forces[:8].reshape(8, -1)[:, tiny.scene.free_dofs]
    asked = [method.nearest(load) for load in loads]
    assert asked == [method.nearest(0.01 * load) for load in loads]
    assert len(set(asked)) > 1
    first, other = (asked.index(number) for number in sorted(set(asked))[:2])
    before = method.predict(tiny.test.forces[[first, other]])
    method.problems_[asked[first]], method.bases_[asked[first]] = (
        method.problems_[asked[other]],
        method.bases_[asked[other]],
    )
    after = method.predict(tiny.test.forces[[first, other]])
    assert (after[0] != before[0]).any()
    assert (after[1] == before[1]).all()
    assert len(LocalPOD(n_clusters=500, n_modes=1).fit(tiny.scene, tiny.train[:6]).problems_) == 6


def test_local_pod_with_one_cluster_and_all_modes_reproduces_its_snapshots(
    tiny: Dataset,
) -> None:
    method = LocalPOD(n_clusters=1, n_modes=10_000)
    with pytest.warns(UserWarning, match="rank"):
        method.fit(tiny.scene, tiny.train[:30])
    found = method.predict(tiny.train.forces[:30])
    np.testing.assert_allclose(
        found, tiny.train.displacements[:30], rtol=0, atol=1e-6 * np.abs(found).max()
    )


@pytest.mark.slow
def test_clusters_of_similar_loads_do_better_than_one_basis(coarse: Dataset) -> None:
    """This holds for five modes; with twenty, clusters gain little (see the method's limits)."""
    one, many = (
        median_error(LocalPOD(n, 5, 1e-4).fit(coarse.scene, coarse.train), coarse.test)
        for n in (1, 16)
    )
    assert many < 0.85 * one


@pytest.mark.slow
def test_the_cubature_of_the_manifold_keeps_few_cells_and_the_predictions() -> None:
    """Small loads get the linear response even at a loose tolerance."""
    scene = mor_bench.load_scene("beam-coarse")
    forces = draw_loads(scene, 0, 30).nodal_forces(scene.patch_weights)
    whole = mor_bench.load_method("quadratic-manifold", n_modes=4, cubature_tolerance=0.0).fit(
        scene, None
    )
    sampled = QuadraticManifoldGalerkin(4, 1e-3, 1e-4).fit(scene, None)
    assert len(sampled.cells_) < 0.3 * scene.mesh.n_cells
    assert (sampled.weights_ > 0).all()
    expected, found = whole.predict(forces), sampled.predict(forces)
    assert np.median(relative_l2(found, expected)) <= 1e-3
    loose = QuadraticManifoldGalerkin(4, 0.1, 1e-8).fit(scene, None)
    assert len(loose.cells_) < len(sampled.cells_)
    linear = mor_bench.load_method("linear-fem").fit(scene, None).predict(1e-5 * forces)
    np.testing.assert_allclose(
        loose.predict(1e-5 * forces), linear, rtol=0, atol=1e-4 * np.abs(linear).max()
    )


@pytest.mark.slow
def test_the_autoencoder_learns_the_difference_from_linear_elasticity(coarse: Dataset) -> None:
    pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    medians = {}
    for name, knobs in (("linear-fem", {}), ("autoencoder", {"n_latent": 10, "iterations": 1000})):
        method = mor_bench.load_method(name, **knobs).fit(coarse.scene, coarse.train)
        medians[name] = median_error(method, coarse.test)
        assert not method.predict(np.zeros((coarse.scene.mesh.n_nodes, 3))).any()
    assert medians["autoencoder"] <= 0.7 * medians["linear-fem"]


@pytest.mark.parametrize("spoil", ["nan", "columns", "integers"])
def test_modes_of_a_damaged_model_are_refused(spoil: str, tiny: Dataset) -> None:
    method = mor_bench.load_method("modal-derivatives", n_linear=3, n_modes=6).fit(tiny.scene, None)
    state = dict(method.arrays_)
    modes = state["modes"]
    state["modes"] = {
        "nan": modes * np.nan,
        "columns": modes[:, 1:],
        "integers": modes.astype(np.int64),
    }[spoil]
    with pytest.raises(InvalidInputError):
        method.restore(method.scene_, state)


def test_the_polynomial_is_used_where_it_pays(tiny: Dataset) -> None:
    coarse, fine = (
        FullOrderModel(mor_bench.load_scene(name)) for name in ("beam-coarse", "beam-fine")
    )
    assert polynomial_pays(coarse, 40)
    assert not polynomial_pays(coarse, 60)
    assert polynomial_pays(fine, 80)
    assert not polynomial_pays(fine, 80, 32)
    assert not polynomial_pays(FullOrderModel(tiny_of("neo-hookean")), 4)


@pytest.mark.slow
def test_the_autoencoder_refuses_to_start_from_a_saved_model(tiny: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    method = mor_bench.load_method("autoencoder", iterations=2).fit(tiny.scene, tiny.train)
    method.save(tmp_path / "model.safetensors")
    method.training = TrainingOptions(start_from=tmp_path / "model.safetensors")
    with pytest.raises(InvalidInputError, match=r"`start_from`: .* lacks the encoder"):
        method.fit(tiny.scene, tiny.train)


@pytest.mark.slow
def test_the_autoencoder_gives_exactly_zero_displacement_for_a_zero_load_in_a_batch(
    tiny: Dataset,
) -> None:
    method = mor_bench.load_method("autoencoder", iterations=20).fit(tiny.scene, tiny.train)
    forces = tiny.test.forces[:5].copy()
    forces[[0, 3]] = 0.0
    found = method.predict(forces)
    assert (found[[0, 3]] == 0).all()
    assert found[1].any()
