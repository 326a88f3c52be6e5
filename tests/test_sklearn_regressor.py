"""A method is an estimator of scikit-learn: its tools take it, and it keeps their rules."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer
from sklearn.utils.estimator_checks import check_estimator

import mor_bench
from mor_bench.adapters import SurrogateRegressor
from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.snapshots.dataset import Dataset
from tests.observed_scenes import scene_of
from tests.small_runs import method_file

Array = NDArray[np.float64]

COLUMNS = "it fits samples with a number of columns of its own, and the scene fixes ours"
EXPECTED = {
    "check_no_attributes_set_in_init": "hyperparameters of the method come as keywords",
    **dict.fromkeys(
        [
            "check_dict_unchanged",
            "check_dont_overwrite_parameters",
            "check_dtype_object",
            "check_estimators_dtypes",
            "check_estimators_fit_returns_self",
            "check_estimators_nan_inf",
            "check_estimators_overwrite_params",
            "check_estimators_pickle",
            "check_f_contiguous_array_estimator",
            "check_fit2d_1feature",
            "check_fit2d_1sample",
            "check_fit2d_predict1d",
            "check_fit_check_is_fitted",
            "check_fit_idempotent",
            "check_fit_score_takes_y",
            "check_methods_sample_order_invariance",
            "check_methods_subset_invariance",
            "check_n_features_in",
            "check_n_features_in_after_fitting",
            "check_pipeline_consistency",
            "check_positive_only_tag_during_fit",
            "check_readonly_memmap_input",
            "check_regressor_data_not_an_array",
            "check_regressor_multioutput",
            "check_regressors_int",
            "check_regressors_no_decision_function",
            "check_regressors_train",
        ],
        COLUMNS,
    ),
}
"""Checks of scikit-learn that cannot pass, and why. Tests below repeat the important ones."""


STATUSES = ("passed", "xfail", "failed", "skipped")


def flat(array: Array) -> Array:
    return array.reshape(len(array), -1)


@pytest.fixture(scope="module")
def X(tiny: Dataset) -> Array:
    return flat(tiny.train.forces)


@pytest.fixture(scope="module")
def y(tiny: Dataset) -> Array:
    return flat(tiny.train.displacements)


@pytest.fixture
def pod() -> Any:
    return SurrogateRegressor("pod", "beam-tiny", n_modes=5)


@pytest.mark.filterwarnings("ignore")
def test_scikit_learn_finds_no_fault_where_its_checks_apply(pod: Any) -> None:
    results = check_estimator(pod, expected_failed_checks=EXPECTED, on_skip=None)
    found = {kind: {r["check_name"] for r in results if r["status"] == kind} for kind in STATUSES}
    assert found["failed"] == set()
    assert found["xfail"] == set(EXPECTED)
    assert found["skipped"] <= {"check_array_api_input"}
    assert len(found["passed"]) >= 20


def test_it_predicts_what_the_method_predicts(pod: Any, tiny: Dataset, X: Array, y: Array) -> None:
    method = mor_bench.load_method("pod", n_modes=5).fit(tiny.scene, tiny.train)
    expected = method.predict(tiny.test.forces)
    assert pod.fit(X, y) is pod
    found = pod.predict(flat(tiny.test.forces))
    assert found.shape == (len(tiny.test), 3 * tiny.scene.mesh.n_nodes)
    np.testing.assert_allclose(found, flat(expected), atol=1e-7 * np.abs(expected).max())


def test_parameters_are_read_set_and_cloned(pod: Any, tiny: Dataset) -> None:
    pod.scene = tiny.scene
    copied = clone(pod)
    assert copied is not pod
    assert copied.get_params() == {"method": "pod", "scene": copied.scene, "n_modes": 5}
    assert copied.set_params(n_modes=7).n_modes == 7
    assert pod.n_modes == 5
    copied.set_params(method="hpod", sampling="points")
    assert copied.get_params()["sampling"] == "points"
    with pytest.raises(SpecError, match="hpod has no parameter 'n_mode'; did you mean 'n_modes'"):
        copied.set_params(n_mode=3)
    assert "n_mode" not in copied.get_params()


def test_a_second_fit_forgets_the_first(pod: Any, X: Array, y: Array) -> None:
    once = pod.fit(X, y).predict(X[:5])
    pod.fit(X[:20], 2 * y[:20])
    np.testing.assert_array_equal(pod.fit(X, y).predict(X[:5]), once)


def test_answers_depend_neither_on_the_batch_nor_on_its_layout(
    pod: Any, X: Array, y: Array
) -> None:
    whole = pod.fit(X, y).predict(X[:6])
    atol = 2e-6 * np.abs(whole).max()
    np.testing.assert_allclose(pod.predict(X[5:2:-1]), whole[5:2:-1], rtol=0, atol=atol)
    np.testing.assert_array_equal(pod.predict(np.asfortranarray(X[:6])), whole)
    np.testing.assert_array_equal(pod.predict(X[:6].tolist()), whole)
    locked = X.copy(), y.copy()
    for array in locked:
        array.setflags(write=False)
    np.testing.assert_array_equal(pod.fit(*locked).predict(locked[0][:6]), whole)
    for array, original in zip(locked, (X, y), strict=True):
        np.testing.assert_array_equal(array, original)


def test_a_fitted_estimator_is_copied_with_its_fit(pod: Any, X: Array, y: Array) -> None:
    copied = pickle.loads(pickle.dumps(pod.fit(X, y)))
    np.testing.assert_array_equal(copied.predict(X[:3]), pod.predict(X[:3]))


def test_scores_are_r2_without_the_supports(pod: Any, tiny: Dataset, X: Array, y: Array) -> None:
    """At supports both are zero; the plain mean over columns would add a perfect 1 for each."""
    n_fixed = 3 * len(tiny.scene.fixed_nodes)
    rest = pod.fit(X, y).predict(X) - y
    expected = 1 - (rest**2).sum() / ((y - y.mean(axis=0)) ** 2).sum()
    assert n_fixed > 0
    assert pod.score(X, y) == pytest.approx(expected, abs=1e-12)
    assert 0.9 < expected < 1.0


def test_cross_validation_over_load_regions(tiny: Dataset, X: Array, y: Array) -> None:
    ridge = SurrogateRegressor("pca-ridge", tiny.scene, n_output_modes=10)
    folds = GroupKFold(3)
    scores = cross_val_score(ridge, X, y, groups=tiny.train.regions, cv=folds, error_score="raise")
    assert scores.shape == (3,)
    assert (scores > 0.9).all()


def test_a_grid_over_hyperparameters_and_methods_finds_the_best(
    tiny: Dataset, X: Array, y: Array
) -> None:
    grid = [
        {"method": ["pod"], "n_modes": [1, 8]},
        {"method": ["pca-ridge"], "input": ["force"], "n_output_modes": [1]},
    ]
    model = SurrogateRegressor(scene=tiny.scene)
    search = GridSearchCV(model, grid, cv=2, error_score="raise").fit(X[:60], y[:60])
    assert search.best_params_ == {"method": "pod", "n_modes": 8}
    assert search.score(flat(tiny.test.forces), flat(tiny.test.displacements)) > 0.98


def test_it_ends_a_pipeline(pod: Any, X: Array, y: Array) -> None:
    """Twice the force in both is the same as a method that was fitted to twice the force."""
    doubled = make_pipeline(FunctionTransformer(lambda X: 2 * X), clone(pod))
    doubled.set_params(surrogateregressor__n_modes=6)
    expected = pod.set_params(n_modes=6).fit(2 * X, y).predict(2 * X[:3])
    np.testing.assert_array_equal(doubled.fit(X, y).predict(X[:3]), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda X, y: (X[:, :-1], y), r"`X` must have one column .* 189; got .* \(140, 188\)"),
        (lambda X, y: (X, y[:, :-3]), r"`y` must have one column .* 189; got .* \(140, 186\)"),
        (lambda X, y: (X, y[:, 0]), r"`y` must have one column .* got .* \(140,\)"),
        (lambda X, y: (X, y + 1e-6), "`y` must be zero where supports hold beam-tiny; got up to"),
        (lambda X, y: (np.where(X.max() == X, np.nan, X), y), "contains NaN"),
        (lambda X, y: (X, np.where(y == y.max(), np.inf, y)), "contains infinity"),
        (lambda X, y: (X[:10], y), "inconsistent numbers of samples"),
    ],
)
def test_samples_of_another_form_are_refused(
    pod: Any, X: Array, y: Array, change: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        pod.fit(*change(X, y))
    assert not hasattr(pod, "method_")


def test_queries_of_another_form_are_refused(pod: Any, X: Array, y: Array) -> None:
    with pytest.raises(NotFittedError):
        pod.predict(X)
    pod.fit(X, y)
    with pytest.raises(ValueError, match=r"X has 188 features, but .* is expecting 189"):
        pod.predict(X[:, 1:])


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"scene": None}, InvalidInputError, "`scene` must be given"),
        ({"scene": "beam-tin"}, SpecError, "beam-tiny"),
        ({"method": 3}, InvalidInputError, "`method` must be a name .*; got 3"),
        ({"method": "podd"}, SpecError, "pod"),
        ({"n_modes": 0}, SpecError, "`n_modes` must be"),
        ({"scene": "beam-stiffness"}, UnsupportedSceneError, "no columns for sampled parameters"),
        ({"scene": scene_of({"region": "z-max"})}, UnsupportedSceneError, "X holds forces"),
    ],
)
def test_wrong_parameters_are_named_when_it_is_fitted(
    changes: dict[str, Any], kind: type[Exception], message: str, X: Array, y: Array
) -> None:
    known = {"method": "pod", "scene": "beam-tiny", **changes}
    with pytest.raises(kind, match=message):
        SurrogateRegressor(**known).fit(X, y)


def test_a_method_without_samples_and_a_method_from_a_file(
    tmp_path: Any, tiny: Dataset, X: Array, y: Array
) -> None:
    linear = SurrogateRegressor("linear-fem", tiny.scene).fit(X, y).predict(X[:2])
    method = mor_bench.load_method("linear-fem").fit(tiny.scene)
    np.testing.assert_array_equal(linear, flat(method.predict(tiny.train.forces[:2])))
    file = method_file(tmp_path, "own", "mor_bench.surrogates.pod:PODGalerkin", n_modes=2)
    assert SurrogateRegressor(file, tiny.scene).fit(X, y).method_.parameters["n_modes"] == 2
