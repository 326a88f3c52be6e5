"""Bodies of any shape: surfaces, points inside, voxels, tetrahedra, and the liver."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.liver import liver_level, liver_surface, liver_tetrahedra
from mor_bench.scene.mesh import FACES, Mesh, box_mesh, l_mesh
from mor_bench.scene.surfaces import Surface, inside, read_surface
from mor_bench.scene.tetrahedra import tetrahedral_mesh
from mor_bench.scene.triangles import met_cells, winding_numbers
from mor_bench.scene.voxels import voxel_mesh
from mor_bench.specs import load_generated_spec

RADIUS = 0.07
CENTRE = np.array([0.3, -0.2, 0.1])
ALL_AROUND = np.array([CENTRE - RADIUS, CENTRE + RADIUS])


def sphere_level(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(((points - CENTRE) ** 2).sum(axis=1) - RADIUS**2)


def boundary(mesh: Mesh) -> Surface:
    """Return the surface of a mesh, its quadrilaterals cut in two."""
    facets = mesh.boundary_facets
    if facets.shape[1] == 4:
        facets = np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])
    used, number = np.unique(facets, return_inverse=True)
    return Surface(mesh.points[used], number.reshape(-1, 3))


def sphere(spacing_m: float) -> Surface:
    return boundary(tetrahedral_mesh(sphere_level, ALL_AROUND, spacing_m))


def joined(one: Surface, other: Surface) -> Surface:
    points = np.concatenate([one.points, other.points])
    return Surface(points, np.concatenate([one.triangles, other.triangles + len(one.points)]))


def on_surface(surface: Surface) -> NDArray[np.float64]:
    """Return vertices, points on edges and points on triangles."""
    rng, corners = np.random.default_rng(0), surface.points[surface.triangles]
    shares, share = rng.dirichlet([1, 1, 1], size=len(corners)), rng.random((len(corners), 1))
    on_edges = share * corners[:, 0] + (1 - share) * corners[:, 1]
    return np.concatenate([surface.points, on_edges, np.einsum("ni,nid->nd", shares, corners)])


def check_closed(triangles: NDArray[np.int64]) -> int:
    """Check that each edge joins two triangles of one orientation; return the number of edges."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    shared = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    assert (shared == 2).all()
    assert len(np.unique(edges, axis=0)) == len(edges)
    return len(shared)


CUBE = box_mesh((2.0, 3.0, 4.0), (1, 1, 1))
CUBE_SURFACE = boundary(CUBE)
CUBE_CORNERS = CUBE_SURFACE.points[CUBE_SURFACE.triangles]


# --- surfaces -------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_an_stl_surface_is_oriented_and_has_its_volume_and_unique_vertices(
    tmp_path: Path, turned: bool
) -> None:
    corners = CUBE_CORNERS[:, ::-1] if turned else CUBE_CORNERS
    raw = meshio.Mesh(corners.reshape(-1, 3), [("triangle", np.arange(36).reshape(12, 3))])
    raw.write(tmp_path / "cube.stl")
    surface = read_surface(tmp_path / "cube.stl", unit_m=0.01)
    assert surface.volume_m3 == pytest.approx(24e-6, rel=1e-12)
    assert (len(surface.points), len(surface.triangles)) == (8, 12)
    np.testing.assert_allclose(surface.bounds, [[0.0] * 3, [0.02, 0.03, 0.04]], rtol=0, atol=1e-15)


def test_an_obj_may_have_polygons_and_unused_vertices(tmp_path: Path) -> None:
    points = np.concatenate([[[9.0, 9.0, 9.0]], CUBE.points])
    meshio.Mesh(points, [("quad", CUBE.boundary_facets + 1)]).write(tmp_path / "cube.obj")
    surface = read_surface((tmp_path / "cube.obj").rename(tmp_path / "cube.OBJ"))
    assert surface.volume_m3 == pytest.approx(24, rel=1e-12)
    assert (len(surface.points), len(surface.triangles)) == (8, 12)


def test_the_volume_of_a_sphere_converges_with_second_order_even_far_from_the_origin() -> None:
    exact = 4 / 3 * np.pi * RADIUS**3
    coarse, fine = (1 - sphere(h).volume_m3 / exact for h in (0.028, 0.014))
    assert 0 < fine < coarse / 3 < 0.03
    near = sphere(0.028)
    far = Surface(near.points + 1000, near.triangles)
    assert far.volume_m3 == pytest.approx(near.volume_m3, rel=1e-9)


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OPEN = POINTS + "f 1 3 2\nf 1 2 4\nf 2 3 4\n"
CLOSED = OPEN + "f 1 4 3\n"
NOT_CLOSED = r"the surface is not closed: 3 of its 6 edges are not shared by exactly two"
TWISTED = r"are not consistently oriented: the orientation flips across 3 of 6 edges\.$"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.ply", "", r"a surface must be an \.stl or \.obj file; got '\.ply'\.$"),
        ("a.obj", "", r"a surface must hold triangles; got none\.$"),
        ("a.stl", "", r"a surface must hold triangles; got none\.$"),
        ("a.stl", "solid x\nendsolid x\n", r"must hold triangles; got none|meshio cannot read it"),
        ("a.obj", POINTS + "l 1 2\n", r"a surface must hold triangles; got none\.$"),
        ("a.obj", POINTS + "f 1 2 2\nf 1 1 3\n", r"triangles; got only points and lines\.$"),
        ("a.obj", "v 0 0 zero\n", r"meshio cannot read it \(could not convert .* 'zero'\)\.$"),
        ("a.stl", "solid\nvertex 0 0\n", r"meshio cannot read it \(\S.*\)\.$"),
        ("a.obj", OPEN + "f 1 4 5\n", r"triangles must have points in \[1, 4\]; got 1 to 5\.$"),
        ("a.obj", OPEN + "f 1 4 -2\n", r"triangles must have points in \[1, 4\]; got -2 to 4\.$"),
        ("a.obj", CLOSED.replace("v 1 0", "v nan 0"), r"positions must be finite\.$"),
        ("a.obj", OPEN, NOT_CLOSED),
        ("a.obj", CLOSED + "f 1 4 3\n", NOT_CLOSED),
        ("a.obj", OPEN + "f 1 3 4\n", TWISTED),
        ("a.obj", CLOSED.replace("v 0 0 1", "v 1 1 0"), r"the surface encloses no volume\.$"),
        ("a.obj", None, r"no such file\.$"),
    ],
)
def test_a_bad_surface_is_refused_in_one_line_that_names_the_file(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str | None, message: str
) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(SpecError, match="^" + re.escape(str(path)) + ": .*" + message) as caught:
        read_surface(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


# --- inside ---------------------------------------------------------------------------------------


def test_points_inside_a_sphere_match_its_equation() -> None:
    points = CENTRE + np.random.default_rng(0).uniform(-1.3 * RADIUS, 1.3 * RADIUS, size=(2000, 3))
    distance = np.linalg.norm(points - CENTRE, axis=1)
    clear = np.abs(distance - RADIUS) > 0.001
    expected = distance[clear] < RADIUS
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(inside(sphere(0.014), points[clear]), expected)


def test_the_winding_number_is_an_integer_even_next_to_an_edge_or_a_corner() -> None:
    """A ray through an edge, a face diagonal or a corner would be counted twice, or never."""
    share = np.random.default_rng(0).random((200, 12, 1))
    on_edges = (share * CUBE_CORNERS[:, 0] + (1 - share) * CUBE_CORNERS[:, 1]).reshape(-1, 3)
    points = np.concatenate([on_edges, CUBE.points])
    outwards = points - CUBE.points.mean(axis=0)
    for depth in (1e-3, 1e-6, 1e-9):
        for sign, winding in [(-1, 1), (1, 0)]:
            found = winding_numbers(CUBE_CORNERS, points + sign * depth * outwards)
            np.testing.assert_allclose(found, winding, atol=1e-6)
    in_plane = np.array([[-1.0, 0.0, 0.0], [5.0, 3.0, 4.0], [2.0, 7.0, 2.0], [1.0, 1.5, 9.0]])
    assert not inside(CUBE_SURFACE, in_plane).any()


def test_points_in_a_cavity_are_outside() -> None:
    outer, inner = (boundary(box_mesh((a, a, a), (1, 1, 1))) for a in (3.0, 1.0))
    body = joined(outer, Surface(inner.points + 1, inner.triangles[:, ::-1]))
    assert body.volume_m3 == pytest.approx(26)
    points = np.array([[1.5, 1.5, 1.5], [0.5, 1.5, 1.5], [3.5, 1.5, 1.5]])
    np.testing.assert_array_equal(inside(body, points), [False, True, False])
    assert voxel_mesh(body, (3, 3, 3)).n_cells == 26


# --- voxels ---------------------------------------------------------------------------------------


def clipped(polygon: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the part of a polygon (n, 3) in the unit cube at `low` (Sutherland & Hodgman 1974)."""
    for axis in range(3):
        for sign in (1, -1):
            offset = polygon[:, axis] - low[axis]
            depth = offset if sign == 1 else 1 - offset
            following, next_depth = np.roll(polygon, -1, axis=0), np.roll(depth, -1)
            kept = []
            for p, q, dp, dq in zip(polygon, following, depth, next_depth, strict=True):
                kept += [p] if dp >= 0 else []
                kept += [p + dp / (dp - dq) * (q - p)] if dp * dq < 0 else []
            polygon = np.array(kept).reshape(-1, 3)
    return polygon


def test_a_triangle_meets_a_cell_if_clipping_it_to_the_cell_leaves_something() -> None:
    rng = np.random.default_rng(0)
    size = rng.choice([0.1, 1.0, 5.0], size=(60, 1, 1)) * rng.uniform(-1.5, 1.5, size=(60, 3, 3))
    for triangle in rng.uniform(-0.5, 3.5, size=(60, 1, 3)) + size:
        lows = [np.array(low, dtype=float) for low in np.ndindex(3, 3, 3)]
        expected = [len(clipped(triangle, low)) > 0 for low in lows]
        np.testing.assert_array_equal(met_cells(triangle[None], (3, 3, 3), 0.5).ravel(), expected)


@pytest.mark.parametrize(
    "mesh", [box_mesh((0.3, 0.5, 0.7), (3, 4, 7)), l_mesh((0.3, 0.5, 0.7), (3, 4, 7), (1, 3))]
)
def test_a_body_made_of_whole_cells_has_these_cells_as_voxels(mesh: Mesh) -> None:
    offset, surface = np.array([0.1, -7.0, 3.3]), boundary(mesh)
    voxels = voxel_mesh(Surface(surface.points + offset, surface.triangles), (3, 4, 7))
    np.testing.assert_array_equal(voxels.cells, mesh.cells)
    np.testing.assert_allclose(voxels.points, mesh.points + offset, rtol=0, atol=1e-14)
    assert voxels.grid_shape == mesh.grid_shape
    np.testing.assert_array_equal(voxels.grid_index, mesh.grid_index)


def needle() -> Surface:
    """Return a body along a diagonal that is thinner than a cell and contains no cell centre."""
    points = np.array([[0.0, 0, 0], [1, 1, 1], [0.5, 0.52, 0.5], [0.5, 0.5, 0.53]])
    found = Surface(points, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    return found if found.volume_m3 > 0 else Surface(points, found.triangles[:, ::-1])


@pytest.mark.parametrize("cells", [(1, 1, 1), (4, 9, 7), (12, 12, 12)])
@pytest.mark.parametrize(
    "make",
    [
        liver_surface,
        lambda: sphere(0.02),
        lambda: Surface(CUBE.points + 0.1, CUBE_SURFACE.triangles),
        needle,
    ],
)
def test_every_point_of_a_surface_lies_in_a_cell(
    make: Callable[[], Surface], cells: tuple[int, int, int]
) -> None:
    surface = make()
    mesh, points = voxel_mesh(surface, cells), on_surface(surface)
    found = interpolation_matrix(mesh, points) @ mesh.points
    np.testing.assert_allclose(found, points, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("depth", "n_cells"), [(-1e-6, 3), (0.0, 3), (1e-12, 3), (1e-6, 4)])
def test_a_cell_is_kept_if_the_body_enters_it_but_not_if_it_only_touches_it(
    depth: float, n_cells: int
) -> None:
    surface = boundary(l_mesh((2.0, 1.0, 2.0), (2, 1, 2), (1, 1)))
    points = surface.points + depth * (surface.points == 1) * [1, 0, 0]
    assert voxel_mesh(Surface(points, surface.triangles), (2, 1, 2)).n_cells == n_cells


def test_cells_joined_only_by_an_edge_are_refused() -> None:
    part = boundary(box_mesh((1.0, 1.0, 1.0), (1, 1, 1)))
    both = joined(part, Surface(part.points + np.array([1, 1, 0]), part.triangles))
    message = r"^the 16 cells of the body in a grid of 4 x 4 x 2 form 2 parts that share no face"
    with pytest.raises(SpecError, match=message):
        voxel_mesh(both, (4, 4, 2))


# --- tetrahedra -----------------------------------------------------------------------------------


def volumes(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c, d = np.moveaxis(mesh.points[mesh.cells], 1, 0)
    return np.asarray(((b - a) * np.cross(c - a, d - a)).sum(axis=1) / 6)


def dihedral_angles(mesh: Mesh) -> NDArray[np.float64]:
    """Return angles (6, n_cells), degrees."""
    angles, corners = [], np.moveaxis(mesh.points[mesh.cells], 1, 0)
    for i, j in combinations(range(4), 2):
        others = [corners[n] - corners[i] for n in range(4) if n not in (i, j)]
        u, v = (np.cross(corners[j] - corners[i], other) for other in others)
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        angles.append(np.degrees(np.arctan2(sine, (u * v).sum(axis=1))))
    return np.array(angles)


def check_tetrahedra(mesh: Mesh) -> None:
    assert (volumes(mesh) > 0).all()
    assert dihedral_angles(mesh).min() > 10.7
    assert dihedral_angles(mesh).max() < 164.8
    faces = np.sort(mesh.cells[:, FACES[4]].reshape(-1, 3), axis=1)
    assert set(np.unique(faces, axis=0, return_counts=True)[1]) == {1, 2}
    check_closed(mesh.boundary_facets)
    assert len(np.unique(mesh.cells)) == mesh.n_nodes
    # If cells met in parts of faces, the boundary would enclose another volume.
    assert boundary(mesh).volume_m3 == pytest.approx(volumes(mesh).sum(), rel=1e-9)


@pytest.mark.parametrize("spacing_m", [0.05, 0.03, 0.0213, 0.0147])
def test_tetrahedra_of_a_sphere_are_well_shaped_and_have_its_surface(spacing_m: float) -> None:
    mesh = tetrahedral_mesh(sphere_level, ALL_AROUND, spacing_m)
    check_tetrahedra(mesh)
    on_boundary = mesh.points[np.unique(mesh.boundary_facets)]
    np.testing.assert_allclose(np.linalg.norm(on_boundary - CENTRE, axis=1), RADIUS, rtol=1e-12)
    exact, accuracy = 4 / 3 * np.pi * RADIUS**3, 0.5 * (spacing_m / RADIUS) ** 2
    assert volumes(mesh).sum() == pytest.approx(exact, rel=accuracy)
    assert (np.diff(mesh.points[:, 0]) >= 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_tetrahedra_of_bumpy_bodies_are_well_shaped(seed: int) -> None:
    """The bodies contain all stencils, with the surface at every angle."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(6, 3)) * 60, rng.uniform(0, 6, size=6)

    def bumpy(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(sphere_level(x) + 6e-4 * np.sin(x @ waves.T + phases).sum(axis=1))

    check_tetrahedra(tetrahedral_mesh(bumpy, ALL_AROUND + np.array([[-0.04], [0.04]]), 0.012))


def test_nodes_are_numbered_along_the_longest_axis() -> None:
    def ellipsoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((x**2 / [1, 4, 1]).sum(axis=1) - 1)

    mesh = tetrahedral_mesh(ellipsoid, np.array([[-1.0, -2, -1], [1, 2, 1]]), 0.4)
    assert (np.diff(mesh.points[:, 1]) >= 0).all()
    assert np.ptp(mesh.cells, axis=1).max() < mesh.n_nodes / 3


def beside_the_lattice(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return sphere_level(x + CENTRE + 0.25)


def quadrants(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a body in two opposite quadrants around a line of the lattice."""
    return np.where(np.abs(x).max(axis=1) > 2.2, 1.0, -x[:, 0] * x[:, 1])


@pytest.mark.parametrize(
    ("level", "bounds", "spacing_m", "message"),
    [
        (beside_the_lattice, [[-1] * 3, [1] * 3], 1.0, "no point of a lattice of 1 m lies in the"),
        (
            sphere_level,
            np.add(ALL_AROUND, [[0.08], [0.0]]),
            0.01,
            r"exceeds its bounds, \[.*\] to \[.*\]",
        ),
        (quadrants, [[-3] * 3, [3] * 3], 1.0, r"touch along \d+ edges only; use a smaller one\.$"),
    ],
)
def test_a_body_without_a_sound_mesh_is_refused(
    level: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    bounds: list[list[float]],
    spacing_m: float,
    message: str,
) -> None:
    with pytest.raises(SpecError, match=message):
        tetrahedral_mesh(level, np.array(bounds, dtype=float), spacing_m)


# --- the liver ------------------------------------------------------------------------------------


def test_the_liver_is_a_closed_surface_on_its_level_set_with_the_given_length() -> None:
    surface = liver_surface()
    n_edges = check_closed(surface.triangles)
    # Euler's formula for one part without a handle.
    assert len(surface.points) - n_edges + len(surface.triangles) == 2
    assert surface.volume_m3 > 0
    assert np.ptp(surface.bounds[:, 0]) == pytest.approx(0.2, abs=1e-4)
    assert (np.ptp(surface.bounds[:, 1:], axis=0) > 0.13).all()
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    normal, centre = np.cross(b - a, c - a), (a + b + c) / 3
    outwards = centre + 1e-3 * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    assert (liver_level(outwards) > liver_level(centre)).all()
    assert np.abs(liver_level(surface.points)).max() < 1e-9


def test_the_liver_has_the_cells_and_nodes_of_the_paper_within_a_percent() -> None:
    mesh = voxel_mesh(liver_surface(), (15, 14, 15))
    assert (mesh.n_cells, mesh.n_nodes, mesh.grid_shape) == (726, 1118, (16, 15, 16))
    assert (mesh.n_cells, mesh.n_nodes) == pytest.approx((732, 1109), rel=0.01)


def test_the_liver_is_held_in_the_notch_between_its_lobes() -> None:
    (support,) = load_generated_spec("liver-hex").supports
    between_lobes = np.array(support.region.nearest_m[0])  # type: ignore[union-attr]
    assert abs(liver_level(between_lobes[None])[0]) < 1e-3
    # A notch is hollow: chords between the lobes' surfaces on its two sides leave the body.
    points = liver_surface().points
    near = points[np.linalg.norm(points - between_lobes, axis=1) < 0.04]
    ends = np.random.default_rng(0).integers(len(near), size=(2000, 2))
    assert (liver_level(near[ends].mean(axis=1)) > 0.02).any()


def test_the_liver_of_tetrahedra_is_as_fine_as_in_the_paper_and_keeps_the_volume() -> None:
    mesh = liver_tetrahedra(0.013)
    check_tetrahedra(mesh)
    assert (mesh.n_cells, mesh.n_nodes) == (4567, 1118)
    assert (mesh.n_cells, mesh.n_nodes) == pytest.approx((4859, 1059), rel=0.065)
    assert volumes(mesh).sum() == pytest.approx(liver_surface().volume_m3, rel=0.03)
    assert np.abs(liver_level(mesh.points[np.unique(mesh.boundary_facets)])).max() < 1e-9
