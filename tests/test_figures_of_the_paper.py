"""Errors on the paper's coarse beam with all its 6,400 samples."""

from __future__ import annotations

from pathlib import Path

import pytest

import mor_bench
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_method_spec
from mor_bench.training_options import TrainingOptions

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def beam(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-coarse", split="region", cache=cache)


@pytest.fixture(scope="module")
def random_split(cache: Path, beam: Dataset) -> Dataset:
    return mor_bench.load_dataset("beam-coarse", split="sample", cache=cache)


def mean_error(name: str, data: Dataset, **parameters: object) -> float:
    """Return the paper's ē, m."""
    return mean_error_of(mor_bench.load_method(name, **parameters), data)


def mean_error_of(method: mor_bench.Surrogate, data: Dataset) -> float:
    """Fit a method and return the paper's ē, m."""
    method.fit(data.scene, data.train)
    errors = sample_errors(method.predict(data.test.forces), data.test.displacements)
    return float(errors.mean_dof_m.mean())


def test_both_splits_use_all_samples(beam: Dataset, random_split: Dataset) -> None:
    for data, n_test in ((beam, 1300), (random_split, 1280)):
        assert (len(data.test), data.n_refused) == (n_test, 0)
        assert len(data.train) + len(data.validation) == 6400 - n_test


def test_linear_methods_have_the_expected_errors_on_both_splits(
    beam: Dataset, random_split: Dataset
) -> None:
    for data in (beam, random_split):
        assert 3e-4 <= mean_error("linear-fem", data) <= 9e-4
        assert mean_error("pca-regression-linear", data, n_input_modes=20) <= 3e-5


def test_pod_improves_with_its_rank_and_ecsw_is_within_a_fifth_of_pod(beam: Dataset) -> None:
    loosest = max(load_method_spec("hpod").sweep["cubature_tolerance"])
    plain = {r: mean_error("pod", beam, n_modes=r) for r in (3, 10, 40)}
    assert plain[40] < plain[10] < plain[3]
    for r in (3, 10):
        reduced = mean_error("hpod", beam, n_modes=r, cubature_tolerance=loosest)
        assert reduced <= 1.2 * plain[r]


def test_quick_umesh_has_an_error_of_at_most_a_millimetre_on_the_random_split(
    random_split: Dataset,
) -> None:
    """Its 4,500 iterations take about ten minutes on two cores."""
    torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    if not torch.cuda.is_available():
        pytest.skip("needs a graphics processor")
    network = mor_bench.load_method("umesh", **load_method_spec("umesh").parameters_of("quick"))
    network.training = TrainingOptions(device="cuda")
    assert mean_error_of(network, random_split) <= 1e-3
