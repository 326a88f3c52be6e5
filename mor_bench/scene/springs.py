"""Winkler foundations: linear springs on parts of the surface, as points with stiffnesses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.problems import Problems
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.scene.triangle_rules import DEGREE_4, DEGREE_4_WEIGHTS, quadratic_triangle
from mor_bench.specs import AXES, DatasetSpec, Region
from mor_bench.specs.support_spec import Spring

_X, _W = np.polynomial.legendre.leggauss(3)
_SIXTHS = np.full((3, 3), 1.0 / 6.0) + 0.5 * np.eye(3)
"""Points of a rule for triangles that is exact for quadratic polynomials."""


@dataclass(frozen=True)
class Springs:
    """Springs at the quadrature points of a surface.

    Attributes
    ----------
    points : (n, 3) float64
        Positions, m.
    stiffness : (n, 3, 3) float64
        Force per displacement, N/m.
    facets : (n_facets, n_corners) int64
        Facets of the surface.
    """

    points: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    facets: NDArray[np.int64]

    def matrix(self, mesh: Mesh) -> sp.csr_array:
        """Return the stiffness over the nodal dofs of a mesh, (n_dofs, n_dofs), N/m."""
        shape = sp.kron(interpolation_matrix(mesh, self.points), sp.eye_array(3), format="csr")
        numbers = np.arange(len(self.points) + 1)
        blocks = sp.bsr_array((self.stiffness, numbers[:-1], numbers))
        return sp.csr_array(shape.T @ blocks.tocsr() @ shape)


def foundations(
    spec: DatasetSpec, surface: Facets, point_sets: Mapping[str, NDArray[np.int64]]
) -> tuple[Springs, ...]:
    """Return the springs of a dataset file on a surface.

    Raises
    ------
    SpecError
        If no facet has all corners in some region.
    """
    cloud, found = Cloud(surface.points, np.unique(surface.facets), point_sets), []
    with Problems() as problems:
        for number, spring in enumerate(spec.springs):
            with problems.keep():
                facets = facets_in(surface, cloud, spring.region, f"springs[{number}].region")
                found.append(_on_facets(spring, surface, facets))
    return tuple(found)


def facets_in(surface: Facets, cloud: Cloud, region: Region, key: str) -> NDArray[np.int64]:
    """Return the facets with all corners in a region; `SpecError` if there is none."""
    facets = surface.within(region_points(cloud, region, key))
    if len(facets) == 0:
        raise SpecError(f"`{key}` holds no facet of the surface.")
    return facets


def matrix_of(springs: Sequence[Springs], mesh: Mesh) -> sp.csr_array | None:
    """Return the stiffness of all springs over the nodal dofs, N/m; None without springs."""
    matrices = [each.matrix(mesh) for each in springs]
    return sp.csr_array(sum(matrices[1:], matrices[0])) if matrices else None


def _on_facets(spring: Spring, surface: Facets, facets: NDArray[np.int64]) -> Springs:
    points, vectors, _ = surface_quadrature(surface, facets)
    areas = np.linalg.norm(vectors, axis=1)[:, None, None]
    if spring.normal:
        directions = vectors[:, :, None] * vectors[:, None] / areas
    else:
        directions = areas * np.diag([float(axis in spring.components) for axis in AXES])
    return Springs(points, spring.stiffness_n_m3 * directions, facets)


def on_parts(springs: Springs, spring: Spring, mesh: Mesh, parents: NDArray[np.int64]) -> Springs:
    """Return the springs on the parts of their facets, on a mesh whose cells were divided.

    At the points of the whole facets, they would be springs of single nodes on a fine mesh.

    Parameters
    ----------
    springs : Springs
        Springs on the boundary of the mesh before.
    spring : Spring
        Their part of the dataset file.
    mesh : Mesh
        The mesh with divided cells.
    parents : (n_nodes, n) int64
        Nodes of the mesh before, between which each node lies.
    """
    surface = Facets(mesh.points, mesh.boundary_facets)
    nodes = np.flatnonzero(np.isin(parents, springs.facets).all(axis=1))
    return _on_facets(spring, surface, surface.within(nodes))


def surface_quadrature(
    surface: Facets, facets: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return points (n, 3), m, on facets and normals (n, 3) whose lengths are areas, m².

    The third array holds the shape functions of a facet at its points, (n_points, n_corners).
    """
    corners = surface.points[facets]
    if facets.shape[1] == 3:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        shapes = _SIXTHS
        points = np.einsum("pa,fai->fpi", shapes, corners)
        vectors = np.repeat(normals[:, None] / 6.0, 3, axis=1)
    elif facets.shape[1] == 6:
        shapes, derivatives = quadratic_triangle(DEGREE_4)
        along = np.einsum("pad,fai->dfpi", derivatives, corners)
        points = np.einsum("pa,fai->fpi", shapes, corners)
        vectors = np.cross(along[0], along[1]) * DEGREE_4_WEIGHTS[:, None]
    else:
        s, t = (a.ravel() for a in np.meshgrid(_X, _X))
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        u, v = 1 + np.outer(s, signs[:, 0]), 1 + np.outer(t, signs[:, 1])
        along_s = np.einsum("pa,fai->fpi", signs[:, 0] * v / 4, corners)
        along_t = np.einsum("pa,fai->fpi", signs[:, 1] * u / 4, corners)
        shapes = u * v / 4
        points = np.einsum("pa,fai->fpi", shapes, corners)
        vectors = np.cross(along_s, along_t) * np.outer(_W, _W).reshape(-1, 1)
    return points.reshape(-1, 3), vectors.reshape(-1, 3), shapes
