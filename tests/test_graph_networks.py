"""Graph networks agree with plain sums over edges, and carry a load as far as they should."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.snapshots.dataset import Dataset
from tests.irregular import irregular_box

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402 - torch is there

from mor_bench.surrogates.field_network import initialise  # noqa: E402
from mor_bench.surrogates.graph_coarsening import GraphLevel, position_ranks  # noqa: E402
from mor_bench.surrogates.graph_layers import Graph, Selection, mesh_pairs  # noqa: E402
from mor_bench.surrogates.graph_u_net import GraphUNet, Grouping  # noqa: E402
from mor_bench.surrogates.mesh_graph_net import GraphNetwork, MessagePassing  # noqa: E402

MESHES = {
    "hexahedra": box_mesh((2.0, 1.0, 1.0), (3, 2, 2)),
    "tetrahedra": irregular_box((2.0, 1.0, 1.0), (3, 2, 2), tetrahedra=True),
}
BEAM = box_mesh((16.0, 1.0, 1.0), (16, 1, 1))
FAR = 4 * 16
"""A node at the free end of `BEAM`; the first four nodes are fixed."""


def random(*shape: int, seed: int = 0, dtype: Any = None) -> Any:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=dtype)


def graph_of(mesh: Mesh) -> Graph:
    return Graph(mesh.points, mesh_pairs(mesh))


def drawn(network: Any) -> Any:
    initialise(network, torch.Generator().manual_seed(0))
    return network


def answer_of(network: Any, fields: Any) -> Any:
    with torch.no_grad():
        return network(network.encode(fields))


@pytest.mark.parametrize("name", MESHES)
def test_a_graph_has_the_edges_of_the_cells_in_either_direction(name: str) -> None:
    mesh = MESHES[name]
    graph = graph_of(mesh)
    order = graph.order.numpy()
    assert sorted(order) == list(range(mesh.n_nodes))
    senders, receivers = (order[s.index.numpy()] for s in (graph.senders, graph.receivers))
    edges = list(zip(senders.tolist(), receivers.tolist(), strict=True))
    pairs = set(edges)
    assert len(pairs) == len(edges) == graph.n_edges
    assert pairs == {(r, s) for s, r in pairs}
    relative = mesh.points[senders] - mesh.points[receivers]
    lengths = np.linalg.norm(relative, axis=1)
    shapes = np.column_stack([relative, lengths]) / lengths.mean()
    np.testing.assert_allclose(graph.shapes.numpy(), shapes, atol=1e-6)
    if name == "hexahedra":
        assert graph.n_edges == 2 * (3 * 3 * 3 + 4 * 2 * 3 + 4 * 3 * 2)
        np.testing.assert_allclose(np.unique(lengths.round(9)), [0.5, round(2 / 3, 9)])
    else:  # each pair of nodes in a tetrahedron is an edge
        assert pairs == {(int(a), int(b)) for c in mesh.cells for a in c for b in c if a != b}


def test_a_selection_and_its_transpose_agree_with_a_matrix() -> None:
    """Some rows have no entry, and one has five."""
    index = np.array([3, 0, 3, 5, 3, 3, 1, 0, 3])
    selection = Selection(index, 7)
    matrix = torch.from_numpy(np.eye(7)[index])
    rows, entries = random(7, 2, dtype=torch.float64), random(9, 2, dtype=torch.float64)
    torch.testing.assert_close(selection.take(rows), matrix @ rows)
    torch.testing.assert_close(selection.sum(entries), matrix.T @ entries)
    for function, values in ((selection.take, rows), (selection.sum, entries)):
        assert torch.autograd.gradcheck(function, values.requires_grad_())


@pytest.mark.parametrize("name", MESHES)
def test_summed_messages_and_their_gradients_agree_with_matrices(name: str) -> None:
    graph = graph_of(MESHES[name])
    n, m = graph.n_nodes, graph.n_edges
    senders, receivers = (
        torch.nn.functional.one_hot(s.index, n).double() for s in (graph.senders, graph.receivers)
    )
    inputs = [
        random(*shape, seed=seed, dtype=torch.float64).requires_grad_()
        for seed, shape in enumerate([(n, 2, 3), (n, 2, 3), (m, 3)])
    ]
    a, b, c = inputs
    at_edges = torch.einsum("en,nsk->esk", senders, a) + torch.einsum("en,nsk->esk", receivers, b)
    messages = torch.nn.functional.silu(at_edges + c.unsqueeze(1))
    dense = torch.einsum("en,esk->nsk", receivers, messages)
    own = graph.summed_messages(a, b, c)
    torch.testing.assert_close(own, dense)
    weight = random(n, 2, 3, seed=9, dtype=torch.float64)
    for ours, theirs in zip(
        torch.autograd.grad((own * weight).sum(), inputs),
        torch.autograd.grad((dense * weight).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(graph.at_edges(a, b), at_edges)


@pytest.mark.parametrize("hidden_layers", [1, 2])
@pytest.mark.parametrize("name", MESHES)
def test_message_passing_equals_an_explicit_sum_over_edges(name: str, hidden_layers: int) -> None:
    graph = graph_of(MESHES[name])
    step = drawn(MessagePassing(5, hidden_layers))
    edges, nodes = random(graph.n_edges, 2, 5, seed=1), random(graph.n_nodes, 2, 5, seed=2)
    with torch.no_grad():
        found_edges, found_nodes = step(edges, nodes, graph)
        whole = torch.cat([step.edge.weight, step.sender.weight, step.receiver.weight], dim=1)
        bias = step.edge.bias + step.sender.bias + step.receiver.bias
        received: list[Any] = [torch.zeros(2, 5) for _ in range(graph.n_nodes)]
        ends = zip(graph.senders.index, graph.receivers.index, strict=True)
        for number, (s, r) in enumerate(ends):
            joined = torch.cat([edges[number], nodes[s], nodes[r]], dim=1)
            hidden = torch.nn.functional.silu(joined @ whole.T + bias)
            message = edges[number] + step.message(hidden)
            torch.testing.assert_close(found_edges[number], message)
            received[int(r)] = received[int(r)] + message
        for node in range(graph.n_nodes):
            joined = torch.cat([nodes[node], received[node]], dim=1)
            expected = nodes[node] + step.node(joined)
            torch.testing.assert_close(found_nodes[node], expected, rtol=1e-4, atol=1e-5)


def test_published_layers_end_with_a_layer_norm_and_the_decoder_does_not() -> None:
    """Encoders and messages have two hidden layers, and encoded features have mean 0."""
    mesh = MESHES["hexahedra"]
    network = drawn(GraphNetwork(mesh, np.arange(9), 16, 1, hidden_layers=2))
    encoders = (network.node_encoder, network.edge_encoder)
    norms = [layers[-1] for layers in (*encoders, network.steps[0].message, network.steps[0].node)]
    assert all(isinstance(norm, torch.nn.LayerNorm) for norm in norms)
    n_linear = [sum(isinstance(m, torch.nn.Linear) for m in e.modules()) for e in encoders]
    assert n_linear == [3, 3]
    answer = answer_of(network, random(1, mesh.n_nodes, 3))
    assert answer.mean(dim=2).abs().max() > 1e-3
    with torch.no_grad():
        encoded = network.edge_encoder(network.graph.shapes)
    torch.testing.assert_close(encoded.mean(dim=1), torch.zeros(len(encoded)), atol=1e-5, rtol=0)


def moved_by_the_far_end(network: Any) -> Any:
    """Return which nodes of `BEAM` answer differently to another force at its free end."""
    force = random(1, BEAM.n_nodes, 3)
    changed = force.clone()
    changed[0, FAR] += 1.0
    answers = [answer_of(drawn(network), fields) for fields in (force, changed)]
    return (answers[0] != answers[1]).any(dim=2)[0].numpy()


def test_a_flat_network_sees_one_edge_per_step() -> None:
    distance = np.abs(BEAM.points - BEAM.points[FAR]).sum(axis=1)
    moved = moved_by_the_far_end(GraphNetwork(BEAM, np.arange(4), 8, 3, 1))
    np.testing.assert_array_equal(moved, distance < 3.5)


def test_coarser_graphs_carry_a_force_across_the_body() -> None:
    """Two steps on the mesh, and two on each coarser graph: the flat network would need 18."""
    moved = moved_by_the_far_end(GraphUNet(BEAM, np.arange(4), 8, levels=4, steps=1))
    assert moved.all()
    near = moved_by_the_far_end(GraphUNet(BEAM, np.arange(4), 8, levels=1, steps=1))
    assert near.any()
    assert not near[:16].any()


@pytest.mark.parametrize("kind", ["flat", "u"])
def test_answers_depend_neither_on_numbers_nor_on_the_place_of_the_body(kind: str) -> None:
    mesh = irregular_box((6.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    fixed = np.flatnonzero(mesh.points[:, 0] == 0)
    generator = np.random.default_rng(0)
    order, cells = generator.permutation(mesh.n_nodes), generator.permutation(mesh.n_cells)
    place = np.argsort(order)
    other = replace(
        mesh, points=mesh.points[order] + [3.0, -1.0, 2.0], cells=place[mesh.cells][cells]
    )

    def network(body: Mesh, nodes: Any) -> Any:
        return (
            GraphNetwork(body, nodes, 8, 2, 1)
            if kind == "flat"
            else GraphUNet(body, nodes, 8, 3, 1)
        )

    first, second = drawn(network(mesh, fixed)), network(other, place[fixed])
    second.load_state_dict(first.state_dict())
    force = random(2, mesh.n_nodes, 3)
    answer = answer_of(first, force)
    torch.testing.assert_close(
        answer_of(second, force[:, order]), answer[:, order], rtol=1e-4, atol=1e-4
    )
    swapped = answer_of(first, force[:, order])
    assert not torch.allclose(swapped, answer[:, order], atol=1e-2)  # the mesh matters


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box_mesh((4.0, 1.0, 1.0), (15, 3, 3)), [32, 4, 2, 1]),
        (box_mesh((2.0, 1.0, 1.0), (6, 2, 2)), None),
        (irregular_box((4.0, 1.0, 1.0), (8, 3, 3), tetrahedra=True), None),
        (irregular_box((4.0, 1.0, 1.0), (8, 3, 3), tetrahedra=False), None),
    ],
    ids=["even box", "odd box", "tetrahedra", "hexahedra"],
)
def test_groups_cover_all_nodes_and_lie_in_cells(mesh: Mesh, expected: list[int] | None) -> None:
    level, sizes = GraphLevel.of(mesh), []
    for _ in range(4):
        groups = level.groups()
        below = level.coarser(groups)
        n_groups = len(below.points)
        sizes.append(n_groups)
        assert groups.shape == (len(level.points),)
        assert set(groups.tolist()) == set(range(n_groups))
        assert n_groups < len(level.points) or n_groups == 1
        cells = [set(cell[cell >= 0].tolist()) for cell in level.cells]
        joined = {tuple(sorted(groups[pair].tolist())) for pair in level.pairs}
        assert {tuple(pair) for pair in below.pairs.tolist()} == {
            (a, b) for a, b in joined if a < b
        }
        for group in range(n_groups):
            members = set(np.flatnonzero(groups == group).tolist())
            assert len(members) == 1 or any(members <= cell for cell in cells)
            centre = level.points[sorted(members)].mean(axis=0)
            np.testing.assert_allclose(below.points[group], centre, rtol=1e-12)
        coarse_cells = {tuple(sorted(cell[cell >= 0].tolist())) for cell in below.cells}
        touched = {tuple(sorted({int(groups[n]) for n in cell})) for cell in cells}
        assert coarse_cells == {cell for cell in touched if len(cell) > 1}
        level = below
    if expected is None:
        assert sizes[0] < mesh.n_nodes / 2
        assert sizes[3] < sizes[0] / 4
    else:
        assert sizes == expected


def test_pooling_takes_means_and_returns_to_every_node() -> None:
    level = GraphLevel.of(MESHES["tetrahedra"])
    groups = level.groups()
    below = level.coarser(groups)
    graphs = Graph(level.points, level.pairs), Graph(below.points, below.pairs)
    grouping = Grouping((level, below), graphs, groups)
    fine, coarse = (graph.order.numpy() for graph in graphs)
    nodal = random(len(fine), 2, 3)
    by_number = nodal[np.argsort(fine)]
    for row, group in enumerate(coarse):
        mean = by_number[np.flatnonzero(groups == group)].mean(dim=0)
        torch.testing.assert_close(grouping.means(nodal)[row], mean)
    spread = grouping.members.take(random(len(coarse), 2, 3, seed=1))
    places = np.argsort(coarse)[groups[fine]]
    torch.testing.assert_close(spread, random(len(coarse), 2, 3, seed=1)[places])
    offsets = (level.points - below.points[groups])[fine] / graphs[0].length
    np.testing.assert_allclose(grouping.offsets.numpy(), offsets, atol=1e-6)


def test_ranks_go_from_one_end_to_the_other_and_ignore_rounding() -> None:
    points = np.array([[2.0, 0.0, 1.0], [1.0, 3.0, 0.0], [1.0 + 1e-12, 0.0, 5.0], [0.0, 9.0, 9.0]])
    assert position_ranks(points).tolist() == [3, 2, 1, 0]
    assert position_ranks(points[:1]).tolist() == [0]


@pytest.mark.parametrize("name", MESHES)
def test_work_is_that_of_the_layers_as_torch_counts_it(name: str) -> None:
    mesh = MESHES[name]
    for network in (
        GraphNetwork(mesh, np.arange(4), 6, 3, hidden_layers=2),
        GraphUNet(mesh, np.arange(4), 6, levels=2, steps=2),
    ):
        drawn(network).requires_grad_(False).precompute()
        before = answer_of(network, random(1, mesh.n_nodes, 3))
        with FlopCounterMode(display=False) as flops:
            after = answer_of(network, random(1, mesh.n_nodes, 3))
        assert flops.get_total_flops() == 2 * network.multiply_adds
        torch.testing.assert_close(after, before)


def test_constants_that_are_computed_once_change_no_answer() -> None:
    mesh, fields = MESHES["tetrahedra"], random(2, MESHES["tetrahedra"].n_nodes, 3)
    for network in (
        GraphNetwork(mesh, np.arange(4), 6, 2, 1),
        GraphUNet(mesh, np.arange(4), 6, 2, 1),
    ):
        expected = answer_of(drawn(network), fields)
        network.requires_grad_(False).precompute()
        torch.testing.assert_close(answer_of(network, fields), expected)


@pytest.mark.parametrize("name", ["mesh-graph-net", "graph-u-net"])
def test_the_relative_loss_divides_by_the_size_of_each_sample(name: str, tiny: Dataset) -> None:
    """The training is one step on all samples, too small to change the weights."""
    samples = tiny.train[:20]
    knobs = {"width": 4, "steps": 1, "iterations": 1, "batch_size": 20}
    method: Any = mor_bench.load_method(name, learning_rate=1e-30, **knobs)
    method.fit(tiny.scene, samples)
    wanted = samples.displacements / method.output_scale_
    errors = ((method.predict(samples.forces) / method.output_scale_ - wanted) ** 2).mean((1, 2))
    sizes = (wanted**2).mean(axis=(1, 2))
    expected = np.sqrt(errors / np.maximum(sizes, 0.01 * sizes.mean())).mean()
    assert method.loss_curve_[0] == pytest.approx(expected, rel=1e-4)
    assert method.loss_curve_[0] != pytest.approx(errors.mean(), rel=0.01)


@pytest.mark.parametrize("name", ["mesh-graph-net", "graph-u-net"])
def test_answers_are_the_same_alone_in_a_batch_and_from_a_file(
    name: str, tiny: Dataset, tmp_path: Path
) -> None:
    method = mor_bench.load_method(name, width=4, steps=2, iterations=3, batch_size=4)
    forces = tiny.test.forces[:5]
    answers = method.fit(tiny.scene, tiny.train[:12]).predict(forces)
    alone = np.stack([method.predict(force) for force in forces])
    np.testing.assert_allclose(alone, answers, rtol=0, atol=2e-6 * np.abs(answers).max())
    method.save(tmp_path / "model.safetensors")
    loaded = mor_bench.load_surrogate(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(loaded.predict(forces), answers)
