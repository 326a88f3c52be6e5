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
from mor_bench.errors import InvalidInputError, MorBenchError, SpecError, StoreError
from mor_bench.scene.grid import grid_map
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import load_dataset_spec
from mor_bench.surrogate import Surrogate
from mor_bench.training_options import TrainingOptions
from tests.irregular import irregular_box

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import training  # noqa: E402 - after the check that torch is there
from mor_bench.scene.symmetry import mirrors  # noqa: E402
from mor_bench.surrogates.umesh.network import DoubleConvolution, UNet, new_network  # noqa: E402
from mor_bench.surrogates.umesh.padded_grid import padded_grid  # noqa: E402

SMALL = {
    "channels": 8,
    "steps": 1,
    "iterations": 400,
    "batch_size": 16,
    "learning_rate": 3e-3,
    "schedule": "one-cycle",
    "second_moment_decay": 0.99,
}


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

    expected = (
        convolution(3, channels, 3)
        + convolution(channels, channels, 3)
        + convolution(channels, 3, 1)
    )
    for level in range(steps):
        here, below = channels * 2**level, channels * 2 ** (level + 1)
        expected += convolution(here, below, 3) + convolution(
            below, below, 3
        )  # encoder below, or the bottom
        expected += (
            convolution(below, here, 2)
            + convolution(2 * here, here, 3)
            + convolution(here, here, 3)
        )
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
    grid = padded_grid(grid_map(mesh), 2)
    assert grid.shape == (8, 4, 4)
    nodal = torch.randn(5, mesh.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    values = grid.to_grid(nodal)
    assert values.is_contiguous(memory_format=torch.channels_last_3d)
    torch.testing.assert_close(grid.to_nodes(values), nodal, rtol=0, atol=0)
    torch.testing.assert_close(
        values[:, :, :7, :3, :3], nodal.view(5, 7, 3, 3, 3).permute(0, 4, 1, 2, 3), rtol=0, atol=0
    )
    assert int((values != 0).sum()) == nodal.numel()


def test_grid_of_a_part_of_a_box() -> None:
    """Nodes in any order, not all of the grid: each lands at its own place."""
    whole = box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
    kept = np.random.default_rng(0).permutation(whole.n_nodes)[:40]
    assert whole.grid_index is not None
    part = replace(whole, points=whole.points[kept], grid_index=whole.grid_index[kept])
    full = torch.randn(2, whole.n_nodes, 3, generator=torch.Generator().manual_seed(0))
    grid = padded_grid(grid_map(part), 1)
    values = grid.to_grid(full[:, kept])
    body = grid.to_grid(torch.ones(1, 40, 3))
    assert int(body.sum()) == 3 * 40
    torch.testing.assert_close(
        values, padded_grid(grid_map(whole), 1).to_grid(full) * body, rtol=0, atol=0
    )
    torch.testing.assert_close(grid.to_nodes(values), full[:, kept], rtol=0, atol=0)


@pytest.mark.parametrize("regular", [True, False])
def test_gradients_at_the_nodes_go_to_the_grid_points_around_them_and_none_to_padding(
    regular: bool,
) -> None:
    """The product rule written out with the dense matrix N, and torch's own numerical gradients."""
    mesh = (
        box_mesh((2.0, 1.0, 1.0), (6, 2, 2))
        if regular
        else irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    )
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


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("loss", ["absolute", "relative"])
def test_the_loss_is_the_mean_square_over_the_components_of_all_nodes(
    regular: bool, loss: str, data: Dataset, irregular: tuple[Snapshots, Snapshots]
) -> None:
    """Before the first step, on one batch of all samples; values of the network at padding do not enter."""
    samples = data.train[:20] if regular else irregular[0][:20]
    method = mor_bench.load_method(
        "umesh", **{**SMALL, "iterations": 1, "batch_size": 20, "loss": loss}
    ).fit(samples.scene, samples)
    grid, network = (
        padded_grid(grid_map(samples.scene.mesh), 1),
        new_network(8, 1, torch.Generator().manual_seed(0)),
    )
    with torch.inference_mode():
        inputs = grid.to_grid(
            torch.from_numpy((samples.forces / rms(samples.forces)).astype(np.float32))
        )
        flat = network(inputs).permute(0, 2, 3, 4, 1).reshape(20, -1, 3).numpy()
    targets = samples.displacements / rms(samples.displacements)
    errors = np.square(np.einsum("ng,sgc->snc", grid.grid.weights.toarray(), flat) - targets).mean(
        axis=(1, 2)
    )
    weights = (
        np.ones(20)
        if loss == "absolute"
        else 1 / np.maximum(np.square(targets).mean(axis=(1, 2)), 0.1**2)
    )
    assert method.loss_curve_[0] == pytest.approx(
        (weights / weights.mean() * errors).mean(), rel=1e-5
    )  # type: ignore[attr-defined]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_normalisation_divides_by_what_it_says(data: Dataset) -> None:
    forces, displacements = data.train.forces, data.train.displacements
    expected = {
        "rms": (rms(forces), rms(displacements)),
        "max": (np.abs(forces).max(), np.abs(displacements).max()),
        "none": (1.0, 1.0),
    }
    for normalisation, scales in expected.items():
        method: Any = mor_bench.load_method(
            "umesh", channels=2, steps=1, iterations=1, normalisation=normalisation
        ).fit(data.scene, data.train)
        assert (method.input_scale_, method.output_scale_) == pytest.approx(scales)


def test_training_beats_predicting_zero(fitted: Surrogate, data: Dataset) -> None:
    error = mean_dof_error(fitted.predict(data.test.forces), data.test.displacements)
    assert error < 0.4 * mean_dof_error(
        np.zeros_like(data.test.displacements), data.test.displacements
    )


def test_loss_curve_falls(fitted: Surrogate) -> None:
    curve = fitted.loss_curve_  # type: ignore[attr-defined]
    assert curve.shape == (8,)
    assert curve[-1] < 0.1 * curve[0]


def test_a_second_fit_is_bit_identical_and_leaves_global_random_state_alone(
    fitted: Surrogate, data: Dataset
) -> None:
    before = torch.get_rng_state()
    numpy_before = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002 - the global state is the subject
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    again = mor_bench.load_method("umesh", **SMALL).fit(data.scene, data.train)
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # type: ignore[index]  # noqa: NPY002
    assert (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()) == (
        threads,
        deterministic,
    )
    first, second = fitted.arrays_, again.arrays_
    assert first.keys() == second.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name], err_msg=name)


def test_another_seed_gives_another_network(data: Dataset) -> None:
    one, two = (
        mor_bench.load_method("umesh", **{**SMALL, "iterations": 2, "seed": seed}).fit(
            data.scene, data.train
        )
        for seed in (0, 1)
    )
    assert not np.array_equal(one.predict(data.test.forces[0]), two.predict(data.test.forces[0]))


def test_saved_and_loaded_is_the_same_model(
    fitted: Surrogate, data: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "umesh.safetensors"
    fitted.save(path)
    loaded = mor_bench.load_surrogate(path)
    np.testing.assert_array_equal(
        loaded.predict(data.test.forces), fitted.predict(data.test.forces)
    )
    assert loaded.parameters == fitted.parameters
    np.testing.assert_array_equal(loaded.loss_curve_, fitted.loss_curve_)  # type: ignore[attr-defined]


def test_a_file_with_other_weights_is_refused(fitted: Surrogate, tmp_path: Path) -> None:
    path = tmp_path / "umesh.safetensors"
    other = copy.copy(fitted)
    other.channels = 4  # type: ignore[attr-defined]
    other.save(path)
    with pytest.raises(StoreError, match="`network.* must be|do not fit the network"):
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
def test_forces_that_are_not_finite_are_refused(
    fitted: Surrogate, data: Dataset, bad: float
) -> None:
    force = data.test.forces[0].copy()
    force[5, 2] = bad
    with pytest.raises(InvalidInputError, match="finite"):
        fitted.predict(force)


def test_divergence_is_an_error(data: Dataset) -> None:
    method = mor_bench.load_method("umesh", channels=2, steps=1, iterations=60, learning_rate=1e30)
    with pytest.raises(MorBenchError, match="diverged"):
        method.fit(data.scene, data.train)


@pytest.fixture(scope="module")
def irregular() -> tuple[Snapshots, Snapshots]:
    """Training and test samples of beam-tiny with tetrahedra whose nodes lie in no regular grid."""
    spec = load_dataset_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    scene = load_scene({**spec, "discretisation": {"element": "tetrahedron"}})
    mesh = irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    scene = replace(scene, mesh=mesh, fixed_nodes=np.flatnonzero(mesh.points[:, 0] == 0))
    loads = draw_loads(scene, 0, 140)
    displacements = (
        mor_bench.load_method("fem")
        .fit(scene, None)
        .predict(loads.nodal_forces(scene.patch_weights))
    )
    samples = Snapshots(
        scene, loads, displacements.reshape(140, -1)[:, scene.free_dofs], np.ones(140)
    )
    return samples[:100], samples[100:]


@pytest.fixture(scope="module")
def fitted_irregular(irregular: tuple[Snapshots, Snapshots]) -> Surrogate:
    return mor_bench.load_method("umesh", **SMALL).fit(irregular[0].scene, irregular[0])


def test_a_mesh_without_a_grid_is_learned(
    fitted_irregular: Surrogate, irregular: tuple[Snapshots, Snapshots]
) -> None:
    test = irregular[1]
    assert test.scene.mesh.grid_index is None
    assert fitted_irregular.grid_.places is None  # type: ignore[attr-defined]
    answer = fitted_irregular.predict(test.forces)
    assert mean_dof_error(answer, test.displacements) < 0.4 * mean_dof_error(
        np.zeros_like(answer), test.displacements
    )
    assert (answer[:, test.scene.fixed_nodes] == 0).all()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_second_fit_without_a_grid_is_bit_identical(
    irregular: tuple[Snapshots, Snapshots], threads: int
) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        first, second = (
            mor_bench.load_method("umesh", **{**SMALL, "iterations": 4}).fit(
                irregular[0].scene, irregular[0]
            )
            for _ in range(2)
        )
    finally:
        torch.set_num_threads(before)
    for name, array in first.arrays_.items():
        np.testing.assert_array_equal(array, second.arrays_[name], err_msg=name)


def test_saved_and_loaded_without_a_grid_is_the_same_model(
    fitted_irregular: Surrogate,
    irregular: tuple[Snapshots, Snapshots],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, test = tmp_path / "umesh.safetensors", irregular[1]
    fitted_irregular.save(path)
    monkeypatch.setattr(
        "mor_bench.surrogate.load_scene", lambda _: test.scene
    )  # the file holds the spec, which names a box
    np.testing.assert_array_equal(
        mor_bench.load_surrogate(path).predict(test.forces), fitted_irregular.predict(test.forces)
    )


IMPROVED = {
    **SMALL,
    "input": "linear-response",
    "activation": "silu",
    "zero_at_rest": True,
    "mirrored": True,
}


@pytest.fixture(scope="module")
def improved(data: Dataset) -> Surrogate:
    return mor_bench.load_method("umesh", **IMPROVED).fit(data.scene, data.train)


def test_the_linear_response_brings_most(
    improved: Surrogate, fitted: Surrogate, data: Dataset
) -> None:
    linear = mor_bench.load_method("linear-fem").fit(data.scene, None)
    errors = [
        mean_dof_error(method.predict(data.test.forces), data.test.displacements)
        for method in (improved, linear, fitted)
    ]
    assert errors[0] < 0.8 * errors[1]
    assert errors[0] < 0.2 * errors[2]


def test_no_force_gives_exactly_no_displacement(
    improved: Surrogate, fitted: Surrogate, data: Dataset
) -> None:
    nothing = np.zeros((3, data.scene.mesh.n_nodes, 3))
    assert not improved.predict(nothing).any()
    assert fitted.predict(nothing).any(), "the paper's network has biases"
    little = 1e-4 * data.test.forces[:5]
    linear = mor_bench.load_method("linear-fem").fit(data.scene, None).predict(little)
    assert np.abs(improved.predict(little) - linear).max() < 1e-4 * improved.output_scale_  # type: ignore[attr-defined]


def test_saved_and_loaded_improved_is_the_same_model(
    improved: Surrogate, data: Dataset, tmp_path: Path
) -> None:
    improved.save(tmp_path / "umesh.safetensors")
    loaded = mor_bench.load_surrogate(tmp_path / "umesh.safetensors")
    np.testing.assert_array_equal(
        loaded.predict(data.test.forces[:5]), improved.predict(data.test.forces[:5])
    )


def test_mirror_planes_are_those_of_mesh_supports_and_loads(data: Dataset) -> None:
    """beam-tiny is held at an end and loaded on its top: only left and right are alike. A mirrored solution is a solution."""
    (mirror,) = mirrors(data.scene)
    assert mirror.axis == 1
    np.testing.assert_array_equal(mirror.nodes[mirror.nodes], np.arange(data.scene.mesh.n_nodes))
    fem = mor_bench.load_method("fem", tolerance=1e-10).fit(data.scene, None)
    force = data.test.forces[0]
    expected = mirror(fem.predict(force))
    assert np.abs(expected - fem.predict(force)).max() > 1e-3 * np.abs(expected).max()
    np.testing.assert_allclose(
        fem.predict(mirror(force)), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    assert mirrors(load_scene("liver-hex")) == []


def test_mirror_images_are_learned_from_one_half(data: Dataset) -> None:
    """Trained on loads of one half, the mirrored half is predicted as well; without the images it is not."""
    (mirror,) = mirrors(data.scene)
    left = (data.train.forces[:, data.scene.mesh.points[:, 1] < 0.5] != 0).any(axis=(1, 2))
    right = (data.train.forces[:, data.scene.mesh.points[:, 1] > 0.5] != 0).any(axis=(1, 2))
    half = data.train[np.flatnonzero(left & ~right)]
    assert len(half) > 50
    errors = {}
    for mirrored in (True, False):
        method = mor_bench.load_method("umesh", **{**SMALL, "mirrored": mirrored}).fit(
            data.scene, half
        )
        errors[mirrored] = mean_dof_error(
            method.predict(mirror(half.forces)), mirror(half.displacements)
        )
    assert errors[True] < 0.6 * errors[False]


def test_a_training_that_was_stopped_resumes_to_the_same_bits(
    data: Dataset, improved: Surrogate, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    method = mor_bench.load_method("umesh", **IMPROVED)
    done: list[int] = []

    def progress(iteration: int, iterations: int, loss: float) -> None:
        if iteration == 200 and not done:
            done.append(iteration)
            raise KeyboardInterrupt

    method.training = TrainingOptions(checkpoint=tmp_path / "checkpoint", progress=progress)
    with pytest.raises(KeyboardInterrupt):
        method.fit(data.scene, data.train)
    other = mor_bench.load_method("umesh", **{**IMPROVED, "seed": 1})
    other.training = method.training
    with pytest.raises(InvalidInputError, match="another training"):
        other.fit(data.scene, data.train)
    method.fit(data.scene, data.train)
    for name, array in improved.arrays_.items():
        np.testing.assert_array_equal(array, method.arrays_[name], err_msg=name)


def test_transfer_starts_from_a_network_of_another_scene(
    improved: Surrogate, irregular: tuple[Snapshots, Snapshots], tmp_path: Path
) -> None:
    path, (train, test) = tmp_path / "umesh.safetensors", irregular
    improved.save(path)
    errors = []
    for start in (None, path):
        method = mor_bench.load_method(
            "umesh", **{**IMPROVED, "iterations": 20, "learning_rate": 1e-4}
        )
        method.training = TrainingOptions(start_from=start)
        errors.append(
            mean_dof_error(method.fit(train.scene, train).predict(test.forces), test.displacements)
        )
    assert errors[1] < 0.7 * errors[0]
    wrong = mor_bench.load_method("umesh", **{**IMPROVED, "channels": 4})
    wrong.training = TrainingOptions(start_from=path)
    with pytest.raises(InvalidInputError, match="`channels` 4; got"):
        wrong.fit(train.scene, train)


@pytest.mark.parametrize("shape", [(2, 1, 1), (2, 2, 4), (4, 2, 2)])
def test_gradients_in_bfloat16_are_those_of_float32_but_for_rounding(
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
        found.append(
            torch.cat(
                [
                    parameter.grad.ravel()
                    for parameter in block.parameters()
                    if parameter.grad is not None
                ]
            )
        )
    assert torch.equal(found[1], found[2])
    assert (found[1] - found[0]).norm() < 0.02 * found[0].norm()


def test_losses_are_not_rounded_with_the_products(data: Dataset) -> None:
    knobs = {
        **SMALL,
        "iterations": 3,
        "batch_size": 64,
        "precision": "bfloat16",
        "validation_fraction": 0.2,
    }
    curve: Any = mor_bench.load_method("umesh", **knobs).fit(data.scene, data.train)
    losses = torch.from_numpy(curve.validation_curve_)
    assert (losses.bfloat16().double() != losses).all()


def test_weights_to_start_from_that_are_not_finite_are_refused(
    fitted: Surrogate, data: Dataset, tmp_path: Path
) -> None:
    other: Any = copy.deepcopy(fitted)
    with torch.no_grad():
        other.network_.head.bias[1] = float("nan")
    other.save(tmp_path / "umesh.safetensors")
    method = mor_bench.load_method("umesh", **SMALL)
    method.training = TrainingOptions(start_from=tmp_path / "umesh.safetensors")
    with pytest.raises(StoreError, match="NaN or infinity"):
        method.fit(data.scene, data.train)


@pytest.mark.parametrize(
    ("knob", "value"),
    [("channels", 0), ("steps", 0), ("schedule", "step"), ("learning_rate", 0.0), ("seed", -1)],
)
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
        y = double(
            torch.cat([skips.pop(), functional.conv_transpose3d(y, weight, bias, stride=2)], dim=1)
        )
    with torch.inference_mode():
        torch.testing.assert_close(network(x), functional.conv3d(y, *head), rtol=1e-5, atol=1e-5)


def test_displacements_on_the_grid_are_means_of_the_nodes_around(
    irregular: tuple[Snapshots, Snapshots],
) -> None:
    """A constant field stays constant wherever there is body, and is zero beside it; a linear one keeps its values at nodes on points."""
    grid = padded_grid(grid_map(irregular[0].scene.mesh), 1)
    assert grid.places is None
    n_nodes = irregular[0].scene.mesh.n_nodes
    values = grid.displacements_to_grid(torch.ones(2, n_nodes, 3))
    body = torch.from_numpy((grid.grid.weights.sum(axis=0) > 1e-2).reshape(grid.shape))
    torch.testing.assert_close(values[:, :, body], torch.ones(2, 3, int(body.sum())))
    assert not values[
        :, :, torch.from_numpy((grid.grid.weights.sum(axis=0) == 0).reshape(grid.shape))
    ].any()
    regular = padded_grid(grid_map(box_mesh((2.0, 1.0, 1.0), (6, 2, 2))), 1)
    nodal = torch.randn(1, 63, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        regular.displacements_to_grid(nodal), regular.to_grid(nodal), rtol=0, atol=0
    )
