"""Transolver: its attention is that of the paper, on any mesh and over the whole body."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.snapshots.dataset import Dataset
from tests.irregular import irregular_box

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402 - torch is there

from mor_bench.surrogates.field_network import initialise, scaled_positions  # noqa: E402
from mor_bench.surrogates.transolver import (  # noqa: E402
    HIGHEST,
    LEAST_WEIGHT,
    LOWEST,
    Block,
    PhysicsAttention,
    TransolverNetwork,
)

WIDTH, HEADS, SLICES = 8, 2, 3
SMALL: dict[str, Any] = {"width": 8, "heads": 2, "slices": 3, "layers": 2, "batch_size": 8}

SUBTRACTED = ("network.norm.bias", "network.decoder.bias")
"""Constants of the answer, which subtracting the answer at rest removes: they have no gradient."""


def drawn(*shape: int, seed: int = 0) -> Any:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def attention(seed: int = 0) -> PhysicsAttention:
    layer = PhysicsAttention(WIDTH, HEADS, SLICES)
    initialise(layer, torch.Generator().manual_seed(seed))
    with torch.no_grad():
        layer.temperature.copy_(torch.tensor([0.3, 0.8]).view(HEADS, 1, 1))
        for number, part in enumerate((layer.assign, layer.value, layer.token, layer.mix)):
            part.bias.copy_(drawn(*part.bias.shape, seed=number))
    return layer


def on_mesh(mesh: Mesh, layers: int = 1) -> TransolverNetwork:
    network = TransolverNetwork(scaled_positions(mesh), WIDTH, HEADS, SLICES, layers, 2)
    initialise(network, torch.Generator().manual_seed(0))
    return network


def softmax(scores: list[float]) -> list[float]:
    powers = np.exp(np.array(scores) - max(scores))
    return [float(power) for power in powers / powers.sum()]


def rows(layer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return weights and biases of a linear layer, float64."""
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


def of_one_head(layer: PhysicsAttention, head: int, nodes: np.ndarray) -> np.ndarray:
    """Return what a head gives to each node, node by node and slice by slice."""
    d, n_nodes = WIDTH // HEADS, len(nodes)
    (assign, assign_bias), (value, value_bias) = rows(layer.assign), rows(layer.value)
    token, token_bias = rows(layer.token)
    temperature = layer.temperature[head].item()
    weights, values = [], []
    for x in nodes:
        own = range(head * SLICES, (head + 1) * SLICES)
        weights.append(softmax([(assign[m] @ x + assign_bias[m]) / temperature for m in own]))
        values.append((value @ x + value_bias)[head * d : (head + 1) * d])
    tokens = []
    for m in range(SLICES):
        total, mean = LEAST_WEIGHT, np.zeros(d)
        for i in range(n_nodes):
            total, mean = total + weights[i][m], mean + weights[i][m] * values[i]
        tokens.append(token @ (mean / total) + token_bias)
    changed = []
    for m in range(SLICES):
        scores = [float(tokens[m][:d] @ other[d : 2 * d]) / d**0.5 for other in tokens]
        shares = softmax(scores)
        changed.append(sum(s * t[2 * d :] for s, t in zip(shares, tokens, strict=True)))
    return np.array([sum(w * c for w, c in zip(own, changed, strict=True)) for own in weights])


def test_physics_attention_equals_loops_over_nodes_and_slices() -> None:
    layer, nodes = attention(), drawn(2, 7, WIDTH, seed=1)
    mix, mix_bias = rows(layer.mix)
    with torch.no_grad():
        found = layer(nodes).numpy()
    for sample, own in zip(nodes.double().numpy(), found, strict=True):
        heads = [of_one_head(layer, head, sample) for head in range(HEADS)]
        expected = np.concatenate(heads, axis=1) @ mix.T + mix_bias
        np.testing.assert_allclose(own, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_slice_weights_sum_to_one_and_sharpen_at_low_temperature() -> None:
    layer, nodes = attention(), drawn(2, 7, WIDTH, seed=1)

    def at(temperature: float) -> Any:
        with torch.no_grad():
            layer.temperature.fill_(temperature)
            weights = layer.slice_weights(nodes)
        assert weights.shape == (2, HEADS, 7, SLICES)
        assert (weights >= 0).all()
        torch.testing.assert_close(weights.sum(dim=-1), torch.ones(2, HEADS, 7))
        return weights

    sharp, soft = at(0.3).amax(dim=-1), at(3.0).amax(dim=-1)
    assert (sharp > soft).all()
    assert torch.equal(at(1e-9), at(LOWEST))
    assert torch.equal(at(-1.0), at(LOWEST))
    assert torch.equal(at(1e9), at(HIGHEST))
    assert not torch.equal(at(LOWEST), at(HIGHEST))


def test_a_block_adds_to_its_input_what_depends_on_the_normalised_input() -> None:
    block, nodes = Block(WIDTH, HEADS, SLICES, 2), 10 * drawn(2, 7, WIDTH)
    initialise(block, torch.Generator().manual_seed(0))
    last: Any = block.perceptron[-1]
    attended, changed = block.attention.mix.weight, last.weight
    with torch.no_grad():
        whole = block(nodes)
        for silent, other in ((attended, changed), (changed, attended)):
            kept = silent.clone()
            silent.zero_()
            added = block(nodes) - nodes
            assert added.abs().min() > 0
            torch.testing.assert_close(block(3 * nodes) - 3 * nodes, added, rtol=0, atol=1e-3)
            other.mul_(2)
            torch.testing.assert_close(block(nodes) - nodes, 2 * added, rtol=0, atol=1e-4)
            other.div_(2)
            silent.copy_(kept)
        assert torch.equal(block(nodes), whole)
        attended.zero_()
        changed.zero_()
        assert torch.equal(block(nodes), nodes)


def test_the_answer_is_bounded_under_any_load() -> None:
    mesh = box_mesh((3.0, 1.0, 1.0), (4, 2, 1))
    network, force = on_mesh(mesh), drawn(1, mesh.n_nodes, 3)
    bound = WIDTH**0.5 * network.decoder.weight.norm(dim=1) * (1 + 1e-5)
    with torch.no_grad():
        for factor in (1.0, 1e6):
            assert (network(factor * force).abs() <= bound).all()
        assert (network(force) - network(2 * force)).abs().max() > 0.01


def test_the_order_of_the_nodes_does_not_matter() -> None:
    """On an irregular mesh, and with positions that differ at every node."""
    mesh = irregular_box((2.0, 1.0, 1.0), (3, 2, 2), tetrahedra=True)
    network, force = on_mesh(mesh, layers=2), drawn(2, mesh.n_nodes, 3)
    order = np.random.default_rng(0).permutation(mesh.n_nodes)
    other = TransolverNetwork(network.positions[order], WIDTH, HEADS, SLICES, 2, 2)
    other.load_state_dict(network.state_dict())
    with torch.no_grad():
        answer, renumbered = network(force), other(force[:, order])
        torch.testing.assert_close(renumbered, answer[:, order], rtol=1e-4, atol=1e-5)
        assert (network(force[:, order]) - answer[:, order]).abs().max() > 0.01


def test_one_block_carries_a_force_from_one_end_to_the_other() -> None:
    """Without blocks, a force acts at its own node only."""
    mesh = box_mesh((6.0, 1.0, 1.0), (6, 1, 1))
    force = drawn(1, mesh.n_nodes, 3)
    changed = force.clone()
    end = int(mesh.points[:, 0].argmax())
    changed[0, end] += 1.0
    for layers in (0, 1):
        network = on_mesh(mesh, layers)
        with torch.no_grad():
            change = (network(changed) - network(force)).abs().amax(dim=2)[0].numpy()
        if layers == 0:
            assert np.flatnonzero(change).tolist() == [end]
        else:
            assert change[mesh.points[:, 0] == 0.0].min() > 1e-4


def test_samples_of_a_batch_do_not_act_on_each_other() -> None:
    mesh = irregular_box((2.0, 1.0, 1.0), (3, 2, 2), tetrahedra=True)
    network, forces = on_mesh(mesh, layers=2), drawn(5, mesh.n_nodes, 3)
    with torch.no_grad():
        together = network(forces)
        alone = torch.cat([network(force[None]) for force in forces])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-6)
    assert (together[0] - together[1]).abs().max() > 0.01


@pytest.mark.parametrize("layers", [1, 3])
def test_the_stated_work_is_that_of_all_products(layers: int) -> None:
    """Torch counts two operations for each multiply-add of a matrix product."""
    mesh = box_mesh((3.0, 1.0, 1.0), (4, 2, 1))
    network = on_mesh(mesh, layers)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(drawn(1, mesh.n_nodes, 3))
    assert counter.get_total_flops() == 2 * network.multiply_adds


def test_a_width_that_the_heads_do_not_divide_is_refused(tiny: Dataset) -> None:
    method = mor_bench.load_method("transolver", **{**SMALL, "heads": 3})
    with pytest.raises(InvalidInputError, match=r"`width` of Transolver must be a multiple.*got 8"):
        method.fit(tiny.scene, tiny.train[:8])


def test_training_changes_every_weight_and_a_file_keeps_them(tiny: Dataset, tmp_path: Path) -> None:
    untrained, trained = (
        mor_bench.load_method("transolver", **SMALL, iterations=3, learning_rate=rate).fit(
            tiny.scene, tiny.train[:20]
        )
        for rate in (1e-30, 1e-2)
    )
    for name, before in untrained.arrays_.items():
        if name.startswith("network.") and name not in SUBTRACTED:
            assert np.abs(trained.arrays_[name] - before).max() > 1e-4, name
    trained.save(tmp_path / "model.safetensors")
    loaded = mor_bench.load_surrogate(tmp_path / "model.safetensors")
    forces = tiny.test.forces[:3]
    np.testing.assert_array_equal(loaded.predict(forces), trained.predict(forces))
