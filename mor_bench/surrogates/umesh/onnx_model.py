"""U-Mesh as one ONNX graph, from nodal forces to nodal displacements."""

from __future__ import annotations

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
"""Of a scene whose linear response is written, as a dense matrix: 64 MiB."""


def umesh_graph(
    scene: Scene,
    grid: PaddedGrid,
    network: UNet,
    input_scale: float,
    output_scale: float,
    at_rest: NDArray[np.float32] | None,
    response: LinearResponse | None,
) -> onnx.ModelProto:
    """`UMesh.predict` in float32, scaling included; supports are zero, and so is all where nothing is given if `at_rest` is.

    In a scene with observed nodes, what the others hold is not looked at, and may be NaN.

    Parameters
    ----------
    at_rest : (n_nodes, 3), optional
        What is taken off every answer of the network, scaled.
    response : LinearResponse, optional
        The network is given this linear response and answers with the rest of the displacement.

    Raises
    ------
    UnavailableBackendError
        If the linear response is wanted of more than `MAX_RESPONSE_DOFS` unknowns.
    """
    n_nodes, n_dofs, weights = scene.mesh.n_nodes, scene.mesh.n_dofs, grid.grid.weights
    graph = GraphBuilder()
    given, to_grid = "forces", sp.csr_array(weights.T)
    if scene.observed_nodes is not None:
        seen = np.zeros((n_nodes, 1), dtype=np.bool_)
        seen[scene.observed_nodes] = True
        given = graph.add(
            "Where", graph.constant(seen), given, graph.constant(np.zeros(1, dtype=np.float32))
        )
    loads = given
    if response is not None:
        if n_dofs > MAX_RESPONSE_DOFS:
            raise UnavailableBackendError(
                f"the linear response of {scene.name} has {n_dofs:,} unknowns; ONNX has no sparse solve, and a dense matrix is written for at "
                f"most {MAX_RESPONSE_DOFS:,}."
            )
        compliance = response.respond(np.eye(n_dofs)).astype(np.float32)
        flat = graph.add("Reshape", loads, graph.constant(np.array([-1, n_dofs])))
        solved = graph.add("MatMul", flat, graph.constant(compliance))
        given = graph.add("Reshape", solved, graph.constant(np.array([-1, n_nodes, 3])))
    if response is not None or scene.observed_nodes is not None:
        to_grid = sp.csr_array(sp.diags_array(1.0 / grid.shares.numpy().ravel()) @ weights.T)
    x = graph.add("Mul", given, graph.constant(np.array([1.0 / input_scale], dtype=np.float32)))
    x = _sparse_product(graph, to_grid, x)  # (n, x y z, 3)
    x = graph.add("Reshape", x, graph.constant(np.array([-1, *grid.shape, 3])))
    x = graph.network(network, graph.add("Transpose", x, perm=[0, 4, 1, 2, 3]))
    x = graph.add("Transpose", x, perm=[0, 2, 3, 4, 1])
    x = _sparse_product(
        graph, weights, graph.add("Reshape", x, graph.constant(np.array([-1, weights.shape[1], 3])))
    )
    if at_rest is not None:
        x = graph.add("Sub", x, graph.constant(at_rest))
    if response is not None:
        scaled = graph.add("Mul", x, graph.constant(np.array([output_scale], dtype=np.float32)))
        x = graph.add("Add", scaled, given)
    free_nodes = np.full((n_nodes, 1), output_scale if response is None else 1.0, dtype=np.float32)
    free_nodes[scene.fixed_nodes] = 0.0
    if at_rest is not None:  # another runtime rounds the network at rest otherwise
        loaded = graph.add(
            "Sign", graph.add("ReduceMax", graph.add("Abs", loads), axes=[1, 2], keepdims=1)
        )
        x = graph.add("Mul", x, loaded)
    graph.add("Mul", x, graph.constant(free_nodes), name="displacements")
    given_in = (
        "forces in N"
        if scene.observed_nodes is None
        else "`forces` are displacements of the observed nodes in m"
    )
    described = {
        "scene": scene.name,
        "scene_spec": scene.spec.model_dump_json(),
        "units": f"{given_in}, displacements in m, one row per node of the scene's mesh",
    }
    shape = ["n", n_nodes, 3]
    return graph.model(
        f"U-Mesh of {scene.name}", ("forces", shape), ("displacements", shape), described
    )


def _sparse_product(graph: GraphBuilder, matrix: sp.csr_array[np.float32], values: str) -> str:
    """A v along the second of three axes: rows of v gathered, as many for each row of A as its longest has, and their weighted sum.

    ONNX has no sparse product. Where every row of A has one entry at most, and that is 1, rows are only moved.
    """
    lengths = np.diff(matrix.indptr)
    longest, n_columns = max(int(lengths.max()), 1), matrix.shape[1]
    places: NDArray[np.int64] = np.full(
        (matrix.shape[0], longest), n_columns
    )  # a row of zeros that is put behind the last
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
