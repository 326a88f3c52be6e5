"""U-Mesh as one ONNX graph, from nodal forces to nodal displacements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.learning.onnx_graph import GraphBuilder
from mor_bench.scene.scene import Scene
from mor_bench.surrogates.umesh.grid import PaddedGrid
from mor_bench.surrogates.umesh.network import UNet

if TYPE_CHECKING:
    import onnx


def umesh_graph(scene: Scene, grid: PaddedGrid, network: UNet, force_scale: float, displacement_scale: float) -> onnx.ModelProto:
    """N, network and N^T with the scales of both ends, all in float32; supports are zero."""
    n_nodes, weights = scene.mesh.n_nodes, grid.grid.weights
    graph = GraphBuilder()
    x = graph.add("Mul", "forces", graph.constant(np.array([1.0 / force_scale], dtype=np.float32)))
    x = _sparse_product(graph, sp.csr_array(weights.T), x)  # (n, x y z, 3)
    x = graph.add("Reshape", x, graph.constant(np.array([-1, *grid.shape, 3])))
    x = graph.network(network, graph.add("Transpose", x, perm=[0, 4, 1, 2, 3]))
    x = graph.add("Transpose", x, perm=[0, 2, 3, 4, 1])
    x = _sparse_product(graph, weights, graph.add("Reshape", x, graph.constant(np.array([-1, weights.shape[1], 3]))))
    free = np.full((n_nodes, 1), displacement_scale, dtype=np.float32)
    free[scene.fixed_nodes] = 0.0
    graph.add("Mul", x, graph.constant(free), name="displacements")
    described = {
        "scene": scene.name,
        "scene_spec": scene.spec.model_dump_json(),
        "units": "forces in N, displacements in m, one row per node of the scene's mesh",
    }
    shape = ["n", n_nodes, 3]
    return graph.model(f"U-Mesh of {scene.name}", ("forces", shape), ("displacements", shape), described)


def _sparse_product(graph: GraphBuilder, matrix: sp.csr_array[np.float32], values: str) -> str:
    """A v along the second of three axes: rows of v gathered, as many for each row of A as its longest has, and their weighted sum.

    ONNX has no sparse product. Where every row of A has one entry at most, and that is 1, rows are only moved.
    """
    lengths = np.diff(matrix.indptr)
    longest, n_columns = max(int(lengths.max()), 1), matrix.shape[1]
    places: NDArray[np.int64] = np.full((matrix.shape[0], longest), n_columns)  # a row of zeros that is put behind the last
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
