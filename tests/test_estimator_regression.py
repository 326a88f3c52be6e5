"""Any regressor of scikit-learn is a method, by its import path, and no file runs code by it."""

from __future__ import annotations

import json
import sys
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesRegressor, GradientBoostingRegressor
from sklearn.neural_network import MLPRegressor

import mor_bench
from mor_bench.errors import InvalidInputError, MissingDependencyError, SpecError, StoreError
from mor_bench.mechanics.compliance import project
from mor_bench.method_loading import load_fitted, make_surrogate
from mor_bench.runs.file_check import check_file
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import check_parameters
from mor_bench.surrogates.estimator_regression import PCAEstimator
from tests.missing_packages import hide_package
from tests.model_files import rewrite
from tests.small_runs import method_file

Array = NDArray[np.float64]

TARGET = "mor_bench.surrogates.estimator_regression:PCAEstimator"
SMALL: dict[str, Any] = {"n_input_modes": 6, "n_output_modes": 4}

KINDS: dict[str, tuple[str, type[Any], dict[str, Any]]] = {
    "all outputs at once": (
        "sklearn.ensemble:ExtraTreesRegressor",
        ExtraTreesRegressor,
        {"n_estimators": 5, "min_samples_leaf": 2},
    ),
    "one output at a time": (
        "sklearn.ensemble:GradientBoostingRegressor",
        GradientBoostingRegressor,
        {"n_estimators": 5, "loss": "huber"},
    ),
    "a list as parameter": (
        "sklearn.neural_network:MLPRegressor",
        MLPRegressor,
        {"hidden_layer_sizes": [4, 3], "max_iter": 30},
    ),
}


def make(kind: str, **changed: Any) -> Any:
    estimator, _, parameters = KINDS[kind]
    known = {"estimator": estimator, "estimator_parameters": parameters, "seed": 3, **SMALL}
    return make_surrogate(PCAEstimator, known | changed)


@pytest.fixture(scope="module")
def trees(tiny: Dataset) -> Any:
    return make("all outputs at once").fit(tiny.scene, tiny.train[:50])


def flat(array: Array) -> Array:
    return array.reshape(len(array), -1)


@pytest.mark.filterwarnings("ignore:Stochastic Optimizer")
@pytest.mark.parametrize(
    ("source", "output"),
    [
        ("linear-response", None),
        ("force", None),
        ("linear-response", "displacement"),
        ("linear-response", "remainder"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_those_of_the_estimator_between_the_coordinates(
    kind: str, source: str, output: str | None, tiny: Dataset
) -> None:
    method = make(kind, input=source, output=output).fit(tiny.scene, tiny.train)
    z, queries = (
        project(method.from_forces_, flat(part.forces)) for part in (tiny.train, tiny.test)
    )
    # Rounded as in `fit`, because trees see each bit.
    rest, answers = tiny.train.free_displacements, np.zeros((1, tiny.scene.mesh.n_dofs))
    if source == "linear-response" and output != "displacement":
        rest = rest - method.response_.respond(flat(tiny.train.forces))[:, tiny.scene.free_dofs]
        linear = mor_bench.load_method("linear-fem").fit(tiny.scene)
        answers = flat(linear.predict(tiny.test.forces))
    values = rest @ method.modes_
    scale = np.sqrt((values**2).mean(axis=0).max())

    def raw(targets: Array) -> Array:
        _, made, parameters = KINDS[kind]
        fitted = made(random_state=3, **parameters).fit(z, targets / scale)
        at_rest = fitted.predict(np.zeros((1, z.shape[1])))
        return np.asarray(scale * (fitted.predict(queries) - at_rest))

    columns = [raw(y) for y in values.T] if kind == "one output at a time" else [raw(values)]
    expected = np.column_stack(columns)
    found = (flat(method.predict(tiny.test.forces)) - answers)[:, tiny.scene.free_dofs]
    found = found @ method.modes_
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(values).max())
    assert np.abs(expected).max() > 0.1 * np.abs(values).max()


def test_a_remainder_needs_the_linear_response() -> None:
    assert make("all outputs at once", input="force", output="displacement").output
    with pytest.raises(SpecError, match=r'`output`.* with `input = "force"` it must be "displacem'):
        make("all outputs at once", input="force", output="remainder")
    with pytest.raises(SpecError, match=r"`output`.*'remainder' or 'displacement'"):
        make("all outputs at once", output="stress")


def test_no_load_gives_no_displacement_and_a_huge_one_a_finite(trees: Any, tiny: Dataset) -> None:
    forces = tiny.test.forces[:3].copy()
    forces[1] = 0.0
    answers = trees.predict(forces)
    assert not answers[1].any()
    assert answers[[0, 2]].any(axis=(1, 2)).all()
    assert np.isfinite(trees.predict(1e29 * tiny.test.forces[:2])).all()
    assert np.isfinite(trees.coefficients(np.full((1, 6), 1e39))).all()  # beyond float32
    assert trees.predict(forces[:0]).shape == (0, *forces.shape[1:])


def test_a_constant_target_can_be_learned(tiny: Dataset) -> None:
    """With a single output, a regressor gets a vector."""
    parameters = {"strategy": "mean"}
    method = make(
        "all outputs at once",
        estimator="sklearn.dummy:DummyRegressor",
        estimator_parameters=parameters,
        n_output_modes=1,
    ).fit(tiny.scene, tiny.train)
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene)
    forces = tiny.test.forces[:2]
    np.testing.assert_array_equal(method.predict(forces), linear.predict(forces))


@pytest.mark.parametrize("kind", ["all outputs at once", "one output at a time"])
def test_a_saved_model_gives_the_same_bits_without_a_pickle(
    kind: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, path = make(kind).fit(tiny.scene, tiny.train), tmp_path / "model.safetensors"
    method.save(path)
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(f"pickle.{name}", None)
    loaded = load_fitted(path, PCAEstimator, tiny.scene)
    forces = tiny.test.forces
    np.testing.assert_array_equal(loaded.predict(forces), method.predict(forces))
    again = make(kind, seed=4).fit(tiny.scene, tiny.train)
    assert (again.predict(forces) != method.predict(forces)).any()


@pytest.mark.parametrize(
    ("array", "forge"),
    [
        ("values", lambda a: 2 * a),
        ("inputs", lambda a: a[::-1].copy()),
        ("answers", lambda a: a + 1e-3 * np.abs(a).max()),
        ("answers", lambda a: a[:-1]),
        ("values", lambda a: a[:-1]),
        ("inputs", lambda a: np.full_like(a, np.nan)),
        ("inputs", lambda a: a[:0]),
    ],
)
def test_a_model_whose_repeated_fit_is_another_one_is_refused(
    trees: Any, tiny: Dataset, tmp_path: Path, array: str, forge: Any
) -> None:
    path = tmp_path / "model.safetensors"
    trees.save(path)
    load_fitted(path, PCAEstimator, tiny.scene)
    rewrite(path, lambda arrays: arrays.update({array: forge(arrays[array])}))
    with pytest.raises(StoreError, match=r"model\.safetensors: .*`(answers|values|inputs)`"):
        load_fitted(path, PCAEstimator, tiny.scene)


@pytest.mark.filterwarnings("ignore:One or more samples have no neighbors")
def test_answers_that_are_no_numbers_are_refused_in_a_fit_and_a_file(
    tiny: Dataset, tmp_path: Path
) -> None:
    """Without any neighbour within its radius, this regressor answers NaN."""
    near = {"estimator": "sklearn.neighbors:RadiusNeighborsRegressor"}
    with pytest.raises(InvalidInputError, match="`answers` of a PCAEstimator holds NaN"):
        make("all outputs at once", **near, estimator_parameters={"radius": 1e-9}).fit(
            tiny.scene, tiny.train
        )
    wide = make("all outputs at once", **near, estimator_parameters={"radius": 100.0})
    path = tmp_path / "model.safetensors"
    wide.fit(tiny.scene, tiny.train).save(path)
    load_fitted(path, PCAEstimator, tiny.scene)
    parameters = {**wide.parameters, "estimator_parameters": {"radius": 1e-9}}
    rewrite(path, lambda arrays: None, parameters=json.dumps(parameters))
    with pytest.raises(StoreError, match="`answers` do not come out again"):
        load_fitted(path, PCAEstimator, tiny.scene)


def test_a_file_without_an_array_is_refused(trees: Any, tiny: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    trees.save(path)
    rewrite(path, lambda arrays: arrays.pop("inputs"))
    with pytest.raises(StoreError, match="inputs"):
        load_fitted(path, PCAEstimator, tiny.scene)


def test_a_file_can_ask_for_no_fit_by_itself(trees: Any, tmp_path: Path) -> None:
    """It could ask for one without end. The caller must name the class."""
    path = tmp_path / "model.safetensors"
    trees.save(path)
    with pytest.raises(StoreError, match="not used by any method of the suite"):
        mor_bench.load_surrogate(path)


@pytest.mark.parametrize("evil", ["evil_module:Evil", "sklearn.tests.evil:Evil", "sklearn:Evil"])
def test_a_file_cannot_import_a_module(
    trees: Any, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evil: str
) -> None:
    (tmp_path / "evil_module.py").write_text("raise SystemExit('ran')")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "model.safetensors"
    trees.save(path)
    parameters = {**trees.parameters, "estimator": evil}
    rewrite(path, lambda arrays: None, parameters=json.dumps(parameters))
    with pytest.raises(StoreError, match="`estimator`: it must name a regressor"):
        load_fitted(path, PCAEstimator, tiny.scene)
    assert "evil_module" not in sys.modules


FORM = "`estimator`: it must name a regressor as `sklearn.module:Class`"


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        ("os:system", FORM + "; got 'os:system'"),
        ("sklearn.svm.SVR", FORM + "; got"),
        ("sklearn.svm._classes:SVR", FORM + "; got"),
        ("sklearn.svm:SVC", FORM + "; 'SVC' is no regressor"),
        ("sklearn.svm:svR", FORM + "; got"),
        ("sklearn.svm:SVRR", FORM + "; sklearn.svm has no 'SVRR'; did you mean"),
        ("sklearn.swm:SVR", FORM + "; there is no module 'sklearn.swm'"),
        ("sklearn.base:RegressorMixin", FORM + "; 'RegressorMixin' is no estimator"),
        ("sklearn.externals.joblib:Memory", FORM + "; got"),
        (3, "`estimator` must be a valid string; got 3"),
    ],
)
def test_anything_but_a_regressor_of_scikit_learn_is_refused(estimator: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message) as error:
        check_parameters(PCAEstimator, {"estimator": estimator})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("estimator", "parameters", "message"),
    [
        ("svm:SVR", {"kernal": 1}, "SVR has no parameter 'kernal'; did you mean 'kernel'"),
        ("ensemble:ExtraTreesRegressor", {"random_state": 1}, "`seed` sets `random_state`"),
        ("ensemble:ExtraTreesRegressor", {"n_jobs": 2}, "`n_jobs` cannot be set"),
        ("svm:SVR", {"C": float("inf")}, "'C' must be a finite number, text, true, false or a"),
        ("svm:SVR", {"kernel": {"a": 1}}, "'kernel' must be a finite number"),
        ("svm:SVR", {"kernel": date(2020, 1, 1)}, "'kernel' must be a finite number"),
        ("svm:SVR", {"kernel": [print]}, "'kernel' must be a finite number"),
        ("ensemble:VotingRegressor", {}, "VotingRegressor also needs 'estimators'"),
    ],
)
def test_parameters_that_the_estimator_cannot_have_are_refused(
    estimator: str, parameters: dict[str, Any], message: str
) -> None:
    known = {"estimator": f"sklearn.{estimator}", "estimator_parameters": parameters}
    with pytest.raises(SpecError, match=f"`estimator_parameters`: .*{message}"):
        check_parameters(PCAEstimator, known)


def test_an_estimator_that_cannot_be_fitted_is_named(tiny: Dataset) -> None:
    method = make("all outputs at once", estimator_parameters={"n_estimators": -1})
    with pytest.raises(InvalidInputError, match=r"ExtraTreesRegressor cannot be fitted: .*n_estim"):
        method.fit(tiny.scene, tiny.train)


def test_without_scikit_learn_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    hide_package("sklearn", monkeypatch)
    with pytest.raises(MissingDependencyError, match="needs scikit-learn: pip install"):
        check_parameters(PCAEstimator, {"estimator": "sklearn.svm:SVR"})


def test_a_method_file_is_checked_with_its_estimator(tmp_path: Path) -> None:
    knobs = {"estimator": "sklearn.neighbors:KNeighborsRegressor"}
    good = method_file(tmp_path, "near", TARGET, {"input": ["linear-response", "force"]}, **knobs)
    assert check_file(good) == "method, 2 quick and 2 full configurations"
    bad = method_file(tmp_path, "nearer", TARGET, estimator="sklearn.neighbors:KDTree")
    with pytest.raises(SpecError, match=r"method nearer .*'KDTree' is no regressor"):
        check_file(bad)
