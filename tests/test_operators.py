"""DeepONet and FNO agree with plain implementations of their equations."""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import StoreError
from mor_bench.scene.grid import grid_map
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_dataset_spec
from tests.irregular import irregular_box, irregular_samples

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.surrogates.field_network import initialise  # noqa: E402 - torch is there
from mor_bench.surrogates.fno import FNO, SpectralConvolution  # noqa: E402
from mor_bench.surrogates.umesh.padded_grid import padded_grid  # noqa: E402

SMALL: dict[str, dict[str, Any]] = {
    "deeponet": {"width": 16, "depth": 2, "n_functions": 8, "n_input_modes": 20},
    "pod-deeponet": {"width": 16, "depth": 2, "n_functions": 8, "n_input_modes": 20},
    "fno": {"channels": 4, "modes": 3, "layers": 2, "batch_size": 8},
    "mesh-graph-net": {"width": 8, "steps": 2, "batch_size": 8},
    "graph-u-net": {"width": 8, "levels": 2, "steps": 1, "batch_size": 8},
    "transolver": {"width": 16, "heads": 2, "slices": 8, "layers": 1, "batch_size": 8},
}


def make(name: str, **knobs: Any) -> Any:
    return mor_bench.load_method(name, **{**SMALL[name], "iterations": 4, **knobs})


def random(*shape: int, seed: int = 0) -> Any:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("shape", "modes"), [((6, 5, 4), 2), ((5, 4, 6), 3), ((4, 3, 5), 9)])
def test_the_spectral_convolution_is_a_circular_convolution_with_a_real_kernel(
    shape: tuple[int, int, int], modes: int
) -> None:
    """The reference sums the kernel over all wave numbers, and the convolution over shifts."""
    layer = SpectralConvolution(shape, modes, 2)
    layer.initialise(torch.Generator().manual_seed(0))
    kept = [[k for k in np.fft.fftfreq(n, 1 / n).astype(int) if abs(k) < modes] for n in shape]
    last = sorted({abs(k) for k in kept[2]})
    assert layer.counts == (len(kept[0]), len(kept[1]), len(last))
    weights = torch.view_as_complex(layer.weight.detach()).numpy()
    points = np.array(list(product(*map(range, shape))))
    kernel = np.zeros((len(points), 2, 2))
    for k, weight in zip(product(kept[0], kept[1], last), weights, strict=True):
        twice = 1 if 2 * k[2] % shape[2] == 0 else 2
        phase = np.exp(2j * np.pi * (points / shape) @ np.array(k))
        kernel += twice * (phase[:, None, None] * weight).real / len(points)
    values = random(*shape, 3, 2).numpy()
    expected = np.zeros_like(values)
    for shift, matrix in zip(points, kernel, strict=True):
        expected += np.roll(values, shift, axis=(0, 1, 2)) @ matrix
    with torch.no_grad():
        found = layer(torch.from_numpy(values)).numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def test_forces_are_spread_over_the_grid_and_displacements_averaged() -> None:
    mesh = irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    grid = padded_grid(grid_map(mesh), 0)
    fields = random(2, mesh.n_nodes, 3)
    spread, averaged = grid.to_grid(fields), grid.displacements_to_grid(fields)
    for adds_up, expected in ((True, spread), (False, averaged)):
        found = FNO(grid, adds_up, 2, 2, 1).encode(fields)
        assert torch.equal(found, expected.permute(0, 2, 3, 4, 1))
    assert not torch.equal(spread, averaged)
    spec = load_dataset_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    for input, observed, adds_up in (
        ("force", {}, True),
        ("force", {"observed": {"region": "z-max"}}, False),
        ("linear-response", {}, False),
    ):
        method = make("fno", input=input)
        method.scene_ = load_scene({**spec, **observed})
        assert method.build_network({}).spread == adds_up


def test_the_padding_keeps_opposite_ends_apart() -> None:
    """Without padding, a force at one end would act on the other end as on a neighbour."""
    network = FNO(padded_grid(grid_map(box_mesh((2.0, 1.0, 1.0), (7, 2, 2))), 0), True, 3, 9, 1)
    assert network.spectral[0].shape == (10, 4, 4)
    initialise(network, torch.Generator().manual_seed(0))
    fields = random(1, 8 * 3 * 3, 3)
    with torch.no_grad():
        values = network.lift(torch.cat([fields.view(8, 3, 3, 1, 3), network.positions], dim=-1))
        padded = torch.zeros(10, 4, 4, 1, 3)
        padded[:8, :3, :3] = values
        padded = network.pointwise[0](padded) + network.spectral[0](padded)
        expected = network.project(padded)[:8, :3, :3].reshape(1, -1, 3)
        torch.testing.assert_close(network(network.encode(fields)), expected)


@pytest.mark.parametrize("name", ["deeponet", "pod-deeponet"])
def test_deeponet_is_the_branch_times_the_trunk(name: str, tiny: Dataset) -> None:
    """The reference is computed for each node and component, from force to displacement."""
    method = make(name).fit(tiny.scene, tiny.train)
    force, network = tiny.test.forces[0], method.network_
    n_nodes = tiny.scene.mesh.n_nodes
    axes = method.arrays_["constant.axes"]
    expected = np.zeros((n_nodes, 3))
    with torch.no_grad():
        inputs = torch.from_numpy((axes.T @ force.ravel() / method.input_scale_).astype(np.float32))
        b = (network.branch(inputs[None]) - network.branch(torch.zeros(1, axes.shape[1])))[0]
        for node, component in product(range(n_nodes), range(3)):
            if name == "deeponet":
                t = network.trunk(network.positions[node])[8 * component :][:8] / 8**0.5
            else:
                modes = method.arrays_["constant.modes"][3 * node + component]
                t = torch.from_numpy(modes.astype(np.float32))
            expected[node, component] = float(b @ t) * method.output_scale_
    expected[tiny.scene.fixed_nodes] = 0.0
    found = method.predict(force)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.01 * method.output_scale_
    if name == "pod-deeponet":
        rows = tiny.train.displacements.reshape(len(tiny.train), -1)
        best = np.linalg.svd(rows, full_matrices=False)[2][:8]
        modes = method.arrays_["constant.modes"]
        np.testing.assert_allclose(best.T @ (best @ modes), modes, atol=1e-9 * np.abs(modes).max())


@pytest.mark.parametrize("name", ["deeponet", "pod-deeponet"])
def test_deeponet_answers_few_outputs_with_less_work(name: str, tiny: Dataset) -> None:
    """Wanted displacements are those of a query for all; the others are NaN or held at zero."""
    needs = tiny.scene.spec.needs.model_copy(update={"outputs": "x-max"})
    few = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"needs": needs}))
    whole, part = (make(name).fit(scene, tiny.train) for scene in (tiny.scene, few))
    forces, work = np.concatenate([tiny.test.forces[:9], 0.0 * tiny.test.forces[:1]]), []
    answers = []
    for method in (whole, part):
        with counted() as found:
            answers.append(method.predict(forces))
        work.append(found.multiply_adds)
    nodes = few.output_nodes
    size = np.abs(answers[0]).max()
    np.testing.assert_allclose(answers[1][:, nodes], answers[0][:, nodes], 0, 1e-6 * size)
    others = np.setdiff1d(np.arange(few.mesh.n_nodes), [*nodes, *few.fixed_nodes])
    assert np.isnan(answers[1][:-1, others]).all()
    assert not answers[1][-1].any()
    assert work[1] < work[0]


@pytest.mark.parametrize("input", ["force", "linear-response"])
@pytest.mark.parametrize("name", SMALL)
def test_the_loss_subtracts_the_output_of_the_network_at_rest(
    name: str, input: str, tiny: Dataset
) -> None:
    """The training is one step on all samples, too small to change the weights."""
    samples = tiny.train[:20]
    knobs = {"input": input, "iterations": 1, "batch_size": 20, "learning_rate": 1e-30}
    method = make(name, loss="absolute", **knobs).fit(tiny.scene, samples)
    error = (method.predict(samples.forces) - samples.displacements) / method.output_scale_
    assert method.loss_curve_[0] == pytest.approx((error**2).mean(), rel=1e-4)
    learned = samples.displacements
    if input == "linear-response":
        linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
        learned = learned - linear.predict(samples.forces)
    assert method.output_scale_ == pytest.approx(np.sqrt((learned**2).mean()), rel=1e-9)


@pytest.mark.parametrize("input", ["force", "linear-response"])
@pytest.mark.parametrize("name", SMALL)
def test_zero_force_gives_zero_displacement_alone_and_in_a_batch(
    name: str, input: str, tiny: Dataset
) -> None:
    method = make(name, input=input).fit(tiny.scene, tiny.train[:60])
    forces = tiny.test.forces[:5].copy()
    forces[3] = 0.0
    answers = method.predict(forces)
    assert not answers[3].any()
    assert not method.predict(forces[3]).any()
    assert answers[[0, 1, 2, 4]].any(axis=(1, 2)).all()
    assert np.abs(method.predict(1e-7 * forces[0])).max() < 1e-3 * np.abs(answers[0]).max()


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", SMALL)
def test_a_second_fit_is_bit_identical_and_leaves_the_global_random_state_alone(
    name: str, tiny: Dataset
) -> None:
    state = torch.get_rng_state()
    first, second = (make(name, iterations=2).fit(tiny.scene, tiny.train[:20]) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), state)
    for key, array in first.arrays_.items():
        np.testing.assert_array_equal(array, second.arrays_[key], err_msg=key)


@pytest.mark.parametrize("name", SMALL)
def test_training_gives_a_lower_error_than_the_linear_response(name: str, tiny: Dataset) -> None:
    """DeepONet is tested on unseen load regions, the others on an irregular mesh."""
    train = test = tiny.train
    if "deeponet" in name:
        test = tiny.test
    else:
        train = test = irregular_samples(60)
        assert train.scene.mesh.grid_index is None
    knobs = {"input": "linear-response", "iterations": 120, "learning_rate": 5e-3}
    method = make(name, loss="absolute", **knobs).fit(train.scene, train)
    linear = mor_bench.load_method("linear-fem").fit(train.scene, None)
    own, without = (
        np.abs(m.predict(test.forces) - test.displacements).mean() for m in (method, linear)
    )
    assert own < 0.95 * without
    assert not method.predict(test.forces)[:, train.scene.fixed_nodes].any()


@pytest.mark.parametrize("name", SMALL)
def test_a_file_whose_arrays_do_not_fit_its_hyperparameters_is_refused(
    name: str, tiny: Dataset, tmp_path: Path
) -> None:
    method, path = make(name).fit(tiny.scene, tiny.train[:20]), tmp_path / "model.safetensors"
    other = copy.copy(method)
    knob = {"fno": "channels", "transolver": "slices"}.get(name, "width")
    setattr(other, knob, SMALL[name][knob] + 1)
    other.save(path)
    with pytest.raises(StoreError, match=r"`network.* must be|do not fit the network"):
        mor_bench.load_surrogate(path)
    forgeries = {"extra": np.ones(3)}
    if "deeponet" in name:
        forgeries = {"constant.axes": np.zeros((5, 3))}
    for key, forged in forgeries.items():
        other = copy.copy(method)
        other.arrays_ = {**method.arrays_, key: forged}
        other.save(path)
        with pytest.raises(StoreError, match=key.removeprefix("constant.")):
            mor_bench.load_surrogate(path)
