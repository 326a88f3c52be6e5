"""Regressions between principal coordinates, and the linear response by columns that they begin with."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save as serialise

import mor_bench
from mor_bench.counting import Cost, counted, triangular_multiply_adds
from mor_bench.errors import StoreError
from mor_bench.mechanics import banded
from mor_bench.mechanics import compliance as compliance_module
from mor_bench.mechanics.banded import BandedCholesky, BandedFactor
from mor_bench.mechanics.compliance import Compliance, project
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.model_file import model_digest as file_digest
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.specs import SolverName, load_generated_spec
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates import pca_regression
from mor_bench.surrogates.kernel_regression import LENGTH_SCALES

INPUTS = ("linear-response", "force")
FAMILIES: dict[str, dict[str, Any]] = {
    "pca-ridge": {},
    "pca-kernel-ridge": {"n_points": 100},
    "pca-gaussian-process": {"n_points": 100, "n_optimised": 50},
    "pca-random-forest": {"n_trees": 4},
    "pca-extra-trees": {"n_trees": 4},
}


def scene_with(element: str, integration: str) -> Scene:
    spec = load_generated_spec("beam-tiny")
    changed = spec.discretisation.model_copy(
        update={"element": element, "integration": integration}
    )
    return load_scene(spec.model_copy(update={"discretisation": changed}))


def patch_loads(scene: Scene, n: int) -> NDArray[np.float64]:
    """(n, n_dofs) forces of random direction on some patches."""
    rng = np.random.default_rng(0)
    weights = scene.patch_weights.toarray()
    chosen = weights[np.linspace(0, len(weights) - 1, n).astype(int)]
    return np.asarray((chosen[:, :, None] * rng.normal(size=(n, 1, 3))).reshape(n, -1))


def by_back_solves(model: FullOrderModel, loads: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.zeros_like(loads)
    for row, load in zip(out, loads, strict=True):
        row[model.scene.free_dofs] = model.rest_factor.solve(load[model.scene.free_dofs])
    return out


SCENES = {
    "H8, full": ("hexahedron", "full"),
    "H8, selective": ("hexahedron", "selective"),
    "T4": ("tetrahedron", "full"),
}


@pytest.mark.parametrize("case", [*SCENES, "l-shape", "liver-hex"])
def test_columns_and_back_solves_give_the_same_response(case: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of locking
        scene = scene_with(*SCENES[case]) if case in SCENES else load_scene(case)
        model = FullOrderModel(scene)
    compliance, loads = Compliance(model), patch_loads(scene, 12)
    expected = by_back_solves(model, loads)
    with counted() as cost:
        found = compliance.respond(loads)
    free = scene.free_dofs
    assert cost == Cost(multiply_adds=int(np.count_nonzero(loads[:, free])) * len(free))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert not found[:, np.setdiff1d(np.arange(scene.mesh.n_dofs), free)].any()
    np.testing.assert_array_equal(found[3], compliance.respond(loads[3:4])[0])
    np.testing.assert_array_equal(compliance.solve(loads[3, free]), found[3, free])
    np.testing.assert_array_equal(compliance.solve(loads[:, free].T), found[:, free].T)
    axes = np.random.default_rng(1).normal(size=(len(free), 4))
    reduced = project(compliance.to_coordinates(axes), loads)
    np.testing.assert_allclose(
        reduced, expected[:, free] @ axes, rtol=0, atol=1e-11 * np.abs(reduced).max()
    )


@pytest.mark.parametrize("solver", ["cholesky", "superlu", "pardiso", "jacobi-pcg"])
def test_loads_without_columns_are_solved_for(tiny: Dataset, solver: SolverName) -> None:
    """On other nodes, on more than pays, on supports too; in one batch with those that have columns."""
    if solver == "pardiso":
        pytest.importorskip("pypardiso")
    scene, model = tiny.scene, FullOrderModel(tiny.scene, solver)
    compliance, n = Compliance(model), tiny.scene.mesh.n_dofs
    loads = patch_loads(scene, 4)
    elsewhere = np.setdiff1d(scene.free_dofs // 3, np.unique(scene.patch_weights.indices))[0]
    loads[1, 3 * elsewhere] = 1.0
    loads[2] = np.random.default_rng(0).normal(size=n)
    loads[3, 3 * scene.fixed_nodes[0]] = 5.0
    with counted() as cost:
        found = compliance.respond(loads)
    np.testing.assert_allclose(
        found, by_back_solves(model, loads), rtol=0, atol=1e-11 * np.abs(found).max()
    )
    if solver in ("cholesky", "superlu"):
        assert cost.back_solves == 2
    else:
        assert compliance.columns.shape == (0, n)
    assert not compliance.respond(np.zeros((2, n))).any()


def test_more_columns_than_pay_are_not_used_or_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("beam-coarse")
    model = FullOrderModel(scene)
    n, bandwidth = len(scene.free_dofs), BandedCholesky(model.assembler.pattern).bandwidth
    few = triangular_multiply_adds(n, bandwidth) // n
    touched = dofs_of_nodes(np.unique(scene.patch_weights.indices))
    touched = touched[np.isin(touched, scene.free_dofs)]
    loads = np.zeros((2, scene.mesh.n_dofs))
    loads[0, touched[:few]] = loads[1, touched[: few + 1]] = 1.0
    assert few < len(touched)
    compliance = Compliance(model)
    for load, n_solves in zip(loads, (0, 1), strict=True):
        with counted() as cost:
            compliance.respond(load[None])
        assert cost.back_solves == n_solves
    monkeypatch.setattr(compliance_module, "MAX_BYTES", compliance.columns.nbytes - 1)
    without = Compliance(model)
    assert len(without.columns) == 0
    np.testing.assert_allclose(
        without.respond(loads), compliance.respond(loads), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("scene", ["l-shape", "liver-hex"])
def test_many_right_hand_sides_are_solved_for_as_few(
    scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By blocks, in natural order and reordered, the last block shorter than the others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = FullOrderModel(load_scene(scene))
    factor, n = model.rest_factor, model.n_unknowns
    assert isinstance(factor, BandedFactor)
    rhs = np.random.default_rng(0).normal(size=(n, 70))
    many = factor.solve(rhs)
    monkeypatch.setattr(linear, "MANY", 100)
    few = factor.solve(rhs)
    assert n % banded.BLOCK
    assert not np.array_equal(many, few)  # else both took one way
    np.testing.assert_allclose(many, few, rtol=0, atol=1e-11 * np.abs(few).max())


@pytest.fixture(
    scope="module", params=[(name, source) for name in FAMILIES for source in INPUTS], ids=str
)
def fitted(request: pytest.FixtureRequest, tiny: Dataset) -> Surrogate:
    name, source = request.param
    knobs = {"n_input_modes": 6, "n_output_modes": 5, "input": source, **FAMILIES[name]}
    return mor_bench.load_method(name, **knobs).fit(tiny.scene, tiny.train)


def coordinates(
    method: Any, data: Dataset
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Inputs and outputs of the training samples, and the inputs of the test samples, rounded as in `fit`: trees see each bit of them."""
    rest = data.train.free_displacements
    z, queries = (
        project(method.from_forces_, part.forces.reshape(len(part), -1))
        for part in (data.train, data.test)
    )
    if method.input == "linear-response":
        responses = method.response_.respond(data.train.forces.reshape(len(data.train), -1))[
            :, data.scene.free_dofs
        ]
        np.testing.assert_allclose(
            z, responses @ method.axes_, rtol=0, atol=1e-10 * np.abs(z).max()
        )
        rest = rest - responses
    else:
        np.testing.assert_allclose(
            z, data.train.free_forces @ method.axes_, rtol=0, atol=1e-10 * np.abs(z).max()
        )
    return z, rest @ method.modes_, queries


def expected_outputs(
    method: Any, z: NDArray[np.float64], outputs: NDArray[np.float64], queries: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What scikit-learn predicts, with g(0) = 0 in each family's own way."""
    from sklearn.ensemble import ExtraTreesRegressor, RandomForestRegressor
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF
    from sklearn.kernel_ridge import KernelRidge
    from sklearn.linear_model import Ridge

    kind = type(method).__name__
    if kind == "PCARegression":
        scale = np.sqrt((z**2).mean(axis=0))
        found = (
            Ridge(alpha=method.ridge * len(z), fit_intercept=False)
            .fit(z / scale, outputs)
            .predict(queries / scale)
        )
    elif kind == "PCAKernelRidge":
        gaussian = RBF(LENGTH_SCALES[method.input])
        origin = np.zeros((1, z.shape[1]))

        def kernel(a: NDArray[np.float64], b: NDArray[np.float64]) -> Any:
            return gaussian(a, b) - gaussian(a, origin) @ gaussian(origin, b)

        n = method.n_points
        model = KernelRidge(alpha=method.ridge, kernel="precomputed").fit(
            kernel(z[:n], z[:n]), outputs[:n]
        )
        found = model.predict(kernel(queries, z[:n]))
    elif kind == "PCAGaussianProcess":
        process = GaussianProcessRegressor(RBF(method.lengths_), optimizer=None)
        process.X_train_, process.alpha_, process.kernel_ = (
            method.points_,
            method.weights_,
            RBF(method.lengths_),
        )
        process._y_train_mean, process._y_train_std = (
            np.zeros(outputs.shape[1]),
            np.ones(outputs.shape[1]),
        )
        np.testing.assert_allclose(
            method.points_[:-1], z[: method.n_points], atol=1e-9 * np.abs(z).max()
        )
        found = process.predict(queries)
    else:
        ensemble = {"PCARandomForest": RandomForestRegressor, "PCAExtraTrees": ExtraTreesRegressor}[
            kind
        ]
        forest = ensemble(
            method.n_trees, min_samples_leaf=method.min_samples_leaf, random_state=method.seed
        ).fit(z, outputs)
        found = forest.predict(queries) - forest.predict(np.zeros((1, z.shape[1])))
    return np.asarray(found)


def test_predictions_are_those_of_scikit_learn(fitted: Any, tiny: Dataset) -> None:
    z, outputs, queries = coordinates(fitted, tiny)
    predicted = fitted.predict(tiny.test.forces).reshape(len(tiny.test), -1)
    if fitted.input == "linear-response":
        predicted = predicted - by_back_solves(
            FullOrderModel(tiny.scene), tiny.test.forces.reshape(len(tiny.test), -1)
        )
    expected = expected_outputs(fitted, z, outputs, queries)
    np.testing.assert_allclose(
        predicted[:, tiny.scene.free_dofs] @ fitted.modes_,
        expected,
        rtol=0,
        atol=1e-6 * np.abs(expected).max(),
    )


def test_no_load_gives_no_displacement(fitted: Any, tiny: Dataset) -> None:
    forces = tiny.test.forces[:3].copy()
    forces[1] = 0.0
    for rows in (slice(None), slice(1, 2)):
        predicted = fitted.predict(forces[rows])
        assert not predicted[forces[rows].any(axis=(1, 2)) == 0].any()
    assert fitted.predict(forces)[[0, 2]].any(axis=(1, 2)).all()


def test_a_gaussian_process_fits_its_points(tiny: Dataset) -> None:
    """With the noise that it found, which is small: the mean passes near the outputs, and the length scales have been moved."""
    method: Any = mor_bench.load_method(
        "pca-gaussian-process", n_input_modes=6, n_output_modes=5
    ).fit(tiny.scene, tiny.train)
    z, outputs, _ = coordinates(method, tiny)
    np.testing.assert_allclose(method.coefficients(z), outputs, atol=0.03 * np.abs(outputs).max())
    assert np.ptp(method.lengths_) > 0.1


def forged(path: Path, changes: dict[str, NDArray[Any]]) -> None:
    with safe_open(str(path), framework="numpy") as file:
        header, arrays = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert set(changes) <= set(arrays)
    arrays |= changes
    header["sha256"] = file_digest(header, arrays)
    path.write_bytes(serialise(arrays, metadata=header))


def at(array: NDArray[Any], place: Any, value: float) -> NDArray[Any]:
    changed = array.copy()
    changed[place] = value
    return changed


FORGERIES = [
    (
        "pca-extra-trees",
        "children",
        "a child that is its own parent",
        lambda m: at(m.arrays_["children"], (0, 1), 0),
    ),
    (
        "pca-extra-trees",
        "children",
        "a child behind all nodes",
        lambda m: at(m.arrays_["children"], (0, 0), len(m.arrays_["features"])),
    ),
    (
        "pca-random-forest",
        "children",
        "a leaf without values",
        lambda m: at(m.arrays_["children"], (len(m.arrays_["features"]) - 1, 0), len(m.arrays_["values"])),
    ),
    (
        "pca-random-forest",
        "children",
        "a leaf before all values",
        lambda m: at(m.arrays_["children"], (len(m.arrays_["features"]) - 1, 0), -1),
    ),
    (
        "pca-random-forest",
        "features",
        "an input that is none",
        lambda m: at(m.arrays_["features"], 0, m.axes_.shape[1]),
    ),
    ("pca-random-forest", "features", "less than a leaf", lambda m: at(m.arrays_["features"], 0, -2)),
    ("pca-random-forest", "features", "floats", lambda m: m.arrays_["features"].astype(np.float64)),
    ("pca-random-forest", "features", "64 bits", lambda m: m.arrays_["features"].astype(np.int64)),
    ("pca-random-forest", "roots", "behind all nodes", lambda m: at(m.arrays_["roots"], 1, len(m.arrays_["features"]))),
    ("pca-random-forest", "roots", "before all nodes", lambda m: at(m.arrays_["roots"], 1, -1)),
    ("pca-random-forest", "thresholds", "NaN", lambda m: at(m.arrays_["thresholds"], 0, np.nan)),
    ("pca-random-forest", "values", "no outputs", lambda m: m.arrays_["values"][:, :0]),
    ("pca-kernel-ridge", "lengths", "zero", lambda m: 0 * m.lengths_),
    ("pca-kernel-ridge", "points", "too large to square", lambda m: 1e200 * (1 + m.points_)),
    ("pca-kernel-ridge", "weights", "too few", lambda m: m.weights_[:-1]),
    ("pca-ridge", "weights", "single precision", lambda m: m.weights_.astype(np.float32)),
]


@pytest.mark.parametrize(
    ("name", "array", "what", "forge"),
    FORGERIES,
    ids=[f"{name}: {array}, {what}" for name, array, what, _ in FORGERIES],
)
def test_arrays_that_would_mislead_a_kernel_are_refused(
    tiny: Dataset, tmp_path: Path, name: str, array: str, what: str, forge: Any
) -> None:
    method: Any = mor_bench.load_method(name, **FAMILIES[name]).fit(tiny.scene, tiny.train[:40])
    path = tmp_path / "model.safetensors"
    method.save(path)
    forged(path, {})
    mor_bench.load_surrogate(path)
    forged(path, {array: np.ascontiguousarray(forge(method))})
    with pytest.raises(StoreError, match=rf"model\.safetensors: .*`{array}`"):
        mor_bench.load_surrogate(path)


def test_more_arrays_than_a_model_has_are_refused(tiny: Dataset, tmp_path: Path) -> None:
    method = mor_bench.load_method("pca-ridge").fit(tiny.scene, tiny.train[:40])
    state = method.arrays_
    with pytest.raises(
        mor_bench.errors.InvalidInputError,
        match="axes, modes, weights; got axes, modes, other, weights",
    ):
        method.restore(tiny.scene, {**state, "other": np.zeros(3)})


def test_inputs_too_large_for_single_precision_find_a_leaf(tiny: Dataset) -> None:
    method = mor_bench.load_method("pca-extra-trees", **FAMILIES["pca-extra-trees"]).fit(
        tiny.scene, tiny.train
    )
    assert np.isfinite(method.predict(1e29 * tiny.test.forces[:2])).all()


@pytest.mark.parametrize("order", ["generated", "imported"])
@pytest.mark.parametrize("name", ["pca-kernel-ridge", "pca-gaussian-process"])
def test_the_samples_that_kernels_see_are_of_all_load_regions(
    tiny: Dataset, name: str, order: str
) -> None:
    """Imported snapshots may come region by region: the first hundred of these are of ten of them."""
    train = tiny.train
    if order == "imported":
        train = train[np.argsort(train.regions, kind="stable")]
        train = Snapshots(
            train.scene,
            NodalLoads(train.forces, train.loads.patches),
            train.free_displacements,
            train.min_det_f,
        )
    method: Any = mor_bench.load_method(name, input="force", **FAMILIES[name]).fit(
        tiny.scene, train
    )
    assert len(method.points_) == 101
    assert not method.points_[-1].any()
    z = project(method.from_forces_, train.forces.reshape(len(train), -1))
    seen = [int(np.abs(z - point).max(axis=1).argmin()) for point in method.points_[:-1]]
    assert len(set(seen)) == 100
    np.testing.assert_array_equal(np.unique(train.regions[seen]), np.unique(train.regions))
    assert (sorted(seen) == list(range(100))) == (order == "generated")


@pytest.mark.parametrize(
    ("name", "knobs", "message"),
    [
        ("pca-regression", {"ridge": np.inf}, "`ridge` must be a finite number; got inf"),
        ("pca-kernel-ridge", {"ridge": np.inf}, "`ridge` must be a finite number; got inf"),
        (
            "pca-kernel-ridge",
            {"length_scale": 1e-300},
            "`length_scale` must be greater than or equal to 0.01; got 1e-300",
        ),
        (
            "pca-kernel-ridge",
            {"length_scale": np.inf},
            "`length_scale` must be less than or equal to 1000; got inf",
        ),
    ],
)
def test_knobs_that_would_end_in_infinite_numbers_are_refused(
    name: str, knobs: dict[str, Any], message: str
) -> None:
    with pytest.raises(mor_bench.errors.SpecError, match=message):
        mor_bench.load_method(name, **knobs)


def test_more_monomials_than_fit_into_memory_are_refused(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = tiny.train[:40]
    monkeypatch.setattr(pca_regression, "MAX_FEATURE_BYTES", 8 * 65 * 40)
    mor_bench.load_method("pca-regression", n_input_modes=10, degree=2).fit(tiny.scene, train)
    with pytest.raises(
        mor_bench.errors.InvalidInputError,
        match=r"`degree` 2 of 11 input modes gives 77 monomials, .* lower it or `n_input_modes`",
    ):
        mor_bench.load_method("pca-regression", n_input_modes=11, degree=2).fit(tiny.scene, train)


def test_length_scales_too_short_to_divide_by_are_refused(tiny: Dataset) -> None:
    """With points as near to the origin they passed for a model, whose answers were NaN."""
    method: Any = mor_bench.load_method("pca-kernel-ridge", **FAMILIES["pca-kernel-ridge"]).fit(
        tiny.scene, tiny.train
    )
    state = method.arrays_
    with pytest.raises(
        mor_bench.errors.InvalidInputError, match="`lengths` must be at least 1e-06"
    ):
        method.restore(tiny.scene, 
            {
                **state,
                "points": 1e-300 + 0 * state["points"],
                "lengths": 1e-300 + 0 * state["lengths"],
            }
        )
