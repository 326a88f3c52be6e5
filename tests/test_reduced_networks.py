"""POD-NN, and the derivatives of displacements with respect to the load that it may learn from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.linear_model import Ridge

import mor_bench
from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.reduction.sensitivity import sensitivities
from mor_bench.snapshots.dataset import Dataset
from mor_bench.training_options import TrainingOptions
from tests.relative_errors import median_error

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.surrogates.pod_nn import DERIVATIVE_WEIGHT  # noqa: E402 - after the check that torch is there

BRIEF: dict[str, Any] = {"n_hidden": 32, "iterations": 300}


@pytest.mark.parametrize("of_force", [False, True])
def test_sensitivities_match_finite_differences_of_full_order_solves(
    of_force: bool, tiny: Dataset
) -> None:
    model, few = FullOrderModel(tiny.scene), tiny.train[np.array([3, 40])]
    generator = np.random.default_rng(0)
    axes, modes = (
        generator.normal(size=(model.n_unknowns, 3)),
        generator.normal(size=(model.n_unknowns, 4)),
    )
    known = sensitivities(model, few, axes, modes, of_force)
    assert known.inputs.shape == (2, 3, 3)
    assert known.outputs.shape == (2, 3, 4)
    largest, step, options = (
        np.linalg.norm(few.loads.vectors, axis=2).max(),
        1e-4,
        NewtonOptions(tolerance=1e-12),
    )
    for i in range(2):
        for axis in range(3):
            unit = np.zeros((tiny.scene.mesh.n_nodes, 3))
            unit[:, axis] = largest * tiny.scene.patch_weights.toarray()[few.loads.patches[i, 0]]
            along = unit.ravel()[tiny.scene.free_dofs]
            ahead, behind = (
                model.solve(few.free_forces[i] + sign * step * along, options=options).displacement
                for sign in (1, -1)
            )
            slope, linear = (ahead - behind) / (2 * step), model.rest_factor.solve(along)
            wanted = (along, slope) if of_force else (linear, slope - linear)
            for array, matrix, expected in zip(
                (known.inputs, known.outputs), (axes, modes), wanted, strict=True
            ):
                scale = (
                    np.abs(slope @ modes).max()
                    if matrix is modes
                    else np.abs(expected @ matrix).max()
                )
                np.testing.assert_allclose(
                    array[i, axis], expected @ matrix, rtol=0, atol=2e-5 * scale
                )


def test_samples_without_a_stable_tangent_are_left_out(tiny: Dataset) -> None:
    model, few = FullOrderModel(tiny.scene), tiny.train[:3]
    axes = np.eye(model.n_unknowns)[:, :2]
    squashed = few.free_displacements.copy()
    points = tiny.scene.mesh.points
    squashed[1] = (-0.9 * (points - points.min(axis=0))).ravel()[tiny.scene.free_dofs]
    with pytest.warns(UserWarning, match="not positive definite at 1 of 3 training samples"):
        known = sensitivities(model, replace(few, free_displacements=squashed), axes, axes)
    assert not known.inputs[1].any()
    assert not known.outputs[1].any()
    whole = sensitivities(model, few, axes, axes)
    np.testing.assert_array_equal(known.outputs[[0, 2]], whole.outputs[[0, 2]])
    with pytest.raises(SolverError, match="at any of the 1 training samples"):
        sensitivities(model, replace(few[1:2], free_displacements=squashed[1:2]), axes, axes)


def test_the_networks_of_torch_and_numpy_have_equal_values_and_derivatives() -> None:
    from mor_bench.learning.perceptron import Perceptron, evaluate, slope_at_rest

    network = Perceptron(3, 8, 2, torch.Generator().manual_seed(0)).double()
    generator = np.random.default_rng(0)
    with torch.no_grad():
        for weight in network.parameters():
            weight.copy_(torch.from_numpy(generator.normal(size=tuple(weight.shape))))
    x, directions = generator.normal(size=(5, 3)), generator.normal(size=(5, 4, 3))
    weights = network.arrays()
    values, slopes = (
        found.detach().numpy()
        for found in network.with_derivatives(torch.from_numpy(x), torch.from_numpy(directions))
    )
    np.testing.assert_allclose(values, evaluate(weights, x), atol=1e-12)
    np.testing.assert_allclose(network(torch.from_numpy(x)).detach().numpy(), values, atol=1e-12)
    for k in range(4):
        difference = evaluate(weights, x + 1e-5 * directions[:, k]) - evaluate(
            weights, x - 1e-5 * directions[:, k]
        )
        np.testing.assert_allclose(slopes[:, k], difference / 2e-5, atol=1e-7)
    difference = evaluate(weights, 1e-5 * np.eye(3)) - evaluate(weights, -1e-5 * np.eye(3))
    np.testing.assert_allclose(slope_at_rest(weights), difference / 2e-5, atol=1e-7)
    value, slope = (found.detach().numpy() for found in network.at_rest())
    np.testing.assert_allclose(value, evaluate(weights, 0.0 * x[0]), atol=1e-12)
    np.testing.assert_allclose(slope, slope_at_rest(weights), atol=1e-12)


@pytest.mark.parametrize("n_inputs", [1, 3])
def test_stacked_networks_have_the_values_and_derivatives_of_their_members(n_inputs: int) -> None:
    from mor_bench.learning.perceptron import Perceptron, stacked

    drawn = torch.Generator().manual_seed(0)
    members = [Perceptron(n_inputs, 8, 2, drawn) for _ in range(3)]
    for member in members:
        for bias in (member.weights[1], member.weights[3]):
            torch.nn.init.normal_(bias, generator=drawn)
    together = stacked(members)
    for kept, member in zip(together.members(), members, strict=True):
        for found, expected in zip(kept, member.arrays(), strict=True):
            np.testing.assert_array_equal(found, expected)
    x = torch.randn(5, n_inputs, generator=drawn)
    directions = torch.randn(5, 4, n_inputs, generator=drawn)
    torch.testing.assert_close(together(x), torch.stack([member(x) for member in members]))
    for of_all, *of_each in zip(
        together.with_derivatives(x, directions),
        *(member.with_derivatives(x, directions) for member in members),
        strict=True,
    ):
        torch.testing.assert_close(of_all, torch.stack(of_each))
    value, slope = together.at_rest()
    torch.testing.assert_close(value[:, 0], torch.stack([m.at_rest()[0] for m in members]))
    torch.testing.assert_close(slope, torch.stack([m.at_rest()[1] for m in members]))


@pytest.mark.parametrize("derivatives", [False, True])
@pytest.mark.parametrize("input", ["force", "linear-response"])
def test_the_training_loss_equals_the_loss_of_the_predictions(
    input: str, derivatives: bool, tiny: Dataset, tmp_path: Path
) -> None:
    """Take one step on all samples from a trained network, which is not zero at rest."""
    few, scene = tiny.train[:20], tiny.scene
    sizes = {"n_input_modes": 8, "n_output_modes": 8, "n_hidden": 8}
    knobs = {**sizes, "input": input, "derivatives": derivatives}
    first, second = (mor_bench.load_method("pod-nn", **knobs, iterations=n) for n in (100, 1))
    first.fit(scene, few).save(tmp_path / "model.safetensors")
    second.training = TrainingOptions(start_from=tmp_path / "model.safetensors")
    second.fit(scene, few)
    model, modes = FullOrderModel(scene), first.arrays_["modes"]

    def learned(displacements: Any, forces: Any) -> Any:
        linear = model.rest_factor.solve(forces.T).T if input == "linear-response" else 0.0
        return (displacements - linear) @ modes

    def predicted(forces: Any) -> Any:
        whole = np.zeros((len(forces), scene.mesh.n_dofs))
        whole[:, scene.free_dofs] = forces
        answers = first.predict(whole.reshape(len(forces), -1, 3))
        return learned(answers.reshape(len(forces), -1)[:, scene.free_dofs], forces)

    def weighted(errors: Any) -> Any:
        weights = error_weights(few.free_displacements)[:, None]
        return ((errors * weights) ** 2).sum(axis=1)

    wanted = learned(few.free_displacements, few.free_forces)
    squares = weighted(predicted(few.free_forces) - wanted)
    if derivatives:
        known = sensitivities(model, few, first.arrays_["axes"], modes, input == "force")
        largest = np.linalg.norm(few.loads.vectors, axis=2).max()
        patches = scene.patch_weights.toarray()[few.loads.patches[:, 0]]
        for axis in range(3):
            unit = np.zeros((len(few), scene.mesh.n_nodes, 3))
            unit[:, :, axis] = 1e-4 * largest * patches
            step = unit.reshape(len(few), -1)[:, scene.free_dofs]
            slopes = (predicted(few.free_forces + step) - predicted(few.free_forces - step)) / 2e-4
            squares += DERIVATIVE_WEIGHT * weighted(slopes - known.outputs[:, axis])
    if input == "force":
        wanted = wanted - few.free_forces @ first.arrays_["axes"] @ first.arrays_["linear"]
    expected = np.sqrt(squares / (wanted**2).sum(axis=1).mean()).mean()
    assert second.arrays_["loss_curve"][0] == pytest.approx(expected, rel=1e-3)


def test_of_the_force_the_network_learns_what_ridge_regression_leaves(tiny: Dataset) -> None:
    """One step changes a network little; then the answers are those of the ridge regression."""
    train, n_inputs = tiny.train, 40
    method = mor_bench.load_method("pod-nn-force", n_input_modes=n_inputs, iterations=1, n_hidden=2)
    found = method.fit(tiny.scene, train).arrays_
    z, weights = train.free_forces @ found["axes"], error_weights(train.free_displacements)
    alpha = 1e-6 * ((z * weights[:, None]) ** 2).sum() / n_inputs
    ridge = Ridge(alpha=alpha, fit_intercept=False)
    ridge.fit(z, train.free_displacements @ found["modes"], sample_weight=weights**2)
    largest = np.abs(ridge.coef_).max()
    np.testing.assert_allclose(found["linear"], ridge.coef_.T, rtol=0, atol=1e-6 * largest)
    assert median_error(method, train) < 0.3


@pytest.mark.slow
def test_derivatives_lower_the_error_with_few_samples(tiny: Dataset) -> None:
    few = tiny.train[::6]
    without, with_them = (
        median_error(
            mor_bench.load_method("pod-nn", derivatives=d, **BRIEF).fit(tiny.scene, few), tiny.test
        )
        for d in (False, True)
    )
    assert with_them <= 0.8 * without


@pytest.fixture(scope="module")
def fitted(tiny: Dataset) -> mor_bench.Surrogate:
    return mor_bench.load_method("pod-nn", **BRIEF).fit(tiny.scene, tiny.train)


def test_the_learned_part_is_of_second_order_in_the_load(
    fitted: mor_bench.Surrogate, tiny: Dataset
) -> None:
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    forces = tiny.test.forces[:5].copy()
    forces[2] = 0.0
    learned = [
        np.abs(fitted.predict(size * forces) - linear.predict(size * forces)).max()
        for size in (1e-2, 1e-3)
    ]
    assert learned[0] > 0
    assert learned[1] == pytest.approx(1e-2 * learned[0], rel=0.2)
    assert not fitted.predict(forces)[2].any()


def test_training_loads_are_learned_from_the_force_alone(tiny: Dataset) -> None:
    knobs = {**BRIEF, "input": "force", "n_input_modes": 40, "iterations": 600}
    method = mor_bench.load_method("pod-nn", **knobs)
    assert median_error(method.fit(tiny.scene, tiny.train), tiny.train) < 0.05
    forces = np.zeros((2, tiny.scene.mesh.n_nodes, 3))
    forces[1] = tiny.test.forces[0]
    assert not method.predict(forces)[0].any()


def test_a_training_starts_from_a_saved_model_in_other_bases(
    fitted: mor_bench.Surrogate, tiny: Dataset, tmp_path: Path
) -> None:
    fitted.save(tmp_path / "model.safetensors")
    errors = []
    for start in (None, tmp_path / "model.safetensors"):
        method = mor_bench.load_method("pod-nn", **{**BRIEF, "iterations": 1})
        method.training = TrainingOptions(start_from=start)
        errors.append(median_error(method.fit(tiny.scene, tiny.train[::2]), tiny.test))
    own = median_error(fitted, tiny.test)
    assert errors[1] <= 1.5 * own
    assert errors[0] > 2 * own


@pytest.mark.parametrize("name", ["axes", "network.first", "network.last", "loss_curve"])
def test_damaged_arrays_are_refused(name: str, fitted: mor_bench.Surrogate, tiny: Dataset) -> None:
    array, other = fitted.arrays_[name], mor_bench.load_method("pod-nn", **BRIEF)
    for damaged in (np.full_like(array, np.nan), array[None, :1]):
        with pytest.raises(InvalidInputError, match=name):
            other.restore(tiny.scene, {**fitted.arrays_, name: damaged})


def test_input_axes_and_error_weights_have_their_documented_scale() -> None:
    samples = np.random.default_rng(0).normal(size=(50, 6)) * 10.0 ** -np.arange(6)
    for evenness in (0.0, 0.5, 1.0):
        sizes = np.sqrt(((samples @ input_axes(samples, 4, evenness)) ** 2).mean(axis=0))
        np.testing.assert_allclose(sizes[0] / sizes[3], 10.0 ** (3 * (1 - evenness)), rtol=0.5)
        if evenness != 0.5:
            assert np.mean(sizes**2) == pytest.approx(1)
    weights = error_weights(np.array([[3.0, 0.0], [0.0, 1e-9]]))
    np.testing.assert_allclose(weights, [np.sqrt(0.5), 5.0])
