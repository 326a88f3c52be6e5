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
from sklearn.utils import estimator_html_repr
from sklearn.utils.estimator_checks import check_estimator
from sklearn.utils.validation import check_is_fitted

import mor_bench
from mor_bench.adapters import SurrogateRegressor
from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.snapshots.dataset import Dataset
from tests.observed_scenes import scene_of
from tests.small_runs import method_file

Array = NDArray[np.float64]

INIT = "hyperparameters of the method come as keywords, and become attributes of their own"
ONE = "its message about columns comes before one about a single sample or feature"
COLUMNS = "the check fits samples with columns of its own, and the scene fixes ours; "
HERE = "repeated here in test_"

EXPECTED = {
    "check_no_attributes_set_in_init": INIT,
    "check_fit2d_1sample": ONE,
    "check_fit2d_1feature": ONE,
    **{
        check: COLUMNS + where
        for check, where in {
            "check_dict_unchanged": f"{HERE}parameters_and_dict_stay_as_they_were",
            "check_dont_overwrite_parameters": f"{HERE}parameters_and_dict_stay_as_they_were",
            "check_dtype_object": f"{HERE}samples_of_other_types_are_converted",
            "check_estimators_dtypes": f"{HERE}samples_of_other_types_are_converted",
            "check_estimators_fit_returns_self": f"{HERE}it_predicts_what_the_method_predicts",
            "check_estimators_nan_inf": f"{HERE}samples_of_another_form_are_refused",
            "check_estimators_overwrite_params": f"{HERE}parameters_and_dict_stay_as_they_were",
            "check_estimators_pickle": f"{HERE}a_fitted_estimator_is_copied_with_its_fit",
            "check_f_contiguous_array_estimator": f"{HERE}answers_depend_neither_on_the_batch_...",
            "check_fit2d_predict1d": f"{HERE}queries_of_another_form_are_refused",
            "check_fit_check_is_fitted": f"{HERE}parameters_and_dict_stay_as_they_were",
            "check_fit_idempotent": f"{HERE}a_second_fit_forgets_the_first",
            "check_fit_score_takes_y": "a grid search fits and scores here",
            "check_methods_sample_order_invariance": f"{HERE}answers_depend_neither_on_the_...",
            "check_methods_subset_invariance": f"{HERE}answers_depend_neither_on_the_batch_...",
            "check_n_features_in": f"{HERE}queries_of_another_form_are_refused",
            "check_n_features_in_after_fitting": f"{HERE}queries_of_another_form_are_refused",
            "check_pipeline_consistency": f"{HERE}it_ends_a_pipeline",
            "check_positive_only_tag_during_fit": "all samples here have negative forces",
            "check_readonly_memmap_input": f"{HERE}answers_depend_neither_on_the_batch_...",
            "check_regressor_data_not_an_array": f"{HERE}samples_of_other_types_are_converted",
            "check_regressor_multioutput": f"{HERE}it_predicts_what_the_method_predicts",
            "check_regressors_int": f"{HERE}samples_of_other_types_are_converted",
            "check_regressors_no_decision_function": f"{HERE}it_predicts_what_the_method_predicts",
            "check_regressors_train": f"{HERE}samples_of_another_form_are_refused",
        }.items()
    },
}
"""Checks of scikit-learn that cannot pass, and why."""


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
    for result in results:
        if EXPECTED.get(result["check_name"], INIT) is not INIT:
            chain = result["exception"], result["exception"].__cause__
            assert any("`X` must have one column for each degree" in str(e) for e in chain), result
    assert found["skipped"] <= {"check_array_api_input"}
    assert len(found["passed"]) >= 20


def test_it_predicts_what_the_method_predicts(pod: Any, tiny: Dataset, X: Array, y: Array) -> None:
    method = mor_bench.load_method("pod", n_modes=5).fit(tiny.scene, tiny.train)
    assert not hasattr(pod, "decision_function")
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


def test_parameters_and_dict_stay_as_they_were(pod: Any, X: Array, y: Array) -> None:
    with pytest.raises(NotFittedError):
        check_is_fitted(pod)
    before = dict(vars(pod))
    check_is_fitted(pod.fit(X, y))
    assert pod.get_params() == before
    assert vars(pod).keys() - before.keys() == {"method_", "scene_", "n_features_in_"}
    fitted = dict(vars(pod))
    pod.predict(X[:3])
    assert vars(pod) == fitted


def test_samples_of_other_types_are_converted(pod: Any, X: Array, y: Array) -> None:
    expected = pod.fit(X, y).predict(X[:3])
    convert: Any
    for convert in (lambda a: a.astype(object), lambda a: a.tolist()):
        np.testing.assert_array_equal(pod.fit(convert(X), convert(y)).predict(X[:3]), expected)
    found = pod.fit(X.astype(np.float32), y.astype(np.float32)).predict(X[:3].astype(np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    whole = np.round(1e3 * X).astype(np.int64)
    np.testing.assert_array_equal(
        pod.fit(whole, y).predict(whole[:3]), pod.fit(whole / 1, y).predict(whole[:3] / 1)
    )


def test_a_model_with_a_scene_has_a_short_repr(pod: Any, tiny: Dataset) -> None:
    pod.scene = tiny.scene
    found = "scene=<Scene beam-tiny: 63 nodes, 24 cells>"
    assert " ".join(repr(pod).split()) == f"SurrogateRegressor(n_modes=5, {found})"
    assert "array(" not in estimator_html_repr(pod)


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
    weights = np.zeros(len(X))
    weights[:9] = 1.0
    weighted = pod.score(X, y, sample_weight=weights)
    assert weighted == pytest.approx(pod.score(X[:9], y[:9]), abs=1e-12)
    assert weighted != pytest.approx(expected, abs=1e-6)


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
