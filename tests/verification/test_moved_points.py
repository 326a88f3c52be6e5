"""Cubatures whose points move: exact sums, integrals, positions, and hyper-reduced models."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.discretisation import discretisation_of
from mor_bench.mechanics.elements import GAUSS
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.moved_points import PointRule, move_points
from mor_bench.reduction.points import ReducedPoints
from mor_bench.scene.interpolation import trilinear
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.hpod import HyperReducedPOD

from .laws_and_elements import LAWS
from .scenes import scene_of
from .test_springs import bedded

Array = NDArray[np.float64]
BOTH = {"n_modes": 6, "cubature_tolerance": 5e-3, "tolerance": 1e-8, "matching": "force"}


def warped(mesh: Mesh) -> Mesh:
    """Return the mesh with inner and outer nodes moved by up to a seventh of a cell."""
    rng = np.random.default_rng(3)
    return replace(mesh, points=mesh.points + 0.05 * rng.uniform(-1, 1, mesh.points.shape))


class Quadratics:
    """The ten monomials of degree two and less, times det J."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def places(self, cells: NDArray[np.int64], positions: Array) -> tuple[Array, Array]:
        """Return positions in space and det J, (n, 3) and (n,)."""
        shape, derivatives = trilinear(positions)
        corners = self.mesh.points[self.mesh.cells[cells]]
        jacobian = np.einsum("nai,nak->nik", derivatives, corners)
        return np.einsum("na,nak->nk", shape, corners), np.linalg.det(jacobian)

    def __call__(self, cells: NDArray[np.int64], positions: Array) -> Array:
        (x, y, z), det_j = self.places(cells, positions)[0].T, self.places(cells, positions)[1]
        values = [np.ones(len(x)), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
        return np.asarray((np.array(values) * det_j).T)


@pytest.mark.parametrize("mesh", [box_mesh((3.0, 1.0, 1.0), (6, 2, 2)), None])
def test_few_points_integrate_quadratic_polynomials(mesh: Mesh | None) -> None:
    """Four points are the fewest (Stroud 1957); fixed ones need as many as there are monomials."""
    mesh = mesh or warped(box_mesh((3.0, 1.0, 1.0), (6, 2, 2)))
    integrands, n = Quadratics(mesh), mesh.n_cells
    cells, positions = np.repeat(np.arange(n), 8), np.tile(GAUSS, (n, 1))
    start = PointRule(cells, positions, np.ones(8 * n))
    target, tolerance = start.integrate(integrands), 1e-5
    rule = move_points(mesh, integrands, target, start, tolerance)
    assert 4 <= len(rule) < 10
    places, det_j = integrands.places(rule.cells, rule.positions)
    x = np.column_stack([np.ones(len(rule)), places])
    moments = np.einsum("n,ni,nj->ij", rule.weights * det_j, x, x)
    whole, volumes = integrands.places(cells, positions)
    whole = np.column_stack([np.ones(len(whole)), whole])
    expected = np.einsum("n,ni,nj->ij", volumes, whole, whole)
    assert np.linalg.norm(moments - expected) <= 2 * tolerance * np.linalg.norm(target)
    assert (rule.weights > 0).all()
    assert (np.abs(rule.positions) <= 1).all()


@pytest.mark.parametrize("law", LAWS)
def test_points_at_the_quadrature_points_are_the_cells(law: str) -> None:
    """Moved points with the positions and weights of the quadrature give the same model."""
    scene = scene_of(law, ("hexahedron", False))
    rng = np.random.default_rng(0)
    mesh = warped(scene.mesh)
    cells, weights = np.array([4, 1, 9]), rng.uniform(0.5, 3.0, (3, 8))
    modes, q = rng.normal(size=(mesh.n_nodes, 3, 5)), 0.02 * rng.normal(size=5)
    body = replace(discretisation_of(scene, cells), points=mesh.points)
    each = replace(body, cells=mesh.cells[np.repeat(cells, 8)], positions=np.tile(GAUSS, (3, 1)))
    state, tangent = ReducedPoints(body, weights, modes).force_and_tangent(q)
    found, moved = ReducedPoints(each, weights.ravel(), modes).force_and_tangent(q)
    size = np.abs(state.force).max()
    np.testing.assert_allclose(found.force, state.force, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(moved, tangent, rtol=0, atol=1e-12 * np.abs(tangent).max())
    assert found.energy_j == pytest.approx(state.energy_j, rel=1e-12)


def fitted(data: Dataset, sampling: str) -> HyperReducedPOD:
    method = mor_bench.load_method("hpod", **BOTH, sampling=sampling)
    assert isinstance(method, HyperReducedPOD)
    return method.fit(data.scene, data.train)


def test_moved_points_keep_the_forces_and_answers_of_more_points(tiny: Dataset) -> None:
    more, fewer = fitted(tiny, "points"), fitted(tiny, "moved")
    assert fewer.problem_.points.n_points <= 0.7 * more.problem_.points.n_points
    assert fewer.positions_ is not None
    assert (np.abs(fewer.positions_) <= 1).all()
    assert (fewer.weights_ > 0).all()
    assert not set(fewer.cells_) <= set(more.cells_)  # points have come to other cells
    model, q = FullOrderModel(tiny.scene), tiny.train.free_displacements @ fewer.modes_
    whole = np.array([fewer.modes_.T @ model.force(fewer.modes_ @ row).force for row in q])
    for method in (more, fewer):
        own = np.array([method.problem_.force(row).force for row in q])
        assert np.linalg.norm(own - whole) <= 5.0001e-3 * np.linalg.norm(whole)
    plain = mor_bench.load_method("pod", n_modes=6).fit(tiny.scene, tiny.train)
    expected = plain.predict(tiny.test.forces)
    for method in (more, fewer):
        apart = np.linalg.norm(method.predict(tiny.test.forces) - expected)
        assert apart <= 0.02 * np.linalg.norm(expected)


def test_points_of_a_file_stay_in_their_cells(tiny: Dataset, tmp_path: Path) -> None:
    method = fitted(tiny, "moved")
    method.save(tmp_path / "model.npz")
    loaded = mor_bench.load_surrogate(tmp_path / "model.npz")
    forces = tiny.test.forces[:5]
    np.testing.assert_array_equal(loaded.predict(forces), method.predict(forces))
    outside = {**method.arrays_, "positions": 1.1 * method.arrays_["positions"]}
    outside["positions"][0] = 1.001
    with pytest.raises(InvalidInputError, match=r"`positions` must be in \[-1, 1\]"):
        method.restore(tiny.scene, outside)


@pytest.mark.parametrize(
    "scene",
    [
        scene_of("neo-hookean", ("hexahedron", True)),
        scene_of("neo-hookean", ("tetrahedron", False)),
        mor_bench.load_scene("beam-stiffness"),
    ],
    ids=["selective", "T4", "sampled stiffness"],
)
def test_points_move_in_hexahedra_with_full_integration_only(scene: Scene) -> None:
    method = mor_bench.load_method("hpod", sampling="moved")
    assert method.supports(scene) is not None
    assert mor_bench.load_method("hpod", sampling="points").supports(scene) is None
    with pytest.raises(UnsupportedSceneError, match="points move in H8"):
        method.fit(scene, None)


def test_moved_points_leave_springs_and_the_rest_state_to_the_model(cache: Path) -> None:
    spec = bedded(gravity={"density_kg_m3": 2.0}).spec
    data = mor_bench.load_dataset(spec, limit=40, cache=cache, workers=1)
    plain = mor_bench.load_method("pod", n_modes=5).fit(data.scene, data.train)
    expected = plain.predict(data.train.forces)
    more, fewer = (
        HyperReducedPOD(5, 5e-3, sampling=sampling).fit(data.scene, data.train)
        for sampling in ("points", "moved")
    )
    assert fewer.problem_.points.n_points <= 0.7 * more.problem_.points.n_points
    apart = np.linalg.norm(fewer.predict(data.train.forces) - expected)
    assert apart <= 0.01 * np.linalg.norm(expected)
