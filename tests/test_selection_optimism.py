"""The measurement of a selection's optimism, on errors with a known answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.synthetic import synthetic_comparison
from tests.verification.selection_optimism import WAYS, Sweep, halves, measure, optimism

N_REGIONS, PER_REGION = 12, 10
REGIONS = np.repeat(np.arange(N_REGIONS), PER_REGION)[:, None]


def test_halves_divide_regions_and_not_samples() -> None:
    first = halves(REGIONS, len(REGIONS), 50)
    assert (first[50:] == ~first[:50]).all()
    by_region = first.reshape(100, N_REGIONS, PER_REGION)
    assert (by_region == by_region[..., :1]).all()
    assert (by_region[..., 0].sum(axis=1) == N_REGIONS // 2).all()
    assert len(np.unique(first, axis=0)) > 40


def test_errors_without_scatter_show_no_optimism() -> None:
    errors = np.tile([[0.02], [0.009], [0.002]], len(REGIONS))
    sweep = Sweep("m", errors, {"validation": errors[:, 0], "bound": 1.2 * errors[:, 0]})
    found = optimism(sweep, halves(REGIONS, len(REGIONS), 20), (0.01, 0.001))
    for way in WAYS:
        assert (found[way]["n"], found[way]["missed"]) == (40, 0.0)
        assert found[way]["ratio"] == pytest.approx(1.0)


def test_equal_configurations_are_optimistic_only_when_the_test_set_selects() -> None:
    generator = np.random.default_rng(1)
    effects = np.exp(0.6 * generator.normal(size=(40, N_REGIONS)))
    errors = 0.01 * np.repeat(effects, PER_REGION, axis=1)  # 40 configurations, one true error
    validation = 0.01 * np.exp(0.3 * generator.normal(size=40))
    sweep = Sweep("m", errors, {"validation": validation, "bound": 2 * validation})
    first = halves(REGIONS, len(REGIONS), 300)
    found = optimism(sweep, first, (0.006,))
    assert found["test"]["missed"] > 0.6
    assert found["test"]["ratio"] > 1.4
    assert found["validation"]["ratio"] == pytest.approx(1.0)
    assert found["bound"]["n"] <= found["validation"]["n"] == 600


def test_a_comparison_without_validation_errors_is_measured_on_its_test_set(tmp_path: Path) -> None:
    records = measure(synthetic_comparison(tmp_path, per_region=8), 30)
    assert [record["method"] for record in records] == [
        "fem",
        "pod",
        "hpod",
        "pca-regression-linear",
    ]
    assert all("validation" not in record and record["test"]["n"] > 0 for record in records)
