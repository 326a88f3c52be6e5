"""The linear response by stored columns: equal to that by back-solves."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.counting import Cost, counted, triangular_multiply_adds
from mor_bench.mechanics import banded
from mor_bench.mechanics import compliance as compliance_module
from mor_bench.mechanics.banded import BandedCholesky, BandedFactor
from mor_bench.mechanics.compliance import Compliance, project
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import SolverName, load_generated_spec


def scene_with(element: str, integration: str) -> Scene:
    spec = load_generated_spec("beam-tiny")
    changed = spec.discretisation.model_copy(
        update={"element": element, "integration": integration}
    )
    return load_scene(spec.model_copy(update={"discretisation": changed}))


def patch_loads(scene: Scene, n: int) -> NDArray[np.float64]:
    """Return (n, n_dofs) forces of random direction on some patches."""
    rng = np.random.default_rng(0)
    weights = scene.patch_weights.toarray()
    chosen = weights[np.linspace(0, len(weights) - 1, n).astype(int)]
    return np.asarray((chosen[:, :, None] * rng.normal(size=(n, 1, 3))).reshape(n, -1))


def by_back_solves(model: FullOrderModel, loads: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.zeros_like(loads)
    for row, load in zip(out, loads, strict=True):
        row[model.scene.free_dofs] = model.rest_factor.solve(load[model.scene.free_dofs])
    return out


LIVER = pytest.param("liver-hex", marks=pytest.mark.slow)
SCENES = {
    "H8, full": ("hexahedron", "full"),
    "H8, selective": ("hexahedron", "selective"),
    "T4": ("tetrahedron", "full"),
}


@pytest.mark.parametrize("case", [*SCENES, "l-shape", LIVER])
def test_columns_and_back_solves_give_the_same_response(case: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of locking
        scene = scene_with(*SCENES[case]) if case in SCENES else load_scene(case)
        model = FullOrderModel(scene)
    compliance, loads = Compliance(model), patch_loads(scene, 12)
    expected = by_back_solves(model, loads)
    with counted() as cost:
        found = compliance.respond(loads)
    free = scene.free_dofs
    assert cost == Cost(multiply_adds=int(np.count_nonzero(loads[:, free])) * len(free))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert not found[:, np.setdiff1d(np.arange(scene.mesh.n_dofs), free)].any()
    np.testing.assert_array_equal(found[3], compliance.respond(loads[3:4])[0])
    np.testing.assert_array_equal(compliance.solve(loads[3, free]), found[3, free])
    np.testing.assert_array_equal(compliance.solve(loads[:, free].T), found[:, free].T)
    axes = np.random.default_rng(1).normal(size=(len(free), 4))
    reduced = project(compliance.to_coordinates(axes), loads)
    np.testing.assert_allclose(
        reduced, expected[:, free] @ axes, rtol=0, atol=1e-11 * np.abs(reduced).max()
    )


@pytest.mark.parametrize("solver", ["cholesky", "superlu", "pardiso", "jacobi-pcg"])
def test_loads_without_stored_columns_are_solved_directly(
    tiny: Dataset, solver: SolverName
) -> None:
    """Loads on other nodes, on too many nodes, and on supports share a batch with column loads."""
    if solver == "pardiso":
        pytest.importorskip("pypardiso")
    scene, model = tiny.scene, FullOrderModel(tiny.scene, solver)
    compliance, n = Compliance(model), tiny.scene.mesh.n_dofs
    loads = patch_loads(scene, 4)
    elsewhere = np.setdiff1d(scene.free_dofs // 3, np.unique(scene.patch_weights.indices))[0]
    loads[1, 3 * elsewhere] = 1.0
    loads[2] = np.random.default_rng(0).normal(size=n)
    loads[3, 3 * scene.fixed_nodes[0]] = 5.0
    with counted() as cost:
        found = compliance.respond(loads)
    np.testing.assert_allclose(
        found, by_back_solves(model, loads), rtol=0, atol=1e-11 * np.abs(found).max()
    )
    if solver in ("cholesky", "superlu"):
        assert cost.back_solves == 2
    else:
        assert compliance.columns.shape == (0, n)
    assert not compliance.respond(np.zeros((2, n))).any()


def test_columns_that_do_not_pay_are_neither_used_nor_stored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = load_scene("beam-coarse")
    model = FullOrderModel(scene)
    n, bandwidth = len(scene.free_dofs), BandedCholesky(model.assembler.pattern).bandwidth
    few = triangular_multiply_adds(n, bandwidth) // n
    touched = dofs_of_nodes(np.unique(scene.patch_weights.indices))
    touched = touched[np.isin(touched, scene.free_dofs)]
    loads = np.zeros((2, scene.mesh.n_dofs))
    loads[0, touched[:few]] = loads[1, touched[: few + 1]] = 1.0
    assert few < len(touched)
    compliance = Compliance(model)
    for load, n_solves in zip(loads, (0, 1), strict=True):
        with counted() as cost:
            compliance.respond(load[None])
        assert cost.back_solves == n_solves
    monkeypatch.setattr(compliance_module, "MAX_BYTES", compliance.columns.nbytes - 1)
    without = Compliance(model)
    assert len(without.columns) == 0
    np.testing.assert_allclose(
        without.respond(loads), compliance.respond(loads), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("scene", ["l-shape", LIVER])
def test_many_right_hand_sides_give_the_same_solutions_as_few(
    scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks are solved in natural order and reordered; the last block is shorter."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = FullOrderModel(load_scene(scene))
    factor, n = model.rest_factor, model.n_unknowns
    assert isinstance(factor, BandedFactor)
    rhs = np.random.default_rng(0).normal(size=(n, 70))
    many = factor.solve(rhs)
    monkeypatch.setattr(banded, "MANY", 100)
    few = factor.solve(rhs)
    assert n % banded.BLOCK
    assert not np.array_equal(many, few)  # otherwise both took the same path
    np.testing.assert_allclose(many, few, rtol=0, atol=1e-11 * np.abs(few).max())
