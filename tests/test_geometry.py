"""Bodies of any shape: surfaces, points inside, voxels, tetrahedra, and the liver."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.liver import BETWEEN_LOBES, liver_level, liver_surface, liver_tetrahedra
from mor_bench.scene.mesh import FACES, Mesh, box_mesh, l_mesh
from mor_bench.scene.surfaces import Surface, inside, read_surface
from mor_bench.scene.tetrahedra import tetrahedral_mesh
from mor_bench.scene.triangles import met_cells, winding_numbers
from mor_bench.scene.voxels import voxel_mesh

RADIUS = 0.07
CENTRE = np.array([0.3, -0.2, 0.1])
ALL_AROUND = np.array([CENTRE - RADIUS, CENTRE + RADIUS])


def sphere_level(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(((points - CENTRE) ** 2).sum(axis=1) - RADIUS**2)


def boundary(mesh: Mesh) -> Surface:
    """The surface of a mesh, its quadrilaterals cut in two."""
    facets = mesh.boundary_facets
    triangles = (
        facets
        if facets.shape[1] == 3
        else np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])
    )
    used, number = np.unique(triangles, return_inverse=True)
    return Surface(mesh.points[used], number.reshape(-1, 3))


def sphere(spacing_m: float) -> Surface:
    return boundary(tetrahedral_mesh(sphere_level, ALL_AROUND, spacing_m))


def on_surface(surface: Surface, rng: np.random.Generator) -> NDArray[np.float64]:
    """Vertices, points on edges and points on triangles."""
    corners = surface.points[surface.triangles]
    shares = rng.dirichlet([1, 1, 1], size=len(corners))
    share = rng.random((len(corners), 1))
    return np.concatenate(
        [
            surface.points,
            share * corners[:, 0] + (1 - share) * corners[:, 1],
            np.einsum("ni,nid->nd", shares, corners),
        ]
    )


def edge_uses(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many triangles use each edge, and each edge in its direction."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1], np.unique(
        edges, axis=0, return_counts=True
    )[1]


def write_stl(path: Path, corners: NDArray[np.float64]) -> Path:
    text = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {:.17g} {:.17g} {:.17g}\n".format(*p) for p in triangle)
        + "endloop\nendfacet\n"
        for triangle in corners
    )
    path.write_text(f"solid body\n{text}endsolid body\n")
    return path


def write_obj(path: Path, points: NDArray[np.float64], faces: NDArray[np.int64]) -> Path:
    lines = ["v {:.17g} {:.17g} {:.17g}".format(*p) for p in points] + [
        "f " + " ".join(str(n + 1) for n in face) for face in faces
    ]
    path.write_text("\n".join([*lines, ""]))
    return path


CUBE = box_mesh((2.0, 3.0, 4.0), (1, 1, 1))
CUBE_TRIANGLES = boundary(CUBE).triangles


# --- surfaces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_an_stl_has_its_volume_its_vertices_once_and_is_turned_outwards(
    tmp_path: Path, turned: bool
) -> None:
    corners = CUBE.points[CUBE_TRIANGLES]
    surface = read_surface(
        write_stl(tmp_path / "cube.stl", corners[:, ::-1] if turned else corners), unit_m=0.01
    )
    assert surface.volume_m3 == pytest.approx(24e-6, rel=1e-12)
    assert (len(surface.points), len(surface.triangles)) == (8, 12)
    np.testing.assert_allclose(
        surface.bounds, np.array([[0, 0, 0], [0.02, 0.03, 0.04]]), rtol=0, atol=1e-15
    )


def test_polygons_and_unused_vertices_of_an_obj(tmp_path: Path) -> None:
    path = write_obj(
        tmp_path / "cube.OBJ",
        np.concatenate([[[9.0, 9.0, 9.0]], CUBE.points]),
        CUBE.boundary_facets + 1,
    )
    surface = read_surface(path)
    assert surface.volume_m3 == pytest.approx(24, rel=1e-12)
    assert (len(surface.points), len(surface.triangles)) == (8, 12)


def test_the_volume_of_a_sphere_converges_with_second_order_and_is_the_same_far_away() -> None:
    exact = 4 / 3 * np.pi * RADIUS**3
    coarse, fine = (1 - sphere(h).volume_m3 / exact for h in (0.028, 0.014))
    assert 0 < fine < coarse / 3 < 0.03
    near = sphere(0.028)
    far = Surface(near.points + 1000, near.triangles)
    assert far.volume_m3 == pytest.approx(near.volume_m3, rel=1e-9)


PLUS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
TETRAHEDRON = PLUS + "f 1 3 2\nf 1 2 4\nf 2 3 4\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.ply", "", r"a surface must be an \.stl or \.obj file; got '\.ply'\.$"),
        ("a.obj", "", r"a surface must hold triangles; got none\.$"),
        ("a.stl", "", r"a surface must hold triangles; got none\.$"),
        ("a.obj", PLUS + "l 1 2\n", r"a surface must hold triangles; got none\.$"),
        (
            "a.obj",
            PLUS + "f 1 2 2\nf 1 1 3\n",
            r"a surface must hold triangles; got only points and lines\.$",
        ),
        (
            "a.obj",
            "v 0 0 zero\n",
            r"meshio cannot read it \(could not convert string to float: 'zero'\)\.$",
        ),
        ("a.stl", "solid\nvertex 0 0\n", r"meshio cannot read it \(\S.*\)\.$"),
        (
            "a.obj",
            TETRAHEDRON + "f 1 4 5\n",
            r"triangles must have points in \[1, 4\]; got 1 to 5\.$",
        ),
        (
            "a.obj",
            TETRAHEDRON + "f 1 4 -2\n",
            r"triangles must have points in \[1, 4\]; got -2 to 4\.$",
        ),
        (
            "a.obj",
            TETRAHEDRON.replace("v 1 0", "v nan 0") + "f 1 4 3\n",
            r"positions must be finite\.$",
        ),
        (
            "a.obj",
            TETRAHEDRON,
            r"the surface is not closed: 3 of its 6 edges are not shared by exactly two triangles\.$",
        ),
        ("a.obj", TETRAHEDRON + "f 1 4 3\nf 1 4 3\n", r"is not closed: 3 of its 6 edges"),
        (
            "a.obj",
            TETRAHEDRON + "f 1 3 4\n",
            r"the triangles are not consistently oriented: across 3 of 6 edges they turn over\.$",
        ),
        (
            "a.obj",
            TETRAHEDRON.replace("v 0 0 1", "v 1 1 0") + "f 1 4 3\n",
            r"the surface encloses no volume\.$",
        ),
    ],
)
def test_a_bad_surface_is_refused_in_one_line_that_names_the_file(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str, message: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SpecError, match="^" + re.escape(str(path)) + ": .*" + message) as caught:
        read_surface(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"none\.stl: no such file\.$"):
        read_surface(tmp_path / "none.stl")


# --- inside -----------------------------------------------------------------------------------------------------------


def test_points_are_inside_the_sphere_where_its_equation_says_so() -> None:
    surface = sphere(0.014)
    points = CENTRE + np.random.default_rng(0).uniform(-1.3 * RADIUS, 1.3 * RADIUS, size=(4000, 3))
    distance = np.linalg.norm(points - CENTRE, axis=1)
    clear = np.abs(distance - RADIUS) > 0.001
    expected = distance[clear] < RADIUS
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(inside(surface, points[clear]), expected)


def test_the_winding_number_is_whole_however_near_an_edge_or_a_corner() -> None:
    """A ray to a point of the cube's edges, faces' diagonals or corners would be counted twice, or never."""
    corners = CUBE.points[CUBE_TRIANGLES]
    rng = np.random.default_rng(0)
    share = rng.random((200, 12, 1))
    on_edges = (share * corners[:, 0] + (1 - share) * corners[:, 1]).reshape(-1, 3)
    centre = CUBE.points.mean(axis=0)
    for depth in (1e-3, 1e-6, 1e-9):
        for nearby, winding in [(-depth, 1), (depth, 0)]:
            points = np.concatenate([on_edges, CUBE.points])
            np.testing.assert_allclose(
                winding_numbers(corners, points + nearby * (points - centre)), winding, atol=1e-6
            )
    in_plane = np.array([[-1.0, 0.0, 0.0], [5.0, 3.0, 4.0], [2.0, 7.0, 2.0], [1.0, 1.5, 9.0]])
    assert not inside(Surface(CUBE.points, CUBE_TRIANGLES), in_plane).any()


def test_a_cavity_is_outside() -> None:
    outer = boundary(box_mesh((3.0, 3.0, 3.0), (1, 1, 1)))
    inner = boundary(box_mesh((1.0, 1.0, 1.0), (1, 1, 1)))
    body = Surface(
        np.concatenate([outer.points, inner.points + 1]),
        np.concatenate([outer.triangles, inner.triangles[:, ::-1] + 8]),
    )
    assert body.volume_m3 == pytest.approx(26)
    np.testing.assert_array_equal(
        inside(body, np.array([[1.5, 1.5, 1.5], [0.5, 1.5, 1.5], [3.5, 1.5, 1.5]])),
        [False, True, False],
    )
    assert voxel_mesh(body, (3, 3, 3)).n_cells == 26


# --- voxels -----------------------------------------------------------------------------------------------------------


def clipped(polygon: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a polygon (n, 3) in the unit cube at `low` (Sutherland & Hodgman 1974)."""
    for axis, sign in [(axis, sign) for axis in range(3) for sign in (1, -1)]:
        depth = (
            sign * (polygon[:, axis] - low[axis])
            if sign == 1
            else 1 - (polygon[:, axis] - low[axis])
        )
        kept = []
        for p, q, dp, dq in zip(
            polygon, np.roll(polygon, -1, axis=0), depth, np.roll(depth, -1), strict=True
        ):
            kept += [p] if dp >= 0 else []
            kept += [p + dp / (dp - dq) * (q - p)] if dp * dq < 0 else []
        if not kept:
            return np.empty((0, 3))
        polygon = np.array(kept)
    return polygon


def test_a_triangle_meets_the_cells_in_which_clipping_leaves_something_of_it() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-0.5, 3.5, size=(60, 1, 3)) + rng.uniform(
        -1.5, 1.5, size=(60, 3, 3)
    ) * rng.choice([0.1, 1.0, 5.0], size=(60, 1, 1))
    for triangle in corners:
        expected = [
            len(clipped(triangle, np.array(low, dtype=float))) > 0 for low in np.ndindex(3, 3, 3)
        ]
        np.testing.assert_array_equal(met_cells(triangle[None], (3, 3, 3), 0.5).ravel(), expected)


@pytest.mark.parametrize(
    "mesh", [box_mesh((0.3, 0.5, 0.7), (3, 4, 7)), l_mesh((0.3, 0.5, 0.7), (3, 4, 7), (1, 3))]
)
def test_the_voxels_of_a_body_of_whole_cells_are_its_cells(mesh: Mesh) -> None:
    offset = np.array([0.1, -7.0, 3.3])
    surface = boundary(mesh)
    voxels = voxel_mesh(Surface(surface.points + offset, surface.triangles), (3, 4, 7))
    np.testing.assert_array_equal(voxels.cells, mesh.cells)
    np.testing.assert_allclose(voxels.points, mesh.points + offset, rtol=0, atol=1e-14)
    assert voxels.grid_shape == mesh.grid_shape
    np.testing.assert_array_equal(voxels.grid_index, mesh.grid_index)


@pytest.mark.parametrize("cells", [(1, 1, 1), (4, 9, 7), (12, 12, 12)])
@pytest.mark.parametrize(
    "make",
    [liver_surface, lambda: sphere(0.02), lambda: Surface(CUBE.points + 0.1, CUBE_TRIANGLES)],
)
def test_every_point_of_a_surface_lies_in_a_cell(
    make: Callable[[], Surface], cells: tuple[int, int, int]
) -> None:
    surface = make()
    mesh = voxel_mesh(surface, cells)
    points = on_surface(surface, np.random.default_rng(0))
    matrix = interpolation_matrix(mesh, points)
    np.testing.assert_allclose(matrix @ mesh.points, points, rtol=0, atol=1e-12)


def test_a_body_thinner_than_a_cell_is_in_the_cells_that_it_passes() -> None:
    """No centre of a cell lies in the needle along the diagonal."""
    needle = Surface(
        np.array([[0.0, 0, 0], [1, 1, 1], [0.5, 0.52, 0.5], [0.5, 0.5, 0.53]]),
        np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
    )
    needle = needle if needle.volume_m3 > 0 else Surface(needle.points, needle.triangles[:, ::-1])
    mesh = voxel_mesh(needle, (5, 4, 3))
    assert mesh.n_cells < 60
    interpolation_matrix(mesh, on_surface(needle, np.random.default_rng(0)))


@pytest.mark.parametrize(("depth", "n_cells"), [(-1e-6, 3), (0.0, 3), (1e-12, 3), (1e-6, 4)])
def test_a_cell_that_a_body_enters_however_little_is_kept_and_one_that_it_touches_is_not(
    depth: float, n_cells: int
) -> None:
    surface = boundary(l_mesh((2.0, 1.0, 2.0), (2, 1, 2), (1, 1)))
    points = surface.points + depth * (surface.points == 1) * [1, 0, 0]
    assert voxel_mesh(Surface(points, surface.triangles), (2, 1, 2)).n_cells == n_cells


def test_cells_that_only_an_edge_joins_are_refused() -> None:
    part = boundary(box_mesh((1.0, 1.0, 1.0), (1, 1, 1)))
    both = Surface(
        np.concatenate([part.points, part.points + np.array([1, 1, 0])]),
        np.concatenate([part.triangles, part.triangles + 8]),
    )
    with pytest.raises(
        SpecError,
        match=r"^the 16 cells of the body in a grid of 4 x 4 x 2 form 2 parts that no face joins; use more cells\.$",
    ):
        voxel_mesh(both, (4, 4, 2))


# --- tetrahedra -------------------------------------------------------------------------------------------------------


def volumes(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c, d = np.moveaxis(mesh.points[mesh.cells], 1, 0)
    return np.asarray(((b - a) * np.cross(c - a, d - a)).sum(axis=1) / 6)


def dihedral_angles(mesh: Mesh) -> NDArray[np.float64]:
    """(6, n_cells) degrees."""
    corners, angles = mesh.points[mesh.cells], []
    for i, j in combinations(range(4), 2):
        k, l = (n for n in range(4) if n not in (i, j))
        u, v = (
            np.cross(corners[:, j] - corners[:, i], corners[:, n] - corners[:, i]) for n in (k, l)
        )
        angles.append(
            np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1)))
        )
    return np.array(angles)


def check_tetrahedra(mesh: Mesh) -> None:
    assert (volumes(mesh) > 0).all()
    assert dihedral_angles(mesh).min() > 10.7
    assert dihedral_angles(mesh).max() < 164.8
    faces = np.sort(mesh.cells[:, FACES[4]].reshape(-1, 3), axis=1)
    assert set(np.unique(faces, axis=0, return_counts=True)[1]) == {1, 2}
    shared, directed = edge_uses(mesh.boundary_facets)
    assert (shared == 2).all()
    assert (directed == 1).all()
    assert len(np.unique(mesh.cells)) == mesh.n_nodes
    # Were a face not shared by whole triangles, the boundary would enclose another volume.
    assert boundary(mesh).volume_m3 == pytest.approx(volumes(mesh).sum(), rel=1e-9)


@pytest.mark.parametrize("spacing_m", [0.05, 0.03, 0.0213, 0.0147])
def test_tetrahedra_of_a_sphere_are_well_shaped_and_end_on_it(spacing_m: float) -> None:
    mesh = tetrahedral_mesh(sphere_level, ALL_AROUND, spacing_m)
    check_tetrahedra(mesh)
    on_boundary = mesh.points[np.unique(mesh.boundary_facets)]
    np.testing.assert_allclose(np.linalg.norm(on_boundary - CENTRE, axis=1), RADIUS, rtol=1e-12)
    assert volumes(mesh).sum() == pytest.approx(
        4 / 3 * np.pi * RADIUS**3, rel=0.5 * (spacing_m / RADIUS) ** 2
    )
    assert (np.diff(mesh.points[:, 0]) >= 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_tetrahedra_of_bumpy_bodies_are_well_shaped(seed: int) -> None:
    """All stencils occur, with the surface at every angle."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(6, 3)) * 60, rng.uniform(0, 6, size=6)
    mesh = tetrahedral_mesh(
        lambda x: sphere_level(x) + 6e-4 * np.sin(x @ waves.T + phases).sum(axis=1),
        ALL_AROUND + np.array([[-0.04], [0.04]]),
        0.012,
    )
    check_tetrahedra(mesh)


def test_nodes_are_numbered_along_the_longest_axis() -> None:
    mesh = tetrahedral_mesh(
        lambda x: (x**2 / [1, 4, 1]).sum(axis=1) - 1, np.array([[-1.0, -2, -1], [1, 2, 1]]), 0.4
    )
    assert (np.diff(mesh.points[:, 1]) >= 0).all()
    assert np.ptp(mesh.cells, axis=1).max() < mesh.n_nodes / 3


def test_a_body_that_the_lattice_misses_or_that_reaches_out_of_it_is_refused() -> None:
    with pytest.raises(
        SpecError, match=r"^no point of a lattice of 1 m lies in the body; use a smaller spacing\.$"
    ):
        tetrahedral_mesh(
            lambda x: sphere_level(x + CENTRE + 0.25), np.array([[-1.0] * 3, [1.0] * 3]), 1.0
        )
    with pytest.raises(
        SpecError, match=r"^the body exceeds its bounds, \[.*\] to \[.*\] m\.$"
    ):
        tetrahedral_mesh(sphere_level, ALL_AROUND + np.array([[0.08], [0.0]]), 0.01)


def test_a_body_that_is_a_hinge_is_refused() -> None:
    """The body lies in two opposite quadrants around a line of the lattice."""

    def quadrants(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(np.abs(x).max(axis=1) > 2.2, 1.0, -x[:, 0] * x[:, 1])

    with pytest.raises(
        SpecError,
        match=r"^with a spacing of 1 m parts of the body touch along \d+ edges only; use a smaller one\.$",
    ):
        tetrahedral_mesh(quadrants, np.array([[-3.0] * 3, [3.0] * 3]), 1.0)


# --- the liver --------------------------------------------------------------------------------------------------------


def test_the_liver_is_a_closed_surface_of_its_length_on_its_level_set() -> None:
    surface = liver_surface()
    shared, directed = edge_uses(surface.triangles)
    assert (shared == 2).all()
    assert (directed == 1).all()
    assert (
        len(surface.points) - len(shared) + len(surface.triangles) == 2
    )  # Euler's formula: one part, no handle
    assert surface.volume_m3 > 0
    size = np.ptp(surface.bounds, axis=0)
    assert size[0] == size.max() == pytest.approx(0.2, abs=1e-4)
    assert (size[1:] > 0.13).all()
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    outwards = (a + b + c) / 3 + 1e-3 * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    assert (liver_level(outwards) > liver_level((a + b + c) / 3)).all()
    assert np.abs(liver_level(surface.points)).max() < 1e-9


def test_the_liver_has_the_cells_and_nodes_of_the_paper_within_a_percent() -> None:
    mesh = voxel_mesh(liver_surface(), (15, 14, 15))
    assert (mesh.n_cells, mesh.n_nodes, mesh.grid_shape) == (726, 1118, (16, 15, 16))
    assert mesh.n_cells == pytest.approx(732, rel=0.01)
    assert mesh.n_nodes == pytest.approx(1109, rel=0.01)


def test_the_liver_is_held_in_the_notch_between_its_lobes() -> None:
    assert abs(liver_level(np.array([BETWEEN_LOBES]))[0]) < 1e-3
    # A notch is hollow: the chord between the lobes' surfaces on its two sides leaves the body.
    rng = np.random.default_rng(0)
    near = liver_surface().points[
        np.linalg.norm(liver_surface().points - BETWEEN_LOBES, axis=1) < 0.04
    ]
    chords = near[rng.integers(len(near), size=(2000, 2))].mean(axis=1)
    assert (liver_level(chords) > 0.02).any()


def test_the_liver_of_tetrahedra_is_about_as_fine_as_the_papers_and_has_the_volume_of_its_surface() -> (
    None
):
    mesh = liver_tetrahedra()
    check_tetrahedra(mesh)
    assert (mesh.n_cells, mesh.n_nodes) == (4567, 1118)
    assert mesh.n_cells == pytest.approx(4859, rel=0.065)
    assert mesh.n_nodes == pytest.approx(1059, rel=0.065)
    assert volumes(mesh).sum() == pytest.approx(liver_surface().volume_m3, rel=0.03)
    assert np.abs(liver_level(mesh.points[np.unique(mesh.boundary_facets)])).max() < 1e-9
