"""Counted work against numbers made by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.counting import (
    Cost,
    cholesky_multiply_adds,
    count,
    counted,
    is_counting,
    triangular_multiply_adds,
    uncounted,
)
from mor_bench.errors import SolverError
from mor_bench.measure.query_cost import cost_of
from mor_bench.mechanics import kernels
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.linear import Pardiso, SparseLU
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.rotated import BlockJacobi, conjugate_gradients
from mor_bench.reduction.points import SVK_MULTIPLY_ADDS, tangent_multiply_adds
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.given import Forces
from mor_bench.specs import SolverName
from mor_bench.surrogate import Surrogate
from tests.suite_methods import SPECS


@pytest.mark.parametrize(("n", "bandwidth"), [(1, 0), (7, 6), (9, 2), (12, 11)])
def test_banded_arithmetic_by_loops(n: int, bandwidth: int) -> None:
    factor = solve = 0
    for j in range(n):
        below = min(bandwidth, n - 1 - j)
        factor += 1 + below + sum(1 for a in range(below) for _ in range(a + 1))
        solve += 2 * (1 + below)
    assert cholesky_multiply_adds(n, bandwidth) == factor
    assert triangular_multiply_adds(n, bandwidth) == solve


def test_the_fields_of_a_count_and_counts_within_counts() -> None:
    with counted() as outer:
        with counted() as inner, uncounted():
            assert not is_counting()
        with counted() as inner:
            count(back_solves=2, multiply_adds=7)
        count(back_solves=1)
        with uncounted():
            assert not is_counting()
    assert inner == Cost(back_solves=2, multiply_adds=7)
    assert outer == Cost(back_solves=3, multiply_adds=7)
    assert not is_counting()
    with pytest.raises(ZeroDivisionError), counted():
        _ = 1 / 0
    assert not is_counting()


def n_nonzeros(model: FullOrderModel) -> int:
    """Of the whole tangent."""
    return 2 * len(model.assembler.pattern.indices) - model.n_unknowns


def cost(action: Callable[[], Any]) -> Cost:
    with counted() as found:
        action()
    return found


@pytest.fixture(scope="module")
def loads(tiny: Dataset) -> np.ndarray:
    return tiny.test.forces[:8]


def test_linear_fem_is_a_column_per_force_component_or_one_back_solve(
    tiny: Dataset, loads: np.ndarray
) -> None:
    method = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    n, b = 54 * 3, BandedCholesky(FullOrderModel(tiny.scene).assembler.pattern).bandwidth
    assert not loads[:, tiny.scene.fixed_nodes].any()
    n_components = np.count_nonzero(loads, axis=(1, 2))
    assert cost(lambda: method.predict(loads[0])) == Cost(multiply_adds=int(n_components[0]) * n)
    assert cost_of(method, Forces(loads)) == {
        **asdict(Cost()),
        "multiply_adds": n_components.mean() * n,
    }
    elsewhere = np.ones(loads[0].shape)
    assert cost(lambda: method.predict(elsewhere)) == Cost(
        back_solves=1, multiply_adds=triangular_multiply_adds(n, b)
    )


def test_fem_evaluates_and_solves_once_per_iteration(tiny: Dataset, loads: np.ndarray) -> None:
    """Each takes a residual and a back-solve; the search for negative curvature takes neither."""
    model = FullOrderModel(tiny.scene)
    free = tiny.scene.free_dofs
    model.prepare()
    bandwidth = BandedCholesky(model.assembler.pattern).bandwidth
    for force in loads:
        with counted() as found:
            solution = model.solve(force.ravel()[free])
        assert found.element_evaluations == 24 * solution.iterations
        assert found.back_solves == solution.iterations
        assert (found.factorisations, found.reduced_back_solves) == (0, 0)
        kernel = found.element_evaluations * 8 * kernels.FORCE_MULTIPLY_ADDS
        solves = found.back_solves * triangular_multiply_adds(model.n_unknowns, bandwidth)
        assert kernel + solves < found.multiply_adds < 1.15 * (kernel + solves)


@pytest.mark.parametrize("solver", ["cholesky", "superlu", "pardiso"])
def test_newton_with_direct_factors(tiny: Dataset, loads: np.ndarray, solver: SolverName) -> None:
    """From rest a back-solve; then a tangent, a factor and a back-solve for each step."""
    if solver == "pardiso":
        pytest.importorskip("pypardiso")
    model = FullOrderModel(tiny.scene, solver)
    model.prepare()
    with counted() as found:
        model.solve(loads[0].ravel()[tiny.scene.free_dofs])
    assert found.factorisations >= 2
    assert found.back_solves == found.factorisations + 1
    assert found.element_evaluations % 24 == 0
    assert found.factorisations <= found.element_evaluations // 24 <= 2 * found.factorisations + 1


def dense_lu_structure(matrix: np.ndarray, order: np.ndarray) -> tuple[int, int]:
    """Return multiply-adds of a factorisation and a solve by elimination in an order."""
    pattern = (matrix != 0)[np.ix_(order, order)]
    factor = solve = 0
    for j in range(len(pattern)):
        below = np.flatnonzero(pattern[j + 1 :, j]) + j + 1
        pattern[np.ix_(below, below)] = True
        factor += len(below) * (1 + len(below))
        solve += 1 + 2 * len(below)
    return factor, solve


def test_sparse_lu_by_elimination_of_its_pattern(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene, "superlu")
    solver = SparseLU(model.assembler.pattern)
    factor = solver.factor(model.rest_tangent)
    pattern = model.assembler.pattern
    upper = np.zeros((pattern.n, pattern.n))
    upper[pattern.rows, pattern.indices] = 1.0
    by_factor, by_solve = dense_lu_structure(upper + upper.T, np.argsort(factor.lu.perm_c))
    assert cost(lambda: solver.factor(model.rest_tangent)) == Cost(
        factorisations=1, multiply_adds=by_factor
    )
    assert cost(lambda: factor.solve(np.ones((pattern.n, 3)))) == Cost(
        back_solves=3, multiply_adds=3 * by_solve
    )


def test_pardiso_lies_near_sparse_lu(tiny: Dataset) -> None:
    """Both keep the fill-in low; Pardiso makes use of the symmetry: half the multiply-adds."""
    pytest.importorskip("pypardiso")
    model = FullOrderModel(tiny.scene, "pardiso")
    lu, pardiso = SparseLU(model.assembler.pattern), Pardiso(model.assembler.pattern)
    by_lu = cost(lambda: lu.factor(model.rest_tangent))
    by_pardiso = cost(lambda: pardiso.factor(model.rest_tangent))
    assert by_pardiso.factorisations == 1
    assert 0.25 * by_lu.multiply_adds < by_pardiso.multiply_adds < 2.0 * by_lu.multiply_adds
    rhs = np.ones(model.n_unknowns)
    assert cost(lambda: pardiso.solve(rhs)).back_solves == 1


def test_conjugate_gradients_per_iteration(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    jacobi = BlockJacobi(model.assembler.pattern)
    n, tangent = model.n_unknowns, model.rest_tangent
    assert cost(lambda: jacobi.take(tangent)) == Cost(multiply_adds=9 * n)
    with counted() as found:
        _, iterations = conjugate_gradients(
            model.assembler.pattern, tangent, jacobi, np.ones(n), 1e-6
        )
    assert iterations > 5
    assert found == Cost(multiply_adds=iterations * (n_nonzeros(model) + 6 * n + 3 * n))


def test_a_multigrid_cycle_by_its_operators(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    points = tiny.scene.mesh.points[tiny.scene.free_dofs[::3] // 3]
    factor = MultigridFactor(model.assembler.pattern, model.rest_tangent, points)
    n = model.n_unknowns
    one = cost(lambda: factor.solve_in_place(np.ones((2, n), dtype=np.float32)))
    assert one.back_solves == 2
    # 162 unknowns fit the coarsest level: the cycle is one dense solve.
    assert one.multiply_adds == 2 * n**2
    whole = cost(lambda: factor.solve(np.ones(n)))
    assert whole.multiply_adds == whole.back_solves * (n**2 + n_nonzeros(model) + 6 * n)


def projection(tiny: Dataset, load: np.ndarray, r: int) -> int:
    """Return multiply-adds of projecting a load on r modes and expanding to all dofs."""
    return (int(np.count_nonzero(load)) + tiny.scene.mesh.n_dofs) * r


def test_pod_evaluates_all_cells(tiny: Dataset, loads: np.ndarray) -> None:
    method: Any = mor_bench.load_method("pod", n_modes=6).fit(tiny.scene, tiny.train)
    problem = method.problem_
    assert problem.assembler.n_cells == 24
    per_force = 24 * 8 * kernels.FORCE_MULTIPLY_ADDS
    per_tangent = per_force + 24 * 8 * kernels.TANGENT_MULTIPLY_ADDS
    n, r, stored = problem.assembler.n_dofs, 6, len(problem.assembler.pattern.indices)
    reduction = 2 * n * r + (2 * stored - n) * r + n * r * r
    q = np.zeros(r)
    assert cost(lambda: problem.force(q)) == Cost(
        element_evaluations=24, multiply_adds=per_force + 2 * n * r
    )
    assert cost(lambda: problem.linearise(q)) == Cost(
        element_evaluations=24, multiply_adds=per_tangent + reduction
    )
    found = cost(lambda: method.predict(loads[0]))
    expected = newton(found, 24, r, per_force + 2 * n * r, per_tangent + reduction)
    assert found.multiply_adds == expected + projection(tiny, loads[0], r)


def newton(found: Cost, n_cells: int, r: int, per_force: int, per_tangent: int) -> int:
    """Return multiply-adds of full steps, each with a factorised tangent, after the first."""
    steps, evaluations = found.factorisations, found.element_evaluations // n_cells
    assert found.element_evaluations % n_cells == 0
    assert found.reduced_factorisations == steps
    assert (
        found.reduced_back_solves == found.back_solves == steps + 1
    )  # the first with the factor at rest
    assert steps <= evaluations <= 2 * steps + 1
    dense = steps * cholesky_multiply_adds(r, r - 1) + (steps + 1) * triangular_multiply_adds(
        r, r - 1
    )
    return steps * per_tangent + (evaluations - steps) * per_force + dense


@pytest.mark.parametrize(
    ("name", "knobs"), [("hpod", {}), ("hpod", {"sampling": "cells"}), ("ecm", {})]
)
def test_cubature_evaluates_its_points(
    tiny: Dataset, loads: np.ndarray, name: str, knobs: dict[str, Any]
) -> None:
    method: Any = mor_bench.load_method(name, n_modes=6, cubature_tolerance=1e-2, **knobs).fit(
        tiny.scene, tiny.train
    )
    problem, n_cells, r, q = method.problem_, len(method.cells_), 6, np.zeros(6)
    n_points = (
        int(np.count_nonzero(method.weights_)) if name == "hpod" and not knobs else 8 * n_cells
    )
    assert n_cells < 24
    per_force = n_points * (SVK_MULTIPLY_ADDS[0] + 18 * r)
    per_tangent = per_force + n_points * (SVK_MULTIPLY_ADDS[1] + tangent_multiply_adds(r, True))
    assert cost(lambda: problem.force(q)) == Cost(
        element_evaluations=n_cells, multiply_adds=per_force
    )
    assert cost(lambda: problem.linearise(q)) == Cost(
        element_evaluations=n_cells, multiply_adds=per_tangent
    )
    found = cost(lambda: method.predict(loads[0]))
    assert found.multiply_adds == newton(found, n_cells, r, per_force, per_tangent) + projection(
        tiny, loads[0], r
    )


def test_deim_evaluates_the_points_of_the_cells_around_its_dofs(
    tiny: Dataset, loads: np.ndarray
) -> None:
    method: Any = mor_bench.load_method("deim", n_modes=6, n_force_modes=4).fit(
        tiny.scene, tiny.train
    )
    n_cells, r = len(method.cells_), 6
    assert n_cells < 24
    per_tangent = (
        n_cells * 8 * (sum(SVK_MULTIPLY_ADDS) + 18 * r + tangent_multiply_adds(r, False)) + r * r
    )
    assert cost(lambda: method.problem_.linearise(np.zeros(r))) == Cost(
        element_evaluations=n_cells, multiply_adds=per_tangent
    )
    found = cost(lambda: method.predict(loads[0]))
    tangents = found.element_evaluations // n_cells
    assert found.factorisations == found.reduced_factorisations == tangents
    assert found.back_solves == tangents + 1  # the first with the factor at rest
    factors = tangents * sum(k + k * k for k in range(r))
    factors += (tangents + 1) * triangular_multiply_adds(r, r - 1)
    assert found.multiply_adds == tangents * per_tangent + factors + projection(tiny, loads[0], r)


def test_pca_regression_by_its_products(tiny: Dataset, loads: np.ndarray) -> None:
    method = mor_bench.load_method(
        "pca-regression-linear", n_input_modes=4, n_output_modes=5, degree=3
    ).fit(tiny.scene, tiny.train)
    n = len(tiny.scene.free_dofs)
    features = 4 + 10 + 20
    components = int(np.count_nonzero(loads[0]))
    assert not loads[0, tiny.scene.fixed_nodes].any()
    assert cost(lambda: method.predict(loads[0])) == Cost(
        multiply_adds=components * (n + 4) + (10 + 20) + 5 * features + n * 5
    )


def test_u_mesh_by_its_layers_and_by_torch(tiny: Dataset, loads: np.ndarray) -> None:
    torch = pytest.importorskip("torch")
    from torch.utils.flop_counter import FlopCounterMode

    method: Any = mor_bench.load_method(
        "umesh", channels=4, steps=2, iterations=2, batch_size=4
    ).fit(tiny.scene, tiny.train)
    # 7 x 3 x 3 nodes are padded to 8 x 4 x 4 points.
    fine, middle, bottom = 128, 16, 2
    convolutions = 27 * (
        fine * (3 * 4 + 4 * 4) + middle * (4 * 8 + 8 * 8) + bottom * (8 * 16 + 16 * 16)
    )
    convolutions += (
        8 * (bottom * 16 * 8 + middle * 8 * 4)
        + 27 * (middle * (16 * 8 + 8 * 8) + fine * (8 * 4 + 4 * 4))
        + fine * 4 * 3
    )
    found = cost(lambda: method.predict(loads[0]))
    assert found == Cost(multiply_adds=convolutions + 2 * tiny.scene.mesh.n_dofs)
    with FlopCounterMode(display=False) as flops, torch.no_grad():
        method.network_(torch.zeros(1, 3, 8, 4, 4))
    assert flops.get_total_flops() == 2 * convolutions


QUICK = {"fem", "linear-fem", "pod", "hpod", "pca-regression-linear"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SPECS],
)
def test_a_batch_costs_what_its_samples_cost_and_counting_changes_nothing(
    fitted_by_name: Callable[[str], Surrogate], loads: np.ndarray, name: str
) -> None:
    method = fitted_by_name(name)
    uncounted_answer = method.predict(loads)
    with counted() as batch:
        answer = method.predict(loads)
    np.testing.assert_array_equal(answer, uncounted_answer)
    means = cost_of(method, Forces(loads))
    assert means == {field: total / len(loads) for field, total in asdict(batch).items()}
    assert means is not None
    assert means["multiply_adds"] > 1000
    told = SPECS[name].told_with(SPECS[name].battery.parameters)
    on_mesh = means["back_solves"] - means["reduced_back_solves"]
    if told == "input":
        assert on_mesh == 0  # only the linear response and the equations need the stiffness
    if told == "equations":
        assert means["element_evaluations"] + means["reduced_factorisations"] > 0
    else:
        assert means["element_evaluations"] == 0


class Silent(Surrogate):
    """A third party's method, which counts nothing."""

    needs_snapshots = False

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.0 * forces


def test_a_method_that_counts_nothing_has_no_cost(tiny: Dataset, loads: np.ndarray) -> None:
    assert cost_of(Silent().fit(tiny.scene), Forces(loads)) is None


def test_work_without_an_answer_counts(tiny: Dataset, loads: np.ndarray) -> None:
    method = mor_bench.load_method("fem").fit(tiny.scene, None)
    hopeless = loads[:1] * 1e6
    with pytest.raises(SolverError):
        method.predict(hopeless)
    means = cost_of(method, Forces(np.concatenate([loads[:1], hopeless])))
    one = cost_of(method, Forces(loads[:1]))
    assert means is not None
    assert one is not None
    assert means["element_evaluations"] > 10 * one["element_evaluations"]
