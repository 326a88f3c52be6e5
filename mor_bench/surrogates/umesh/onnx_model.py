"""U-Mesh as one ONNX graph, from nodal forces to nodal displacements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import UnavailableBackendError
from mor_bench.learning.onnx_graph import GraphBuilder
from mor_bench.mechanics.observed import LinearResponse
from mor_bench.scene.scene import Scene
from mor_bench.surrogates.umesh.network import UNet
from mor_bench.surrogates.umesh.padded_grid import PaddedGrid

if TYPE_CHECKING:
    import onnx


MAX_RESPONSE_DOFS = 4096
"""Largest number of unknowns of a linear response that is written, as a dense 64 MiB matrix."""


@dataclass(frozen=True)
class UMeshParts:
    """The parts of a U-Mesh that its predictions use.

    Attributes
    ----------
    scene : Scene
    grid : PaddedGrid
    network : UNet
    scales : tuple of float
        Scales of the input and of the network's answer.
    at_rest : (n_nodes, 3) or None
        Scaled offset that is subtracted from every answer of the network.
    response : LinearResponse or None
        If given, it is the network's input, and the network answers with the nonlinear remainder.
    """

    scene: Scene
    grid: PaddedGrid
    network: UNet
    scales: tuple[float, float]
    at_rest: NDArray[np.float32] | None
    response: LinearResponse | None


def umesh_graph(parts: UMeshParts) -> onnx.ModelProto:
    """Return `UMesh.predict` in float32 as a graph, scaling included.

    Supports do not move. With `at_rest`, no load gives no displacement. In a scene with observed
    nodes, values at other nodes are ignored and may be NaN.

    Raises
    ------
    UnavailableBackendError
        If the linear response has more than `MAX_RESPONSE_DOFS` unknowns.
    """
    scene, weights, response = parts.scene, parts.grid.grid.weights, parts.response
    n_nodes, output_scale = scene.mesh.n_nodes, parts.scales[1]
    graph = GraphBuilder()
    loads = _given(graph, scene)
    given, to_grid = loads, sp.csr_array(weights.T)
    if response is not None:
        given = _linear_response(graph, scene, response, loads)
    if response is not None or scene.observed_nodes is not None:
        shares = parts.grid.shares.numpy().ravel()
        to_grid = sp.csr_array(sp.diags_array(1.0 / shares) @ weights.T)
    x = graph.add("Mul", given, _scalar(graph, 1.0 / parts.scales[0]))
    x = _sparse_product(graph, to_grid, x)  # (n, x y z, 3)
    x = graph.add("Reshape", x, graph.constant(np.array([-1, *parts.grid.shape, 3])))
    x = graph.network(parts.network, graph.add("Transpose", x, perm=[0, 4, 1, 2, 3]))
    x = graph.add("Transpose", x, perm=[0, 2, 3, 4, 1])
    x = graph.add("Reshape", x, graph.constant(np.array([-1, weights.shape[1], 3])))
    x = _sparse_product(graph, weights, x)
    if parts.at_rest is not None:
        x = graph.add("Sub", x, graph.constant(parts.at_rest))
    if response is not None:
        x = graph.add("Add", graph.add("Mul", x, _scalar(graph, output_scale)), given)
    if parts.at_rest is not None:  # other runtimes round the network at rest differently
        largest = graph.add("ReduceMax", graph.add("Abs", loads), axes=[1, 2], keepdims=1)
        x = graph.add("Mul", x, graph.add("Sign", largest))
    free = np.full((n_nodes, 3), output_scale if response is None else 1.0, dtype=np.float32)
    free.ravel()[scene.fixed_dofs] = 0.0
    graph.add("Mul", x, graph.constant(free), name="displacements")
    shape = ["n", n_nodes, 3]
    return graph.model(
        f"U-Mesh of {scene.name}", ("forces", shape), ("displacements", shape), _described(scene)
    )


def _described(scene: Scene) -> dict[str, str]:
    given = "forces in N"
    if scene.observed_nodes is not None:
        given = "`forces` are displacements of the observed nodes in m"
    return {
        "scene": scene.name,
        "scene_spec": scene.spec.model_dump_json(),
        "units": f"{given}, displacements in m, one row per node of the scene's mesh",
    }


def _scalar(graph: GraphBuilder, value: float) -> str:
    return graph.constant(np.array([value], dtype=np.float32))


def _given(graph: GraphBuilder, scene: Scene) -> str:
    """Return the input, with zeros at nodes that are not observed."""
    if scene.observed_nodes is None:
        return "forces"
    seen = np.zeros((scene.mesh.n_nodes, 1), dtype=np.bool_)
    seen[scene.observed_nodes] = True
    return graph.add("Where", graph.constant(seen), "forces", _scalar(graph, 0.0))


def _linear_response(
    graph: GraphBuilder, scene: Scene, response: LinearResponse, loads: str
) -> str:
    """Add the product with a dense compliance; ONNX has no sparse solve."""
    n_nodes, n_dofs = scene.mesh.n_nodes, scene.mesh.n_dofs
    if scene.contact:
        raise UnavailableBackendError(
            f"the response of {scene.name} to its instrument is not linear, and is not written "
            "as ONNX."
        )
    if n_dofs > MAX_RESPONSE_DOFS:
        raise UnavailableBackendError(
            f"the linear response of {scene.name} has {n_dofs:,} unknowns; ONNX has no sparse "
            f"solve, and a dense matrix is written for at most {MAX_RESPONSE_DOFS:,}."
        )
    compliance = response.respond(np.eye(n_dofs)).astype(np.float32)
    flat = graph.add("Reshape", loads, graph.constant(np.array([-1, n_dofs])))
    solved = graph.add("MatMul", flat, graph.constant(compliance))
    return graph.add("Reshape", solved, graph.constant(np.array([-1, n_nodes, 3])))


def _sparse_product(graph: GraphBuilder, matrix: sp.csr_array[np.float32], values: str) -> str:
    """Add A v along the second of three axes.

    ONNX has no sparse product. So the graph computes a weighted sum of rows of v for each row of A.
    All sums have as many terms as the longest row of A has entries. If every row of A has at most
    one entry, equal to 1, rows are only moved.
    """
    lengths = np.diff(matrix.indptr)
    longest, n_columns = max(int(lengths.max()), 1), matrix.shape[1]
    # The last row is padding: zeros.
    places: NDArray[np.int64] = np.full((matrix.shape[0], longest), n_columns)
    weights: NDArray[np.float32] = np.zeros((matrix.shape[0], longest, 1), dtype=np.float32)
    entry = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], lengths)
    row = np.repeat(np.arange(matrix.shape[0]), lengths)
    places[row, entry] = matrix.indices
    weights[row, entry, 0] = matrix.data
    padded = graph.add("Pad", values, graph.constant(np.array([0, 0, 0, 0, 1, 0])))
    if longest == 1 and (matrix.data == 1).all():
        return graph.add("Gather", padded, graph.constant(places[:, 0]), axis=1)
    gathered = graph.add("Gather", padded, graph.constant(places), axis=1)  # (n, rows, longest, 3)
    weighted = graph.add("Mul", gathered, graph.constant(weights))
    return graph.add("ReduceSum", weighted, graph.constant(np.array([2])), keepdims=0)
