"""Constant pressures: a part of the pre-load that acts before and during every load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.problems import Problems
from mor_bench.scene.regions import Cloud
from mor_bench.scene.springs import facets_in, surface_quadrature
from mor_bench.specs import DatasetSpec


@dataclass(frozen=True)
class HeldPressure:
    """A constant pressure on facets of a surface.

    Attributes
    ----------
    pressure_pa : float
        It pushes into the body.
    follower : bool
        Whether it acts on the deformed facets, along their normals.
    facets : (n_facets, 4, 3 or 6) int64
        Facets of the mesh's boundary, or of a smooth surface inside the mesh.
    points : (n, 3) float64
        Quadrature points of the undeformed facets, m.
    vectors : (n, 3) float64
        Outward normals at the points; their lengths are areas, m².
    """

    pressure_pa: float
    follower: bool
    facets: NDArray[np.int64]
    points: NDArray[np.float64]
    vectors: NDArray[np.float64]

    def dead_forces(self, mesh: Mesh) -> NDArray[np.float64]:
        """Return the nodal forces (n_nodes, 3), N, on the undeformed body."""
        shares = interpolation_matrix(mesh, self.points)
        return np.asarray(-self.pressure_pa * (shares.T @ self.vectors))


def held_pressures(
    spec: DatasetSpec,
    surface: Facets,
    point_sets: Mapping[str, NDArray[np.int64]],
    *,
    embedded: bool,
) -> tuple[HeldPressure, ...]:
    """Return the constant pressures of a dataset file on a surface.

    Raises
    ------
    SpecError
        If a region holds no facet, or a pressure follows an embedded surface.
    """
    cloud, found = Cloud(surface.points, np.unique(surface.facets), point_sets), []
    with Problems() as problems:
        for number, given in enumerate(spec.constant_pressures):
            key = f"constant_pressures[{number}]"
            if given.follower and embedded:
                problems.found.append(
                    f"`{key}.follower` must be false where loads act on a smooth surface that the "
                    "mesh only contains."
                )
            with problems.keep():
                facets = facets_in(surface, cloud, given.region, f"{key}.region")
                found.append(_on_facets(given.pressure_pa, given.follower, surface, facets))
    return tuple(found)


def _on_facets(
    pressure_pa: float, follower: bool, surface: Facets, facets: NDArray[np.int64]
) -> HeldPressure:
    return HeldPressure(pressure_pa, follower, facets, *surface_quadrature(surface, facets)[:2])


def followers_of(pressures: Sequence[HeldPressure]) -> tuple[HeldPressure, ...]:
    """Return the pressures that follow the deformed surface."""
    return tuple(held for held in pressures if held.follower)


def pressures_on_parts(
    pressures: Sequence[HeldPressure], mesh: Mesh, parents: NDArray[np.int64]
) -> tuple[HeldPressure, ...]:
    """Return the pressures on the parts of their facets, on a mesh whose cells were divided.

    Parameters
    ----------
    pressures : sequence of HeldPressure
        Pressures on the boundary of the mesh before.
    mesh : Mesh
        The mesh with divided cells.
    parents : (n_nodes, n) int64
        Nodes of the mesh before, between which each node lies.
    """
    surface = Facets(mesh.points, mesh.boundary_facets)
    return tuple(
        _on_facets(own.pressure_pa, own.follower, surface, own_parts(own.facets, surface, parents))
        for own in pressures
    )


def own_parts(
    facets: NDArray[np.int64], surface: Facets, parents: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the facets of a divided surface that are parts of some facets before."""
    return surface.within(np.flatnonzero(np.isin(parents, facets).all(axis=1)))
