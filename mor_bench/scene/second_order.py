"""Tetrahedra with ten nodes (T10), made from a mesh of T4 by nodes in the middles of its edges."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import TET_EDGES, Mesh, along_longest_axis, inverse_of
from mor_bench.specs import DatasetSpec


def with_middles(
    mesh: Mesh, point_sets: Mapping[str, NDArray[np.int64]]
) -> tuple[Mesh, dict[str, NDArray[np.int64]]]:
    """Return a mesh of T4 as T10 with straight edges, and the sets of nodes.

    Edges stay straight, so the body keeps its shape. A middle belongs to a set if both ends of its
    edge do. A mesh on a regular grid lies on the grid with half the spacing. Otherwise nodes are
    numbered along the longest axis, for a small bandwidth.
    """
    edges = np.sort(mesh.cells[:, TET_EDGES].reshape(-1, 2), axis=1)
    ends, number = np.unique(edges, axis=0, return_inverse=True)
    points = np.concatenate([mesh.points, mesh.points[ends].mean(axis=1)])
    cells = np.hstack([mesh.cells, mesh.n_nodes + number.reshape(-1, len(TET_EDGES))])
    shape, index = None, None
    if mesh.grid_shape is not None and mesh.grid_index is not None:
        nx, ny, nz = (2 * n - 1 for n in mesh.grid_shape)
        places = np.stack(np.unravel_index(mesh.grid_index, mesh.grid_shape), axis=1)
        places = np.concatenate([2 * places, places[ends].sum(axis=1)])
        shape, index = (nx, ny, nz), np.ravel_multi_index(tuple(places.T), (nx, ny, nz))
    order = along_longest_axis(points) if index is None else np.argsort(index)
    place = inverse_of(order)
    sets = {}
    for name, nodes in point_sets.items():
        between = np.flatnonzero(np.isin(ends, nodes).all(axis=1))
        sets[name] = np.sort(place[np.append(nodes, mesh.n_nodes + between)])
    kept = None if index is None else index[order]
    return Mesh(points[order], place[cells], shape, kept), sets


def in_elements(
    spec: DatasetSpec, mesh: Mesh, point_sets: Mapping[str, NDArray[np.int64]]
) -> tuple[Mesh, Mapping[str, NDArray[np.int64]]]:
    """Return the mesh in the elements of a dataset file; `SpecError` if it has others."""
    wanted, n_nodes = spec.discretisation, mesh.cells.shape[1]
    element = "hexahedron" if n_nodes == 8 else "tetrahedron"
    if element != wanted.element:
        raise SpecError(
            f"`discretisation.element` must be {element!r}, as in the mesh; got {wanted.element!r}."
        )
    if n_nodes == 10 and wanted.order == 1:
        raise SpecError("`discretisation.order` must be 2, as in the mesh; got 1.")
    promote = (n_nodes, wanted.order) == (4, 2)
    return with_middles(mesh, point_sets) if promote else (mesh, point_sets)
