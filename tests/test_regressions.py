"""Regressions between principal coordinates predict what scikit-learn does, with g(0) = 0."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import InvalidInputError, SpecError, StoreError
from mor_bench.mechanics.compliance import Compliance, project
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.coordinates import error_weights
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.surrogates import pca_regression
from mor_bench.surrogates.kernel_regression import LENGTH_SCALES
from tests.model_files import rewrite

Array = NDArray[np.float64]

INPUTS = ("linear-response", "force")
FAMILIES: dict[str, dict[str, Any]] = {
    "pca-ridge": {},
    "pca-kernel-ridge": {"n_points": 100, "ridge": 1e-8},
    "pca-gaussian-process": {"n_points": 100, "n_optimised": 50},
    "pca-random-forest": {"n_trees": 4},
    "pca-extra-trees": {"n_trees": 4},
}


@pytest.fixture(
    scope="module", params=[(name, source) for name in FAMILIES for source in INPUTS], ids=str
)
def fitted(request: pytest.FixtureRequest, tiny: Dataset) -> Any:
    name, source = request.param
    knobs = {"n_input_modes": 6, "n_output_modes": 5, "input": source, **FAMILIES[name]}
    return mor_bench.load_method(name, **knobs).fit(tiny.scene, tiny.train)


@pytest.fixture(scope="module")
def models(tiny: Dataset) -> dict[str, Any]:
    """A model of each family from few samples."""
    return {
        name: mor_bench.load_method(name, n_input_modes=20, **knobs).fit(
            tiny.scene, tiny.train[:40]
        )
        for name, knobs in FAMILIES.items()
    }


def coordinates(method: Any, data: Dataset) -> tuple[Array, Array, Array]:
    """Inputs and outputs of the training samples, and inputs of the test samples.

    They are rounded as in `fit`, since trees see each bit of them.
    """
    forces = data.train.forces.reshape(len(data.train), -1)
    z = project(method.from_forces_, forces)
    queries = project(method.from_forces_, data.test.forces.reshape(len(data.test), -1))
    inputs, rest = data.train.free_forces, data.train.free_displacements
    if method.input == "linear-response":
        inputs = method.response_.respond(forces)[:, data.scene.free_dofs]
        rest = rest - inputs
    np.testing.assert_allclose(z, inputs @ method.axes_, rtol=0, atol=1e-10 * np.abs(z).max())
    return z, rest @ method.modes_, queries


def by_ridge(method: Any, z: Array, outputs: Array, queries: Array, weights: Array) -> Any:
    """Solve the ridge regression as one least-squares problem."""
    scale = np.sqrt((z**2).mean(axis=0))
    scale = np.maximum(scale, 0.01 * scale.max())
    each = (weights / np.sqrt((weights**2).mean()))[:, None]
    rows = np.vstack([each * z / scale, np.sqrt(method.ridge * len(z)) * np.eye(len(scale))])
    wanted = np.vstack([each * outputs, np.zeros((len(scale), outputs.shape[1]))])
    return queries / scale @ np.linalg.lstsq(rows, wanted)[0]


def by_kernel_ridge(method: Any, z: Array, outputs: Array, queries: Array) -> Any:
    from sklearn.gaussian_process.kernels import RBF
    from sklearn.kernel_ridge import KernelRidge

    gaussian = RBF(LENGTH_SCALES[method.input])
    origin, n = np.zeros((1, z.shape[1])), method.n_points

    def kernel(a: Array, b: Array) -> Any:
        return gaussian(a, b) - gaussian(a, origin) @ gaussian(origin, b)

    model = KernelRidge(alpha=method.ridge, kernel="precomputed")
    return model.fit(kernel(z[:n], z[:n]), outputs[:n]).predict(kernel(queries, z[:n]))


def by_gaussian_process(method: Any, z: Array, outputs: Array, queries: Array) -> Any:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    points = method.points_[:-1]
    np.testing.assert_allclose(points, z[: method.n_points], atol=1e-9 * np.abs(z).max())
    process = GaussianProcessRegressor(RBF(method.lengths_), optimizer=None)
    learned = {"X_train_": method.points_, "alpha_": method.weights_}
    learned |= {"kernel_": RBF(method.lengths_), "_y_train_mean": 0.0, "_y_train_std": 1.0}
    for name, value in learned.items():
        setattr(process, name, value)
    return process.predict(queries)


def by_forest(method: Any, z: Array, outputs: Array, queries: Array) -> Any:
    from sklearn import ensemble

    kinds = {"PCARandomForest": "RandomForestRegressor", "PCAExtraTrees": "ExtraTreesRegressor"}
    kind = getattr(ensemble, kinds[type(method).__name__])
    forest = kind(
        method.n_trees, min_samples_leaf=method.min_samples_leaf, random_state=method.seed
    ).fit(z, outputs)
    return forest.predict(queries) - forest.predict(np.zeros((1, z.shape[1])))


EXPECTED = {
    "PCAKernelRidge": by_kernel_ridge,
    "PCAGaussianProcess": by_gaussian_process,
    "PCARandomForest": by_forest,
    "PCAExtraTrees": by_forest,
}


def test_predictions_match_another_solution(fitted: Any, tiny: Dataset) -> None:
    known, name = coordinates(fitted, tiny), type(fitted).__name__
    if name == "PCARegression":
        expected = by_ridge(fitted, *known, error_weights(tiny.train.free_displacements))
    else:
        expected = EXPECTED[name](fitted, *known)
    predicted = fitted.predict(tiny.test.forces)
    if fitted.input == "linear-response":
        linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
        predicted = predicted - linear.predict(tiny.test.forces)
    found = predicted.reshape(len(tiny.test), -1)[:, tiny.scene.free_dofs] @ fitted.modes_
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_zero_load_gives_zero_displacement_alone_and_in_a_batch(fitted: Any, tiny: Dataset) -> None:
    forces = tiny.test.forces[:3].copy()
    forces[1] = 0.0
    answers = fitted.predict(forces)
    assert not answers[1].any()
    assert not fitted.predict(forces[1]).any()
    assert answers[[0, 2]].any(axis=(1, 2)).all()


def test_a_gaussian_process_passes_near_its_points_and_adapts_its_length_scales(
    tiny: Dataset,
) -> None:
    method: Any = mor_bench.load_method(
        "pca-gaussian-process", n_input_modes=6, n_output_modes=5, n_optimised=100
    ).fit(tiny.scene, tiny.train)
    z, outputs, _ = coordinates(method, tiny)
    np.testing.assert_allclose(method.coefficients(z), outputs, atol=0.03 * np.abs(outputs).max())
    assert np.ptp(method.lengths_) > 0.1


def at(array: NDArray[Any], place: Any, value: float) -> NDArray[Any]:
    changed = array.copy()
    changed[place] = value
    return changed


FORGERIES: list[tuple[str, str, str, Any]] = [
    ("extra-trees", "children", "its own parent", lambda m: at(m["children"], (0, 1), 0)),
    (
        "extra-trees",
        "children",
        "a child behind all nodes",
        lambda m: at(m["children"], (0, 0), len(m["features"])),
    ),
    (
        "random-forest",
        "children",
        "a leaf behind all values",
        lambda m: at(m["children"], (-1, 0), len(m["values"])),
    ),
    (
        "random-forest",
        "children",
        "a leaf before all values",
        lambda m: at(m["children"], (-1, 0), -1),
    ),
    (
        "random-forest",
        "features",
        "an unknown input",
        lambda m: at(m["features"], 0, m["axes"].shape[1]),
    ),
    ("random-forest", "features", "less than a leaf", lambda m: at(m["features"], 0, -2)),
    ("random-forest", "features", "floats", lambda m: m["features"].astype(np.float64)),
    ("random-forest", "features", "64 bits", lambda m: m["features"].astype(np.int64)),
    ("random-forest", "roots", "behind all", lambda m: at(m["roots"], 1, len(m["features"]))),
    ("random-forest", "roots", "before all nodes", lambda m: at(m["roots"], 1, -1)),
    ("random-forest", "thresholds", "NaN", lambda m: at(m["thresholds"], 0, np.nan)),
    ("random-forest", "values", "no outputs", lambda m: m["values"][:, :0]),
    ("kernel-ridge", "lengths", "zero", lambda m: 0 * m["lengths"]),
    ("kernel-ridge", "points", "too large to square", lambda m: 1e200 * (1 + m["points"])),
    ("kernel-ridge", "weights", "too few", lambda m: m["weights"][:-1]),
    ("ridge", "weights", "single precision", lambda m: m["weights"].astype(np.float32)),
]


@pytest.mark.parametrize(
    ("name", "array", "forge"),
    [pytest.param(n, a, f, id=f"{n}: {a}, {what}") for n, a, what, f in FORGERIES],
)
def test_arrays_that_would_mislead_a_kernel_are_refused(
    models: dict[str, Any], tmp_path: Path, name: str, array: str, forge: Any
) -> None:
    method, path = models[f"pca-{name}"], tmp_path / "model.safetensors"
    method.save(path)
    forged = np.ascontiguousarray(forge(method.arrays_))
    rewrite(path, lambda arrays: arrays.update({array: forged}))
    with pytest.raises(StoreError, match=rf"model\.safetensors: .*`{array}`"):
        mor_bench.load_surrogate(path)


def test_restoring_refuses_unknown_arrays_and_length_scales_too_short_to_divide_by(
    models: dict[str, Any], tiny: Dataset
) -> None:
    """Near the origin, such length scales would give NaN."""
    ridge, kernel = (mor_bench.load_method(f"pca-{name}") for name in ("ridge", "kernel-ridge"))
    with pytest.raises(InvalidInputError, match="axes, modes, weights; got axes, modes, other, w"):
        ridge.restore(tiny.scene, {**models["pca-ridge"].arrays_, "other": np.zeros(3)})
    model = dict(models["pca-kernel-ridge"].arrays_)
    short = {name: 1e-300 + 0 * model[name] for name in ("points", "lengths")}
    with pytest.raises(InvalidInputError, match="`lengths` must be at least 1e-06"):
        kernel.restore(tiny.scene, model | short)
    with pytest.raises(InvalidInputError, match="`noise` must be a number >= 0"):
        kernel.restore(tiny.scene, model | {"noise": np.array([-1.0])})


def test_inputs_too_large_for_single_precision_still_reach_a_leaf(
    models: dict[str, Any], tiny: Dataset
) -> None:
    assert np.isfinite(models["pca-extra-trees"].predict(1e29 * tiny.test.forces[:2])).all()


@pytest.mark.parametrize("name", ["pca-random-forest", "pca-extra-trees"])
def test_the_spread_of_an_ensemble_of_trees_is_that_of_its_members(
    models: dict[str, Any], tiny: Dataset, name: str
) -> None:
    forest, forces = models[name], tiny.test.forces
    answers = []
    for root in forest.arrays_["roots"]:
        tree = mor_bench.load_method(name, **{**FAMILIES[name], "n_trees": 1})
        arrays = {**forest.arrays_, "roots": np.array([root])}
        answers.append(tree.restore(tiny.scene, arrays).predict(forces))
    mean = np.mean(answers, axis=0)
    away = np.sqrt(((np.array(answers) - mean) ** 2).sum(axis=(2, 3)).mean(axis=0))
    np.testing.assert_allclose(forest.spread(forces), away / np.linalg.norm(mean, axis=(1, 2)))
    assert forest.spread(forces).min() > 0
    assert forest.spread(0.0 * forces[0]) == 0.0


@pytest.mark.parametrize("name", ["pca-kernel-ridge", "pca-gaussian-process"])
def test_the_spread_of_a_kernel_is_the_deviation_of_the_gaussian_process(
    models: dict[str, Any], tiny: Dataset, name: str
) -> None:
    from sklearn.gaussian_process.kernels import RBF

    method, forces = models[name], tiny.test.forces
    _, outputs, queries = coordinates(method, tiny)
    kernel, points, n = RBF(method.lengths_), method.points_, len(method.points_) - 1
    noise = np.append(np.full(n, method.arrays_["noise"][0]), 0.0)  # the origin is known
    to_points = kernel(queries, points)
    known = np.linalg.solve(kernel(points) + np.diag(noise), to_points.T)
    variance = 1.0 - (to_points * known.T).sum(axis=1)
    most_probable = (outputs[:n] * method.weights_[:n]).sum(axis=0) / n
    sizes = np.sqrt(variance * most_probable.sum())  # the modes are orthonormal
    expected = sizes / np.linalg.norm(method.predict(forces), axis=(1, 2))
    np.testing.assert_allclose(method.spread(forces), expected, rtol=1e-3)
    assert np.median(method.spread(3.0 * forces)) > np.median(method.spread(forces))
    assert method.spread(0.0 * forces[0]) == 0.0
    again: Any = mor_bench.load_method(name, **method.parameters)
    again.restore(tiny.scene, method.arrays_)
    np.testing.assert_array_equal(again.spread(forces), method.spread(forces))


@pytest.mark.parametrize("name", ["pca-kernel-ridge", "pca-gaussian-process"])
def test_kernels_keep_small_loads_accurate_and_certain(
    models: dict[str, Any], tiny: Dataset, name: str
) -> None:
    method = models[name]
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    for factor in (1e-2, 1e-4):
        forces = factor * tiny.test.forces
        expected = linear.predict(forces)
        apart = np.linalg.norm(method.predict(forces) - expected, axis=(1, 2))
        assert np.median(apart / np.linalg.norm(expected, axis=(1, 2))) < 0.01
        assert np.median(method.spread(forces)) < 1.5 * np.median(method.spread(tiny.test.forces))


@pytest.mark.parametrize("order", ["generated", "imported"])
@pytest.mark.parametrize("name", ["pca-kernel-ridge", "pca-gaussian-process"])
def test_kernels_take_samples_from_all_load_regions(tiny: Dataset, name: str, order: str) -> None:
    """Imported snapshots may be ordered by region; the first hundred here cover only ten."""
    train = tiny.train
    if order == "imported":
        train = train[np.argsort(train.regions, kind="stable")]
        loads = NodalLoads(train.forces, train.loads.patches)
        train = Snapshots(train.scene, loads, train.free_displacements, train.min_det_f)
    knobs = {"input": "force", "n_input_modes": 40, **FAMILIES[name]}
    method: Any = mor_bench.load_method(name, **knobs).fit(tiny.scene, train)
    assert len(method.points_) == 101
    assert not method.points_[-1].any()
    z = project(method.from_forces_, train.forces.reshape(len(train), -1))
    seen = [int(np.abs(z - point).max(axis=1).argmin()) for point in method.points_[:-1]]
    assert len(set(seen)) == 100
    np.testing.assert_array_equal(np.unique(train.regions[seen]), np.unique(train.regions))
    assert (sorted(seen) == list(range(100))) == (order == "generated")


@pytest.mark.parametrize(
    ("name", "knob", "value", "message"),
    [
        ("pca-regression-linear", "ridge", np.inf, "a finite number; got inf"),
        ("pca-kernel-ridge", "ridge", np.inf, "a finite number; got inf"),
        ("pca-kernel-ridge", "length_scale", 1e-300, "greater than or equal to 0.01; got 1e-300"),
        ("pca-kernel-ridge", "length_scale", np.inf, "less than or equal to 1000; got inf"),
    ],
)
def test_hyperparameters_that_give_infinite_numbers_are_refused(
    name: str, knob: str, value: float, message: str
) -> None:
    with pytest.raises(SpecError, match=f"`{knob}` must be {message}"):
        mor_bench.load_method(name, **{knob: value})


def test_more_monomials_than_fit_into_memory_are_refused(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = tiny.train[:40]
    monkeypatch.setattr(pca_regression, "MAX_FEATURE_BYTES", 8 * 65 * 40)
    mor_bench.load_method("pca-regression-linear", n_input_modes=10, degree=2).fit(
        tiny.scene, train
    )
    message = (
        r"`degree` 2 of 11 input modes gives 77 monomials, .* lower `degree` or `n_input_modes`"
    )
    with pytest.raises(InvalidInputError, match=message):
        mor_bench.load_method("pca-regression-linear", n_input_modes=11, degree=2).fit(
            tiny.scene, train
        )


@pytest.mark.parametrize(
    "name",
    [
        "linear-fem",
        "pca-regression",
        "pca-regression-linear",
        "pca-kernel-ridge",
        "pgd-snapshots",
        "pgd-snapshots-force",
        "pgd-weak-form",
    ],
)
def test_a_query_for_few_outputs_costs_less_and_gives_the_same(tiny: Dataset, name: str) -> None:
    """Wanted displacements are those of a query for all; the others are NaN."""
    needs = tiny.scene.spec.needs.model_copy(update={"outputs": "x-max"})
    few = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"needs": needs}))
    nodes, forces = few.output_nodes, tiny.test.forces[:20]
    answers, work = [], []
    for scene in (tiny.scene, few):
        method = mor_bench.load_method(name).fit(scene, tiny.train)
        with counted() as found:
            answers.append(method.predict(forces))
        work.append(found.multiply_adds)
    np.testing.assert_allclose(answers[1][:, nodes], answers[0][:, nodes], rtol=0, atol=1e-14)
    assert np.isnan(np.delete(answers[1], nodes, axis=1)).all()
    assert work[1] < work[0]


def test_loads_elsewhere_are_answered_for_few_outputs_too(tiny: Dataset) -> None:
    """A load on nodes without kept columns takes a back-solve."""
    compliance = Compliance(FullOrderModel(tiny.scene))
    loads = np.random.default_rng(0).normal(size=(2, tiny.scene.mesh.n_dofs))
    loads[1] = tiny.test.forces[0].ravel()
    dofs = np.array([5, 100, 150])
    found = compliance.at(dofs)(loads)
    size = np.abs(found).max()
    np.testing.assert_allclose(found, compliance.respond(loads)[:, dofs], 0, 1e-12 * size)
