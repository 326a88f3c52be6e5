"""U-Mesh: the paper's network, an exact grid round trip, and fits that repeat bit by bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.hard_cases.setups import material_table
from mor_bench.method_loading import load_fitted
from mor_bench.scene.grid import grid_map
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.scene import load_scene
from mor_bench.scene.symmetry import mirrors
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.training_options import TrainingOptions
from tests.irregular import irregular_box, irregular_samples

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import training  # noqa: E402 - after the check that torch is there
from mor_bench.surrogates.umesh.network import DoubleConvolution, UNet, new_network  # noqa: E402
from mor_bench.surrogates.umesh.padded_grid import padded_grid  # noqa: E402

SMALL: dict[str, Any] = {
    "channels": 8,
    "steps": 1,
    "iterations": 200,
    "batch_size": 16,
    "learning_rate": 3e-3,
    "schedule": "one-cycle",
    "second_moment_decay": 0.95,
}
IMPROVED: dict[str, Any] = {
    **SMALL,
    "input": "linear-response",
    "activation": "silu",
    "zero_at_rest": True,
    "mirrored": True,
}


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    """beam-tiny, 7×3×3 nodes, padded for one halving; split by sample, as in the paper."""
    return mor_bench.load_dataset("beam-tiny", split="sample", cache=cache, workers=1)


@pytest.fixture(scope="module")
def irregular() -> tuple[Snapshots, Snapshots]:
    """Training and test samples on an irregular mesh."""
    samples = irregular_samples(100)
    return samples[:80], samples[80:]


def fit(samples: Snapshots, training: TrainingOptions | None = None, **knobs: Any) -> Any:
    method = mor_bench.load_method("umesh", **{**SMALL, **knobs})
    method.training = training or TrainingOptions()
    return method.fit(samples.scene, samples)


@pytest.fixture(scope="module")
def fitted(data: Dataset) -> Any:
    return fit(data.train)


@pytest.fixture(scope="module")
def improved(data: Dataset) -> Any:
    return fit(data.train, **IMPROVED)


@pytest.fixture(scope="module")
def fitted_irregular(irregular: tuple[Snapshots, Snapshots]) -> Any:
    return fit(irregular[0])


def mean_error(method: Any, samples: Snapshots) -> float:
    """Return the mean absolute error per dof, relative to that of zero displacement."""
    errors = np.abs(method.predict(samples.forces) - samples.displacements)
    return float(errors.mean() / np.abs(samples.displacements).mean())


def assert_same_model(one: Any, other: Any) -> None:
    assert one.arrays_.keys() == other.arrays_.keys()
    for name, array in one.arrays_.items():
        np.testing.assert_array_equal(array, other.arrays_[name], err_msg=name)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(("channels", "steps"), [(16, 2), (128, 3)])
def test_the_number_of_weights_is_that_of_the_paper(channels: int, steps: int) -> None:
    def convolution(c_in: int, c_out: int, size: int) -> int:
        return c_out * (c_in * size**3 + 1)

    c = channels
    expected = convolution(3, c, 3) + convolution(c, c, 3) + convolution(c, 3, 1)
    for level in range(steps):
        here, below = c * 2**level, c * 2 ** (level + 1)
        encoder = convolution(here, below, 3) + convolution(below, below, 3)
        decoder = convolution(2 * here, here, 3) + convolution(here, here, 3)
        expected += encoder + convolution(below, here, 2) + decoder
    with torch.device("meta"):
        network = UNet(channels, steps)
    assert sum(p.numel() for p in network.parameters()) == expected


def test_the_network_is_that_of_the_paper_with_skip_connections() -> None:
    """The reference has an encoder, a bottom, a decoder with the encoder's features, and a head."""
    from torch.nn import functional

    network = new_network(4, 2, torch.Generator().manual_seed(0))
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
    for _ in range(2):
        y = double(y)
        skips.append(y)
        y = functional.max_pool3d(y, 2)
    y = double(y)
    for weight, bias in ups:
        above = functional.conv_transpose3d(y, weight, bias, stride=2)
        y = double(torch.cat([skips.pop(), above], dim=1))
    with torch.inference_mode():
        torch.testing.assert_close(network(x), functional.conv3d(y, *head), rtol=1e-5, atol=1e-5)


def test_nodes_go_to_the_padded_grid_and_back_unchanged() -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    grid = padded_grid(grid_map(mesh), 2)
    assert grid.shape == (8, 4, 4)
    nodal = torch.randn(5, mesh.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    values = grid.to_grid(nodal)
    assert values.is_contiguous(memory_format=torch.channels_last_3d)
    assert torch.equal(grid.to_nodes(values), nodal)
    expected = nodal.view(5, 7, 3, 3, 3).permute(0, 4, 1, 2, 3)
    assert torch.equal(values[:, :, :7, :3, :3], expected)
    assert int((values != 0).sum()) == nodal.numel()
    assert torch.equal(grid.displacements_to_grid(nodal), values)


def test_nodes_of_part_of_a_box_in_any_order_go_to_their_grid_points() -> None:
    whole = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    kept = np.random.default_rng(0).permutation(whole.n_nodes)[:40]
    assert whole.grid_index is not None
    part = replace(whole, points=whole.points[kept], grid_index=whole.grid_index[kept])
    full = torch.randn(2, whole.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    grid = padded_grid(grid_map(part), 1)
    values, body = grid.to_grid(full[:, kept]), grid.to_grid(torch.ones(1, 40, 3))
    assert int(body.sum()) == 3 * 40
    assert torch.equal(values, padded_grid(grid_map(whole), 1).to_grid(full) * body)
    assert torch.equal(grid.to_nodes(values), full[:, kept])


@pytest.mark.parametrize("regular", [True, False])
def test_values_and_gradients_at_nodes_equal_those_of_the_dense_matrix(regular: bool) -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    if not regular:
        mesh = irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    grid = padded_grid(grid_map(mesh), 2)
    assert (grid.places is not None) == regular
    matrix = torch.from_numpy(grid.grid.weights.toarray())
    source = torch.Generator().manual_seed(0)
    values = torch.randn(2, 3, *grid.shape, generator=source, requires_grad=True)
    flat = values.permute(0, 2, 3, 4, 1).reshape(2, -1, 3)
    goal = torch.randn(2, mesh.n_nodes, 3, generator=source)
    torch.testing.assert_close(grid.to_nodes(values), matrix @ flat)
    (own,) = torch.autograd.grad((grid.to_nodes(values) - goal).square().sum(), values)
    (reference,) = torch.autograd.grad((matrix @ flat - goal).square().sum(), values)
    torch.testing.assert_close(own, reference)
    assert 0 < int((own != 0).sum()) < own.numel()


def test_displacements_on_the_grid_are_means_of_neighbouring_nodes() -> None:
    """A constant field stays constant in the body, and is zero outside."""
    mesh = irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    grid = padded_grid(grid_map(mesh), 1)
    values = grid.displacements_to_grid(torch.ones(2, mesh.n_nodes, 3))
    shares = grid.grid.weights.sum(axis=0).reshape(grid.shape)
    body, beside = torch.from_numpy(shares > 1e-2), torch.from_numpy(shares == 0)
    torch.testing.assert_close(values[:, :, body], torch.ones(2, 3, int(body.sum())))
    assert not values[:, :, beside].any()


@pytest.mark.parametrize(
    ("regular", "loss"), [(True, "absolute"), (True, "relative"), (False, "relative")]
)
def test_the_loss_is_the_mean_square_over_the_components_of_all_nodes(
    regular: bool, loss: str, data: Dataset, irregular: tuple[Snapshots, Snapshots]
) -> None:
    """The loss is that before the first step, of one batch of all samples, without padding."""
    samples = data.train[:20] if regular else irregular[0][:20]
    method = fit(samples, iterations=1, batch_size=20, loss=loss)
    grid = padded_grid(grid_map(samples.scene.mesh), 1)
    network = new_network(8, 1, torch.Generator().manual_seed(0))
    with torch.inference_mode():
        scaled = torch.from_numpy((samples.forces / rms(samples.forces)).astype(np.float32))
        flat = network(grid.to_grid(scaled)).permute(0, 2, 3, 4, 1).reshape(20, -1, 3).numpy()
    targets = samples.displacements / rms(samples.displacements)
    answers = np.einsum("ng,sgc->snc", grid.grid.weights.toarray(), flat)
    errors = np.square(answers - targets).mean(axis=(1, 2))
    weights = np.ones(20)
    if loss == "relative":
        weights = 1 / np.maximum(np.square(targets).mean(axis=(1, 2)), 0.1**2)
    expected = (weights / weights.mean() * errors).mean()
    assert method.loss_curve_[0] == pytest.approx(expected, rel=1e-5)


def test_normalisation_divides_by_the_named_scale(data: Dataset) -> None:
    samples = data.train[:20]
    forces, displacements = samples.forces, samples.displacements
    expected = {
        "rms": (rms(forces), rms(displacements)),
        "max": (np.abs(forces).max(), np.abs(displacements).max()),
        "none": (1.0, 1.0),
    }
    for normalisation, scales in expected.items():
        method = fit(samples, iterations=1, normalisation=normalisation)
        assert (method.input_scale_, method.output_scale_) == pytest.approx(scales)


def test_a_training_predicts_loads_that_it_never_saw(fitted: Any, data: Dataset) -> None:
    assert mean_error(fitted, data.test) < 0.6
    assert fitted.loss_curve_.shape == (4,)
    assert fitted.loss_curve_[-1] < 0.3 * fitted.loss_curve_[0]


def test_a_mesh_without_a_grid_is_learned_saved_and_loaded(
    fitted_irregular: Any, irregular: tuple[Snapshots, Snapshots], tmp_path: Path
) -> None:
    test = irregular[1]
    assert test.scene.mesh.grid_index is None
    assert fitted_irregular.grid_.places is None
    assert mean_error(fitted_irregular, test) < 0.6
    answer = fitted_irregular.predict(test.forces)
    assert (answer[:, test.scene.fixed_nodes] == 0).all()
    fitted_irregular.save(tmp_path / "umesh.safetensors")
    loaded = load_fitted(tmp_path / "umesh.safetensors", type(fitted_irregular), test.scene)
    np.testing.assert_array_equal(loaded.predict(test.forces), answer)


@pytest.mark.usefixtures("threads")
def test_a_second_fit_is_bit_identical_and_leaves_global_random_states_alone(
    data: Dataset, irregular: tuple[Snapshots, Snapshots]
) -> None:
    state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    deterministic = torch.are_deterministic_algorithms_enabled()
    for samples in (data.train[:40], irregular[0][:40]):
        one, two = (fit(samples, iterations=2) for _ in range(2))
        assert_same_model(one, two)
    other = fit(samples, iterations=2, seed=1)
    assert not np.array_equal(other.arrays_["loss_curve"], one.arrays_["loss_curve"])
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # type: ignore[index]  # noqa: NPY002
    assert torch.are_deterministic_algorithms_enabled() == deterministic


def test_a_batch_of_more_than_one_chunk_agrees_with_single_queries(
    fitted: Any, data: Dataset
) -> None:
    forces = np.concatenate([data.test.forces] * 4)[:150]
    batch = fitted.predict(forces)
    assert batch.dtype == np.float64
    for row in (0, 127, 128, 149):
        single = fitted.predict(forces[row])
        np.testing.assert_allclose(single, batch[row], rtol=0, atol=2e-6 * np.abs(batch).max())


def test_the_linear_response_helps_most(improved: Any, fitted: Any, data: Dataset) -> None:
    linear = mor_bench.load_method("linear-fem").fit(data.scene, None)
    errors = [mean_error(method, data.test) for method in (improved, linear, fitted)]
    assert errors[0] < 0.9 * errors[1]
    assert errors[0] < 0.2 * errors[2]


def test_zero_force_gives_exactly_zero_displacement_if_requested(
    improved: Any, fitted: Any, data: Dataset
) -> None:
    nothing = np.zeros((3, data.scene.mesh.n_nodes, 3))
    assert not improved.predict(nothing).any()
    assert fitted.predict(nothing).any(), "the paper's network has biases"
    little = 1e-4 * data.test.forces[:5]
    linear = mor_bench.load_method("linear-fem").fit(data.scene, None).predict(little)
    assert np.abs(improved.predict(little) - linear).max() < 1e-4 * improved.output_scale_


def test_a_mirrored_solution_is_a_solution(data: Dataset) -> None:
    """beam-tiny is fixed at one end and loaded on top, so only left and right are symmetric."""
    (mirror,) = mirrors(data.scene)
    assert mirror.axis == 1
    np.testing.assert_array_equal(mirror.nodes[mirror.nodes], np.arange(data.scene.mesh.n_nodes))
    fem = mor_bench.load_method("fem", tolerance=1e-10).fit(data.scene, None)
    force = data.test.forces[0]
    expected = mirror(fem.predict(force))
    assert np.abs(expected - fem.predict(force)).max() > 1e-3 * np.abs(expected).max()
    found = fem.predict(mirror(force))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert mirrors(load_scene("liver-hex")) == []
    spec = data.scene.spec.model_dump(mode="json", exclude_none=True)
    for fibres, n in (([[1, 1, 0]], 0), ([[1, 1, 0], [1, -1, 0]], 1), ([[1, 0, 0]], 1)):
        material = material_table("holzapfel-gasser-ogden", 500.0, 0.4) | {"fibres": fibres}
        assert len(mirrors(load_scene({**spec, "material": material}))) == n


@pytest.mark.slow
def test_mirror_images_lower_the_error_on_the_other_half(data: Dataset) -> None:
    """Training on one half without mirror images predicts the other half worse."""
    (mirror,) = mirrors(data.scene)
    y = data.scene.mesh.points[:, 1]
    left, right = (
        (data.train.forces[:, side] != 0).any(axis=(1, 2)) for side in (y < 0.5, y > 0.5)
    )
    half = data.train[np.flatnonzero(left & ~right)]
    assert len(half) >= 50
    errors = []
    for mirrored in (True, False):
        method = fit(half, mirrored=mirrored)
        found = method.predict(mirror(half.forces))
        errors.append(np.abs(found - mirror(half.displacements)).mean())
    assert errors[0] < 0.7 * errors[1]


def test_an_interrupted_training_ends_with_the_same_bits(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    knobs = {**IMPROVED, "iterations": 60}

    def interrupt(iteration: int, iterations: int, loss: float) -> None:
        if iteration == 50:
            raise KeyboardInterrupt

    options = TrainingOptions(checkpoint=tmp_path / "checkpoint")
    with pytest.raises(KeyboardInterrupt):
        fit(data.train, replace(options, progress=interrupt), **knobs)
    with pytest.raises(InvalidInputError, match="another training"):
        fit(data.train, options, **{**knobs, "seed": 1})
    assert_same_model(fit(data.train, options, **knobs), fit(data.train, **knobs))


def test_a_training_starts_from_a_network_of_another_scene(
    improved: Any, irregular: tuple[Snapshots, Snapshots], tmp_path: Path
) -> None:
    path, (train, test) = tmp_path / "umesh.safetensors", irregular
    improved.save(path)
    short = {**IMPROVED, "iterations": 5, "learning_rate": 1e-5}
    errors = [
        mean_error(fit(train, TrainingOptions(start_from=start), **short), test)
        for start in (None, path)
    ]
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.parametrize("shape", [(2, 1, 1), (2, 2, 4), (4, 2, 2)])
def test_gradients_in_bfloat16_equal_those_of_float32_up_to_rounding(
    shape: tuple[int, int, int],
) -> None:
    generator = torch.Generator().manual_seed(0)
    block = DoubleConvolution(3, 16, "relu")
    for parameter in block.parameters():
        torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    x = torch.randn(4, 3, *shape, generator=generator)
    found = []
    for precise in (True, False, False):
        block.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=not precise):
            block(x).float().square().mean().backward()
        gradients = [weight.grad for weight in block.parameters() if weight.grad is not None]
        found.append(torch.cat([gradient.ravel() for gradient in gradients]))
    assert torch.equal(found[1], found[2])
    assert (found[1] - found[0]).norm() < 0.02 * found[0].norm()


def test_losses_are_not_rounded_to_bfloat16(data: Dataset) -> None:
    method = fit(data.train, iterations=2, precision="bfloat16", validation_fraction=0.2)
    losses = torch.from_numpy(method.validation_curve_)
    assert (losses.bfloat16().double() != losses).all()
