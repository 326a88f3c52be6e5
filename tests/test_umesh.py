"""U-Mesh: the network is the paper's, the grid round trip is exact, and a fit repeats to the last bit."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, MorBenchError, SpecError, StoreError, UnsupportedSceneError
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogate import Surrogate

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.scene.mesh import box_mesh  # noqa: E402 - after the check that torch is there
from mor_bench.surrogates.umesh.grid import padded_grid  # noqa: E402
from mor_bench.surrogates.umesh.network import UNet, new_network  # noqa: E402
from mor_bench.surrogates.umesh.training import TrainingPlan, rate_factor, train  # noqa: E402

SMALL = {
    "channels": 8, "steps": 1, "iterations": 400, "batch_size": 16, "learning_rate": 3e-3, "schedule": "one-cycle", "second_moment_decay": 0.99,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Networks as small as these are no faster on two threads, and far slower where another process has a core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    """beam-tiny, 7×3×3 nodes, of which one halving pads every axis; split by sample, as in the paper."""
    return mor_bench.load_dataset("beam-tiny", split="sample", cache=cache, workers=1)


@pytest.fixture(scope="module")
def fitted(data: Dataset) -> Surrogate:
    return mor_bench.load_method("umesh", **SMALL).fit(data.scene, data.train)


def mean_dof_error(prediction: np.ndarray, reference: np.ndarray) -> float:
    return float(np.abs(prediction - reference).mean())


@pytest.mark.parametrize(("channels", "steps"), [(16, 2), (4, 3), (128, 3)])
def test_number_of_parameters(channels: int, steps: int) -> None:
    def convolution(c_in: int, c_out: int, size: int) -> int:
        return c_out * (c_in * size**3 + 1)

    expected = convolution(3, channels, 3) + convolution(channels, channels, 3) + convolution(channels, 3, 1)
    for level in range(steps):
        here, below = channels * 2**level, channels * 2 ** (level + 1)
        expected += convolution(here, below, 3) + convolution(below, below, 3)  # encoder below, or the bottom
        expected += convolution(below, here, 2) + convolution(2 * here, here, 3) + convolution(here, here, 3)
    with torch.device("meta"):
        network = UNet(channels, steps)
    assert sum(p.numel() for p in network.parameters()) == expected


def test_the_bottom_sees_the_whole_small_grid() -> None:
    network = new_network(4, 2, torch.Generator().manual_seed(0))
    force = torch.zeros(1, 3, 16, 4, 4)
    with torch.inference_mode():
        at_rest = network(force)
        force[0, :, 15, 3, 3] = 1.0
        changed = (network(force) - at_rest).abs().amax(dim=(0, 1))
    assert (changed[0] > 0).any(), "a force at the tip must reach the clamped end"


def test_grid_round_trip_and_padding() -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    grid = padded_grid(mesh, 2)
    assert grid.shape == (8, 4, 4)
    nodal = torch.randn(5, mesh.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    values = grid.to_grid(nodal)
    assert values.is_contiguous(memory_format=torch.channels_last_3d)
    torch.testing.assert_close(grid.to_nodes(values), nodal, rtol=0, atol=0)
    torch.testing.assert_close(values[:, :, :7, :3, :3], nodal.view(5, 7, 3, 3, 3).permute(0, 4, 1, 2, 3), rtol=0, atol=0)
    assert float((values * (1 - grid.body)).abs().sum()) == 0.0
    assert int(grid.body.sum()) == mesh.n_nodes


def test_grid_of_a_part_of_a_box() -> None:
    """Nodes in any order, not all of the grid: each lands at its own place."""
    whole = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    kept = np.random.default_rng(0).permutation(whole.n_nodes)[:40]
    assert whole.grid_index is not None
    part = replace(whole, points=whole.points[kept], grid_index=whole.grid_index[kept])
    full = torch.randn(2, whole.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    values = padded_grid(part, 1).to_grid(full[:, kept])
    expected = padded_grid(whole, 1).to_grid(full)
    body = padded_grid(part, 1).body
    assert int(body.sum()) == 40
    torch.testing.assert_close(values, expected * body, rtol=0, atol=0)


def test_padding_carries_no_loss() -> None:
    """Targets at padding do not change the weights at all; targets in the body do."""
    grid = padded_grid(box_mesh((2.0, 1.0, 1.0), (6, 2, 2)), 1)
    source = torch.Generator().manual_seed(0)
    inputs, targets, noise = (torch.randn(8, 3, *grid.shape, generator=source) for _ in range(3))

    def weight(goal: Any) -> Any:
        generator = torch.Generator().manual_seed(1)
        network = new_network(4, 1, generator)
        train(network, inputs, goal, grid.body, TrainingPlan(3, 4, 1e-3, "constant", 0.999), generator)
        return network.head.weight.detach()

    reference = weight(targets)
    assert torch.equal(weight(targets + noise * (1 - grid.body)), reference)
    assert not torch.equal(weight(targets + noise * grid.body), reference)


def test_one_cycle_rises_falls_and_stays_in_range() -> None:
    rates = np.array([rate_factor("one-cycle", i, 1000) for i in range(1000)])
    assert rates.argmax() == pytest.approx(100, abs=2)
    assert rates.max() == pytest.approx(1.0, abs=0.01)
    assert 0 < rates.min() < 0.02
    assert rates[-1] < 1e-4
    assert {rate_factor("constant", i, 1000) for i in range(1000)} == {1.0}


def test_training_beats_predicting_zero(fitted: Surrogate, data: Dataset) -> None:
    error = mean_dof_error(fitted.predict(data.test.forces), data.test.displacements)
    assert error < 0.4 * mean_dof_error(np.zeros_like(data.test.displacements), data.test.displacements)


def test_loss_curve_falls(fitted: Surrogate) -> None:
    curve = fitted.loss_curve_  # type: ignore[attr-defined]
    assert curve.shape == (8,)
    assert curve[-1] < 0.1 * curve[0]


def test_a_second_fit_is_bit_identical_and_leaves_global_random_state_alone(fitted: Surrogate, data: Dataset) -> None:
    before = torch.get_rng_state()
    numpy_before = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002 - the global state is the subject
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    again = mor_bench.load_method("umesh", **SMALL).fit(data.scene, data.train)
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # type: ignore[index]  # noqa: NPY002
    assert (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()) == (threads, deterministic)
    first, second = fitted._state(), again._state()
    assert first.keys() == second.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name], err_msg=name)


def test_another_seed_gives_another_network(data: Dataset) -> None:
    one, two = (mor_bench.load_method("umesh", **{**SMALL, "iterations": 2, "seed": seed}).fit(data.scene, data.train) for seed in (0, 1))
    assert not np.array_equal(one.predict(data.test.forces[0]), two.predict(data.test.forces[0]))


def test_saved_and_loaded_is_the_same_model(fitted: Surrogate, data: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "umesh.safetensors"
    fitted.save(path)
    loaded = mor_bench.load_surrogate(path)
    np.testing.assert_array_equal(loaded.predict(data.test.forces), fitted.predict(data.test.forces))
    assert loaded.parameters == fitted.parameters
    np.testing.assert_array_equal(loaded.loss_curve_, fitted.loss_curve_)  # type: ignore[attr-defined]


def test_a_file_with_other_weights_is_refused(fitted: Surrogate, tmp_path: Path) -> None:
    path = tmp_path / "umesh.safetensors"
    other = copy.copy(fitted)
    other.channels = 4  # type: ignore[attr-defined]
    other.save(path)
    with pytest.raises(StoreError, match="weights do not fit"):
        mor_bench.load_surrogate(path)


def test_single_and_batch_agree(fitted: Surrogate, data: Dataset) -> None:
    forces = np.concatenate([data.test.forces] * 4)[:150]  # more than one chunk
    batch = fitted.predict(forces)
    assert batch.shape == forces.shape
    assert batch.dtype == np.float64
    assert (batch[:, data.scene.fixed_nodes] == 0).all()
    assert len(forces) == 150
    for row in (0, 1, 127, 128, 149):
        single = fitted.predict(forces[row])
        assert single.shape == (data.scene.mesh.n_nodes, 3)
        np.testing.assert_allclose(single, batch[row], rtol=0, atol=2e-6 * np.abs(batch).max())
    assert fitted.predict(forces[:0]).shape == (0, data.scene.mesh.n_nodes, 3)


def test_a_batch_larger_than_the_data_is_cut(data: Dataset) -> None:
    method = mor_bench.load_method("umesh", channels=2, steps=1, iterations=2, batch_size=1000)
    assert np.isfinite(method.fit(data.scene, data.train[:7]).predict(data.test.forces[0])).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_forces_that_are_not_finite_are_refused(fitted: Surrogate, data: Dataset, bad: float) -> None:
    force = data.test.forces[0].copy()
    force[5, 2] = bad
    with pytest.raises(InvalidInputError, match="finite"):
        fitted.predict(force)


def test_divergence_is_an_error(data: Dataset) -> None:
    method = mor_bench.load_method("umesh", channels=2, steps=1, iterations=60, learning_rate=1e30)
    with pytest.raises(MorBenchError, match="diverged"):
        method.fit(data.scene, data.train)


def test_a_mesh_without_a_grid_is_not_supported(data: Dataset) -> None:
    scene = replace(data.scene, mesh=replace(data.scene.mesh, grid_shape=None, grid_index=None))
    method = mor_bench.load_method("umesh", **SMALL)
    assert "regular grid" in str(method.supports(scene))
    assert method.supports(data.scene) is None
    with pytest.raises(UnsupportedSceneError, match="regular grid"):
        method.fit(scene, data.train)


@pytest.mark.parametrize(("knob", "value"), [("channels", 0), ("steps", 0), ("schedule", "step"), ("learning_rate", 0.0), ("seed", -1)])
def test_knobs_out_of_range(knob: str, value: object) -> None:
    with pytest.raises(SpecError, match=knob):
        mor_bench.load_method("umesh", **{knob: value})


def test_the_network_is_the_papers_with_its_skips() -> None:
    """The forward pass written out: encoder, bottom, decoder that concatenates the encoder's features, 1×1×1 head."""
    from torch.nn import functional

    steps = 2
    network = new_network(4, steps, torch.Generator().manual_seed(0))
    values = list(network.state_dict().values())
    layers = list(zip(values[::2], values[1::2], strict=True))
    convolutions = iter([layer for layer in layers if layer[0].shape[-1] == 3])
    ups = [layer for layer in layers if layer[0].shape[-1] == 2]
    (head,) = [layer for layer in layers if layer[0].shape[-1] == 1]

    def double(z: Any) -> Any:
        for _ in range(2):
            weight, bias = next(convolutions)
            z = functional.relu(functional.conv3d(z, weight, bias, padding=1))
        return z

    x = torch.randn((2, 3, 8, 4, 4), generator=torch.Generator().manual_seed(1))
    y, skips = x, []
    for _ in range(steps):
        y = double(y)
        skips.append(y)
        y = functional.max_pool3d(y, 2)
    y = double(y)
    for weight, bias in ups:
        y = double(torch.cat([skips.pop(), functional.conv_transpose3d(y, weight, bias, stride=2)], dim=1))
    with torch.inference_mode():
        torch.testing.assert_close(network(x), functional.conv3d(y, *head), rtol=1e-5, atol=1e-5)
