"""Hyper-reduction: points, cubature and its optimality, interpolation, mesh independence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.counting import Cost, counted
from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.hard_cases.setups import LAW
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation, discretisation_of, quadrature_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction.galerkin import CubatureProblem, GalerkinProblem
from mor_bench.reduction.points import ReducedPoints
from mor_bench.reduction.subspace import extent_of
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.other_meshes import with_cells
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.surrogates.cubature_states import are_far, equilibria, in_energy, projected_states
from mor_bench.surrogates.deim import InterpolatedPOD
from mor_bench.surrogates.ecm import EmpiricalCubaturePOD
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.hyper_reduced import nodal, reduced_points
from mor_bench.surrogates.pod import PODGalerkin
from tests.verification.laws_and_elements import EVERY, quick_first
from tests.verification.scenes import scene_of, solved

Array = NDArray[np.float64]


def cubature_of(
    scene: Scene, cells: NDArray[np.int64], weights: Array, modes: Array
) -> CubatureProblem:
    return CubatureProblem(
        reduced_points(scene, cells, weights, nodal(scene, modes)), extent_of(scene)
    )


def whole_mesh(scene: Scene, weights: Array, modes: Array) -> GalerkinProblem:
    """Return the same model, assembled over the nodes; cells of weight zero add nothing."""
    number = np.full(scene.mesh.n_dofs, len(scene.free_dofs))
    number[scene.free_dofs] = np.arange(len(scene.free_dofs))
    dofs = number.reshape(-1, 3)
    return GalerkinProblem(
        Assembler(discretisation_of(scene), dofs, len(scene.free_dofs), weights),
        modes,
    )


@pytest.mark.parametrize(("law", "kind"), EVERY)
def test_sums_over_points_equal_the_assembled_force_and_tangent(
    law: str, kind: tuple[str, bool]
) -> None:
    scene = scene_of(law, kind)
    rng = np.random.default_rng(0)
    modes = np.linalg.qr(rng.normal(size=(len(scene.free_dofs), 7)))[0]
    cells = np.sort(rng.choice(scene.mesh.n_cells, 11, replace=False))
    weights = np.zeros(scene.mesh.n_cells)
    weights[cells] = rng.uniform(0.5, 9.0, 11)
    few, whole = cubature_of(scene, cells, weights[cells], modes), whole_mesh(scene, weights, modes)
    q = 0.1 * rng.normal(size=7)
    (state, tangent), (expected, stiffness) = few.linearise(q), whole.linearise(q)
    np.testing.assert_allclose(
        state.force, expected.force, rtol=0, atol=1e-12 * np.abs(expected.force).max()
    )
    np.testing.assert_allclose(
        few.force(q).force, state.force, rtol=0, atol=1e-13 * np.abs(expected.force).max()
    )
    np.testing.assert_allclose(tangent, stiffness, rtol=0, atol=1e-12 * np.abs(stiffness).max())
    assert state.energy_j == pytest.approx(expected.energy_j, rel=1e-12)
    shapes = quadrature_of(discretisation_of(scene, cells)).gradients
    u = (nodal(scene, modes) @ q)[scene.mesh.cells[cells]]
    assert state.min_det_f == pytest.approx(
        np.linalg.det(np.eye(3) + np.einsum("cai,cqaj->cqij", u, shapes)).min(), rel=1e-12
    )


@pytest.mark.parametrize(("law", "kind"), EVERY)
def test_the_check_for_inverted_cells_finds_the_det_f_of_the_force(
    law: str, kind: tuple[str, bool]
) -> None:
    model = FullOrderModel(scene_of(law, kind))
    direction = np.random.default_rng(1).normal(size=model.n_unknowns)
    for size in (0.0, 0.01, 1.0):
        least = model.force(size * direction).min_det_f
        assert model.assembler.least_det_f(size * direction) == pytest.approx(least, rel=1e-12)
    assert least < 0


@pytest.mark.slow
@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_hyper_reduction_works_for_every_law_and_element(law: str, kind: tuple[str, bool]) -> None:
    """With all cells it is plain POD; fewer cells predict the training loads nearly as well."""
    scene = scene_of(law, kind)
    train = solved(scene, 24)
    plain = PODGalerkin(5).fit(scene, train).predict(train.forces)
    size = np.abs(plain).max()
    assert (
        np.abs(HyperReducedPOD(5, 0.0).fit(scene, train).predict(train.forces) - plain).max()
        <= 1e-10 * size
    )
    assert (
        np.abs(EmpiricalCubaturePOD(5, 0.0).fit(scene, train).predict(train.forces) - plain).max()
        <= 1e-10 * size
    )
    few = HyperReducedPOD(5, 1e-3, sampling="cells").fit(scene, train)
    fewer = HyperReducedPOD(5, 1e-3, sampling="points").fit(scene, train)
    assert fewer.problem_.points.n_points < few.problem_.points.n_points or kind[0] == "tetrahedron"
    greedy = EmpiricalCubaturePOD(5, 1e-2).fit(scene, train)
    least = EmpiricalCubaturePOD(5, 5e-3, sampling="points").fit(scene, train)
    assert (
        least.problem_.points.n_points < greedy.problem_.points.n_points or kind[0] == "tetrahedron"
    )
    # Fibres carry load in tension alone: forces with such a kink take more modes.
    sampled = InterpolatedPOD(5, 16 if law == "holzapfel-gasser-ogden" else 8).fit(scene, train)
    for method in (few, fewer, greedy, least, sampled):
        assert len(method.cells_) < scene.mesh.n_cells
        assert np.abs(method.predict(train.forces) - plain).max() <= 0.03 * size


def test_empirical_cubature_of_points_keeps_few_points_of_few_cells(tiny: Dataset) -> None:
    cells, points = (
        EmpiricalCubaturePOD(8, 1e-2, sampling=kind).fit(tiny.scene, tiny.train)
        for kind in ("cells", "points")
    )
    assert points.problem_.points.n_points < 0.5 * cells.problem_.points.n_points
    forces = tiny.test.forces[:20]
    plain = PODGalerkin(8).fit(tiny.scene, tiny.train).predict(forces)
    for method in (cells, points):
        apart = np.linalg.norm(method.predict(forces) - plain, axis=(1, 2))
        assert np.median(apart / np.linalg.norm(plain, axis=(1, 2))) < 0.03


@pytest.mark.parametrize("scale", [0.01, 1.0, 3.0, 100.0])
def test_the_compiled_steps_end_where_the_shared_solve_ends(tiny: Dataset, scale: float) -> None:
    """If they fail, the shared solve takes over. So both refuse the same loads."""
    method = HyperReducedPOD(8, 1e-2).fit(tiny.scene, tiny.train)
    problem, options, failed = method.problem_, NewtonOptions(1e-8), 0
    for load in tiny.test.free_forces[:25] @ method.modes_ * scale:
        try:
            expected = solve_equilibrium(problem, load, options=options)
        except SolverError as error:
            failed += 1
            with pytest.raises(type(error)):
                problem.solve(load, options)
            continue
        found = problem.solve(load, options)
        np.testing.assert_allclose(
            found.displacement,
            expected.displacement,
            rtol=0,
            atol=1e-10 * np.abs(expected.displacement).max(),
        )
        assert found.iterations == expected.iterations or found.cuts == expected.cuts
        assert found.min_det_f > 0
    assert (failed > 0) == (scale == 100.0)


@pytest.mark.parametrize("sampling", ["dofs", "cell-dofs", "cells"])
def test_the_interpolated_tangent_is_the_derivative_of_the_force_and_exact_at_rest(
    tiny: Dataset, sampling: Any
) -> None:
    method = InterpolatedPOD(6, 12, sampling=sampling).fit(tiny.scene, tiny.train)
    model, modes = FullOrderModel(tiny.scene), method.modes_
    rng = np.random.default_rng(0)
    rest = method.problem_.linearise(np.zeros(6))[1]
    whole = GalerkinProblem(model.assembler, modes).rest_tangent
    np.testing.assert_allclose(rest, whole, atol=1e-12 * np.abs(whole).max())
    q, h = tiny.test.free_displacements[3] @ modes, 1e-6 * rng.normal(size=6)
    force, tangent, _ = method.problem_.linearise(q)
    difference = method.problem_.linearise(q + h)[0] - method.problem_.linearise(q - h)[0]
    np.testing.assert_allclose(2 * tangent @ h, difference, atol=1e-6 * np.abs(difference).max())
    assert np.abs(tangent - tangent.T).max() > 1e-6 * np.abs(tangent).max()
    stiff = np.array([modes.T @ model.force(modes @ q).force])
    assert np.linalg.norm(force - stiff) <= 0.02 * np.linalg.norm(stiff)


def test_unassembled_interpolation_is_exact_on_its_basis_and_integrates_fewer_cells(
    tiny: Dataset,
) -> None:
    """With as many force modes as snapshots, every training force is in their span."""
    train = tiny.train[:20]
    model = FullOrderModel(tiny.scene)
    for sampling in ("dofs", "cell-dofs", "cells"):
        method = InterpolatedPOD(4, 20, sampling=sampling).fit(tiny.scene, train)
        for q in train.free_displacements @ method.modes_:
            whole = method.modes_.T @ model.force(method.modes_ @ q).force
            own = method.problem_.linearise(q)[0]
            np.testing.assert_allclose(own, whole, atol=1e-7 * np.abs(whole).max())
    cells = {
        sampling: len(InterpolatedPOD(4, 5, sampling=sampling).fit(tiny.scene, train).cells_)
        for sampling in ("dofs", "cell-dofs", "cells")
    }
    assert cells["cell-dofs"] == cells["cells"] <= 5 < cells["dofs"]


@pytest.fixture(scope="module")
def stiff() -> tuple[Scene, Snapshots]:
    """A nearly incompressible body and some samples."""
    scene = scene_of("neo-hookean", ("hexahedron", True), 0.499)
    return scene, solved(scene, 40)


@pytest.mark.parametrize("method", [HyperReducedPOD, EmpiricalCubaturePOD])
def test_a_nearly_incompressible_body_needs_training_at_equilibria(
    stiff: tuple[Scene, Snapshots], method: Any
) -> None:
    """Projected snapshots change the volume of cells, and their forces are no guide."""
    scene, train = stiff
    plain = PODGalerkin(5).fit(scene, train).predict(train.forces)
    errors = {}
    for matching in ("force", "energy", "as-needed"):
        found = method(5, 1e-2, matching=matching).fit(scene, train).predict(train.forces)
        errors[matching] = float(np.linalg.norm(found - plain) / np.linalg.norm(plain))
    assert errors["energy"] == errors["as-needed"] < 0.05
    assert errors["force"] > 3 * errors["energy"]


def test_states_in_energy_coordinates_are_the_same_displacements(
    stiff: tuple[Scene, Snapshots],
) -> None:
    scene, train = stiff
    modes = PODGalerkin(5).fit(scene, train).modes_
    projected = projected_states(scene, train, modes, 40)
    loads = train.free_forces
    assert are_far(projected, loads, modes)
    ((model, q),) = equilibria(projected, loads, modes)()
    for own, load in zip(q, loads @ modes, strict=True):
        residual = modes.T @ model.force(modes @ own).force - load
        assert np.linalg.norm(residual) <= 1e-4 * np.linalg.norm(load)
    states, scaled = in_energy(lambda: iter([(model, q)]), modes)
    ((_, again),) = states()
    np.testing.assert_allclose(again @ scaled.T, q @ modes.T, atol=1e-12)
    stiffness = GalerkinProblem(model.assembler, scaled).rest_tangent
    np.testing.assert_allclose(stiffness, np.eye(5), atol=1e-9)


def test_projected_snapshots_of_a_compressible_body_are_not_far(tiny: Dataset) -> None:
    """So `as-needed` trains as published there, with the same cells and weights."""
    found, published = (
        HyperReducedPOD(5, 1e-2, matching=matching).fit(tiny.scene, tiny.train)
        for matching in ("as-needed", "force")
    )
    np.testing.assert_array_equal(found.cells_, published.cells_)
    np.testing.assert_array_equal(found.weights_, published.weights_)


def test_deim_without_an_equilibrium_raises_a_typed_error(tiny: Dataset) -> None:
    method = InterpolatedPOD(6, 12).fit(tiny.scene, tiny.train)
    with pytest.raises(SolverError):
        method.predict(1e4 * tiny.test.forces[0])


@pytest.mark.parametrize("kind", [("hexahedron", False), ("hexahedron", True)])
def test_points_preserve_the_reduced_force_of_the_training_samples(kind: tuple[str, bool]) -> None:
    """The fitted model uses fewer points but has the force of all cells."""
    scene = scene_of("neo-hookean", kind)
    train = solved(scene, 40)
    method = HyperReducedPOD(4, 1e-2).fit(scene, train)
    model, q = FullOrderModel(scene), train.free_displacements @ method.modes_
    own = np.array([method.problem_.force(coordinates).force for coordinates in q])
    whole = np.array(
        [model.force(method.modes_ @ coordinates).force @ method.modes_ for coordinates in q]
    )
    assert np.linalg.norm(own - whole) <= 1.0001e-2 * np.linalg.norm(whole)
    assert method.problem_.points.n_points < 2 * len(method.cells_)
    assert method.weights_.shape == (len(method.cells_), 9 if kind[1] else 8)


@pytest.mark.parametrize(
    "method",
    [
        HyperReducedPOD(4, 1e-2),
        EmpiricalCubaturePOD(4, 1e-2),
        InterpolatedPOD(4, 6),
        InterpolatedPOD(4, 6, sampling="cells"),
    ],
)
@pytest.mark.parametrize("forged", [-1, 10**6, "twice", 0.5])
def test_invalid_indices_in_a_file_are_refused(tiny: Dataset, method: Any, forged: Any) -> None:
    """Kernels check no bounds."""
    state = method.fit(tiny.scene, tiny.train).arrays_
    (name,) = {"cells", "dofs", "entries"} & state.keys()
    indices = state[name].copy()
    indices[0] = indices[1] if forged == "twice" else forged
    with pytest.raises(InvalidInputError, match=f"`{name}` must be different integers"):
        method.restore(
            tiny.scene, state | {name: indices.astype(float) if forged == 0.5 else indices}
        )


def test_a_snapshot_without_displacement_does_not_train_the_cubature(tiny: Dataset) -> None:
    displacements = tiny.train.free_displacements[:10].copy()
    displacements[0] = 0.0
    train = replace(tiny.train[:10], free_displacements=displacements)
    method = HyperReducedPOD(2, 1e-2, n_cubature_snapshots=1).fit(tiny.scene, train)
    assert len(method.cells_) > 0


def wanted_at_the_tip(method: HyperReducedPOD) -> tuple[HyperReducedPOD, HyperReducedPOD]:
    """Return the method, and the same on twice the cells, with outputs at the loaded end only."""
    scene = method.scene_
    fine = with_cells(scene, (30, 3, 3))
    modes = interpolation_matrix(scene.mesh, fine.mesh.points) @ nodal(
        scene, method.modes_
    ).reshape(scene.mesh.n_nodes, -1)
    centres, kept = (s.mesh.points[s.mesh.cells].mean(axis=1) for s in (fine, scene))
    nearest = np.linalg.norm(centres[:, None] - kept[method.cells_], axis=2).argmin(axis=0)
    both = []
    for own, basis, cells, weights in (
        (scene, method.modes_, method.cells_, method.weights_),
        (fine, modes.reshape(fine.mesh.n_dofs, -1)[fine.free_dofs], nearest, 2 * method.weights_),
    ):
        needs = own.spec.needs.model_copy(update={"outputs": "x-max"})
        other = HyperReducedPOD(**method.parameters)
        own = replace(own, spec=own.spec.model_copy(update={"needs": needs}))
        other.restore(
            own, {"modes": np.ascontiguousarray(basis), "cells": cells, "weights": weights}
        )
        both.append(other)
    return both[0], both[1]


@pytest.mark.slow
def test_a_query_for_few_outputs_does_not_depend_on_the_mesh(coarse: Dataset) -> None:
    """The counted work from forces to requested displacements is exactly the same."""
    fitted = HyperReducedPOD(10, 1e-2, tolerance=1e-4, sampling="cells")
    given, fine = wanted_at_the_tip(fitted.fit(coarse.scene, coarse.train))
    assert len(given.scene_.output_nodes) == len(fine.scene_.output_nodes) == 16
    equal = 0
    for corner in ([4.0, 0.0, 1.0], [4.0, 1.0, 1.0], [4.0, 0.0, 0.0]):
        loads = []
        for method in (given, fine):
            load = np.zeros((method.scene_.mesh.n_nodes, 3))
            load[np.linalg.norm(method.scene_.mesh.points - corner, axis=1).argmin()] = [
                0.01,
                0.02,
                -0.05,
            ]
            loads.append(load)
        with counted() as own:
            answer = given.predict(loads[0])
        with counted() as other:
            again = fine.predict(loads[1])
        tips = [u[method.scene_.output_nodes] for method, u in ((given, answer), (fine, again))]
        assert np.linalg.norm(tips[1] - tips[0]) <= 0.05 * np.linalg.norm(
            tips[0]
        )  # another quadrature of the same body
        assert np.isnan(answer).any()
        if steps(own, len(given.cells_)) == steps(other, len(fine.cells_)):
            assert own == other != Cost()
            equal += 1
    assert equal > 0


def steps(cost: Cost, n_cells: int) -> tuple[int, float]:
    """Return the numbers of tangents and of evaluations of all cells."""
    return cost.factorisations, cost.element_evaluations / n_cells


def test_compiled_steps_never_end_in_an_unstable_or_inverted_state() -> None:
    """At 0.9 of the limit load of a confined column, the residual vanishes at three stretches."""
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    mode = np.zeros((mesh.n_nodes, 3, 1))
    mode[mesh.points[:, 2] == 1.0, 2] = 1.0
    points = ReducedPoints(Discretisation(mesh.points, mesh.cells, LAW), np.ones(1), mode)
    roots = np.sort(np.roots([1.0, 0.0, -1.0, 0.9 * 2 / (3 * np.sqrt(3))]).real)
    mirrored, unstable, stable = roots
    load = points.force(np.array([stable - 1])).force
    assert points.force(np.array([unstable - 1])).force == pytest.approx(load, rel=1e-9)
    for start in (mirrored, unstable):
        assert points.full_steps(load, np.array([start - 1]), 1e-6, 1.0) is None
    found = points.full_steps(load, np.array([stable - 0.99]), 1e-10, 1.0)
    assert found is not None
    assert 1 + found.displacement[0] == pytest.approx(stable, abs=1e-9)


def test_too_few_points_for_the_modes_raise_a_typed_error(tiny: Dataset) -> None:
    with pytest.raises(SolverError, match="too few cells or points"):
        HyperReducedPOD(20, 0.9).fit(tiny.scene, tiny.train)
