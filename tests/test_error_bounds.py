"""Calibrated bounds of the error: quantiles by hand, simulated coverage, a real method."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.measure.error_bounds import ErrorBound, calibrated, covered
from mor_bench.snapshots.dataset import Dataset


def test_without_groups_the_bound_is_the_usual_conformal_quantile() -> None:
    # ceil((19 + 1) 0.9) = 18: the 18th smallest of 19 errors.
    errors = np.random.default_rng(0).permutation(np.arange(1.0, 20.0))
    bound = calibrated(errors, None, 0.9)
    assert (bound.relative_l2, bound.n_samples, bound.n_groups) == (18.0, 19, 19)


def test_each_group_has_the_same_weight_however_many_samples_it_has() -> None:
    # Weights: 1/4 for each of three groups and for the new one. Half is reached by both groups of
    # small errors; 0.7 needs most of the third group.
    errors = np.array([1.0, 2.0, 10.0, 11.0, 12.0, 13.0])
    regions = np.array([7, 3, 5, 5, 5, 5])
    assert calibrated(errors, regions, 0.5).relative_l2 == 2.0
    assert calibrated(errors, regions, 0.70).relative_l2 == 13.0
    assert calibrated(errors, regions, 0.60).relative_l2 == 11.0
    assert calibrated(errors, regions, 0.5).n_groups == 3


def test_too_few_groups_give_an_infinite_bound_and_no_coverage() -> None:
    regions = np.repeat(np.arange(8), 50)
    bound = calibrated(np.ones(400), regions, 0.9)
    assert bound.relative_l2 == inf
    assert covered(bound, {"test": {"relative_l2": np.ones(3)}}) == {}
    assert bound.of_prediction(np.ones((2, 4, 3))).tolist() == [inf, inf]


def test_samples_with_several_forces_count_one_by_one() -> None:
    regions = np.zeros((19, 3), dtype=np.int64)
    assert calibrated(np.arange(1.0, 20.0), regions, 0.9).n_groups == 19


def test_bounds_hold_for_new_groups_as_often_as_promised() -> None:
    # Errors depend on the group. Treating samples as independent would cover new groups less.
    generator = np.random.default_rng(1)
    n_groups, n, trials = 12, 30, 3000
    regions = np.repeat(np.arange(n_groups), n)
    hits = naive = 0
    for _ in range(trials):
        levels = generator.lognormal(sigma=1.0, size=n_groups + 1)
        errors = levels[:-1, None] * generator.uniform(size=(n_groups, n))
        new = levels[-1] * generator.uniform()
        hits += new <= calibrated(errors.ravel(), regions, 0.9).relative_l2
        naive += new <= calibrated(errors.ravel(), None, 0.9).relative_l2
    assert hits / trials >= 0.9
    assert naive / trials < 0.89


def test_absolute_bounds_follow_from_the_norm_of_the_prediction() -> None:
    bound = ErrorBound(0.9, 0.2, 10, 10)
    generator = np.random.default_rng(2)
    reference = generator.normal(size=(50, 6, 3))
    direction = generator.normal(size=reference.shape)
    norm = np.linalg.norm(reference, axis=(1, 2))
    error = direction * (0.2 * norm / np.linalg.norm(direction, axis=(1, 2)))[:, None, None]
    limits = bound.of_prediction(reference + error)
    assert (np.linalg.norm(error, axis=(1, 2)) <= limits * (1 + 1e-12)).all()
    assert bound.of_prediction(reference[0]).shape == ()
    # The worst case is attained: an error along the reference that makes it shorter.
    shorter = reference[0] * 0.8
    assert bound.of_prediction(shorter) == pytest.approx(0.2 * norm[0])


def test_a_fitted_method_is_calibrated_on_samples_that_it_has_not_seen(tiny: Dataset) -> None:
    method = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    bound = mor_bench.error_bound(method, tiny.validation, level=0.5)
    errors = np.linalg.norm(
        method.predict(tiny.validation.forces) - tiny.validation.displacements, axis=(1, 2)
    ) / np.linalg.norm(tiny.validation.displacements, axis=(1, 2))
    regions = tiny.validation.regions
    assert bound == calibrated(errors, regions, 0.5)
    assert errors.min() < bound.relative_l2 <= errors.max()


def test_scaled_bounds_hold_for_new_groups_and_follow_the_spread() -> None:
    """Errors proportional to the spread: the bound is as narrow as their proportion allows."""
    generator = np.random.default_rng(5)
    regions = np.repeat(np.arange(40), 10)
    hits, widths, constant, trials = 0.0, 0.0, 0.0, 300
    for _ in range(trials):
        spreads = generator.lognormal(sigma=1.5, size=(41, 1)) * np.ones(10)
        errors = spreads * generator.uniform(0.5, 1.0, size=spreads.shape)
        bound = calibrated(errors[:40].ravel(), regions, 0.9, spreads[:40].ravel())
        assert bound.per_spread is not None
        hits += float((errors[40] <= bound.per_spread * spreads[40]).mean())
        widths += float(np.mean(bound.per_spread * spreads[40]))
        constant += bound.relative_l2
    assert 0.9 <= hits / trials <= 0.99
    assert widths < 0.6 * constant


def test_spreads_of_zero_bound_only_errors_of_zero() -> None:
    zeros = np.zeros(20)
    assert calibrated(zeros, None, 0.9, zeros).per_spread == 0.0
    assert calibrated(np.ones(20), None, 0.9, zeros).per_spread == np.inf
    assert calibrated(np.ones(20), None, 0.9).per_spread is None


def test_loads_without_an_answer_have_infinite_errors_and_bounds() -> None:
    errors, spreads = np.full(20, 0.1), np.full(20, 0.05)
    errors[0], spreads[0] = np.nan, np.inf
    with np.errstate(all="raise"):
        bound = calibrated(errors, None, 0.9, spreads)
        assert bound.relative_l2 == 0.1
        assert bound.per_spread == pytest.approx(2.0)
        scores = {
            "test": {"relative_l2": np.array([np.inf, 0.3]), "spread": np.array([np.inf, 0.1])}
        }
        assert covered(bound, scores, scaled=True) == {"test": 0.5}
        none = replace(bound, per_spread=0.0)
        lost = np.full((2, 4, 3), np.nan)
        for found in (
            bound.of_prediction(lost),
            none.of_prediction(np.ones((2, 4, 3)), [np.inf, np.inf]),
        ):
            np.testing.assert_array_equal(found, np.inf)
    assert calibrated(np.full(20, np.nan), None).relative_l2 == np.inf


def test_an_ensemble_gives_each_load_its_own_bound(tiny: Dataset) -> None:
    pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    method: Any = mor_bench.load_method("pod-nn-ensemble", iterations=200, n_hidden=16)
    method.fit(tiny.scene, tiny.train)
    bound = mor_bench.error_bound(method, tiny.validation, level=0.5)
    forces = tiny.test.forces
    predicted, spread = method.predict(forces), method.spread(forces)
    assert spread.shape == (len(forces),)
    assert method.spread(forces[0]) == pytest.approx(spread[0])
    assert method.spread(0.0 * forces[0]) == 0.0
    assert bound.per_spread is not None
    share = bound.per_spread * spread
    expected = share / (1 - share) * np.linalg.norm(predicted, axis=(1, 2))
    assert (share < 1).all()
    np.testing.assert_allclose(bound.of_prediction(predicted, spread), expected)
    assert len(set(expected)) == len(forces)
    scores = {
        "test": {
            "relative_l2": np.linalg.norm(predicted - tiny.test.displacements, axis=(1, 2))
            / np.linalg.norm(tiny.test.displacements, axis=(1, 2)),
            "spread": spread,
        }
    }
    within = (scores["test"]["relative_l2"] <= share).mean()
    assert covered(bound, scores, scaled=True) == {"test": within}
    for wrong in (-spread, spread[:3], np.nan * spread):
        with pytest.raises(InvalidInputError, match="`spread` must hold numbers >= 0 of shape"):
            bound.of_prediction(predicted, wrong)
    unknown = replace(bound, per_spread=np.inf).of_prediction(predicted, 0.0 * spread)
    assert np.isinf(unknown).all()
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    constant = mor_bench.error_bound(linear, tiny.validation, level=0.5)
    with pytest.raises(InvalidInputError, match="`spread` must be left out"):
        constant.of_prediction(predicted, spread)


def test_samples_are_groups_where_the_split_is_by_sample(tiny: Dataset) -> None:
    """Loads on the same regions in all samples would otherwise be a single group."""
    split = tiny.scene.spec.split.model_copy(update={"by": "sample"})
    scene = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"split": split}))
    method = mor_bench.load_method("linear-fem").fit(scene, None)
    bound = mor_bench.error_bound(method, replace(tiny.validation, scene=scene))
    assert bound.n_groups == len(tiny.validation)
    assert bound.relative_l2 < 1.0


def test_only_wanted_nodes_count(tiny: Dataset) -> None:
    """The bound of a method that leaves out the other nodes is that of one that does not."""
    needs = tiny.scene.spec.needs.model_copy(update={"outputs": "x-max"})
    scene = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"needs": needs}))
    method = mor_bench.load_method("pod", n_modes=10).fit(scene, tiny.train)
    found = method.predict(tiny.test.forces[:3])
    assert np.isnan(found).any()
    bound = mor_bench.error_bound(method, replace(tiny.validation, scene=scene), level=0.5)
    whole = mor_bench.load_method("pod", n_modes=10).fit(tiny.scene, tiny.train)
    wanted = whole.predict(tiny.test.forces[:3])[:, scene.output_nodes]
    share = bound.relative_l2 / (1.0 - bound.relative_l2)
    expected = share * np.linalg.norm(wanted, axis=(1, 2))
    np.testing.assert_allclose(bound.of_prediction(found), expected, rtol=1e-9)
    np.testing.assert_allclose(bound.of_prediction(found[0]), expected[0], rtol=1e-9)


def test_a_level_out_of_range_and_no_samples_are_refused(tiny: Dataset) -> None:
    method = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    with pytest.raises(InvalidInputError, match=r"`level` of `error_bound` must be in \(0, 1\)"):
        mor_bench.error_bound(method, tiny.validation, level=90)
    text: Any = "0.9"
    with pytest.raises(InvalidInputError, match=r"must be in .*; got '0.9'"):
        mor_bench.error_bound(method, tiny.validation, level=text)
    with pytest.raises(InvalidInputError, match="at least one sample; got 0"):
        mor_bench.error_bound(method, tiny.validation[:0])
