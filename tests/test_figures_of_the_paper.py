"""What must come out on the paper's coarse beam with all its 6,400 samples."""

from __future__ import annotations

from pathlib import Path

import pytest

import mor_bench
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import SplitBy, load_method_spec


@pytest.fixture(scope="module", params=["region", "sample"])
def beam(request: pytest.FixtureRequest, cache: Path) -> Dataset:
    split: SplitBy = request.param
    return mor_bench.load_dataset("beam-coarse", split=split, cache=cache)


def mean_error(name: str, data: Dataset, **parameters: object) -> float:
    """The paper's ē, m."""
    method = mor_bench.load_method(name, **parameters).fit(data.scene, data.train)
    return float(
        sample_errors(method.predict(data.test.forces), data.test.displacements).mean_dof_m.mean()
    )


def test_sizes_of_the_split(beam: Dataset) -> None:
    assert len(beam.train) + len(beam.test) == 6400
    assert len(beam.test) in (1280, 1300)
    assert beam.n_refused == 0


def test_linear_fem(beam: Dataset) -> None:
    """A first try with single-node loads gave 6.8e-4 m."""
    assert 3e-4 <= mean_error("linear-fem", beam) <= 9e-4


def test_pca_regression_on_the_linear_response(beam: Dataset) -> None:
    assert mean_error("pca-regression", beam, n_input_modes=20) <= 3e-5


def test_pod_improves_with_its_rank_and_ecsw_stays_within_a_fifth(beam: Dataset) -> None:
    tolerances = load_method_spec("hpod").sweep["cubature_tolerance"]
    plain = {}
    for r in (3, 10, 40):
        plain[r] = mean_error("pod", beam, n_modes=r)
        for tolerance in tolerances:
            assert (
                mean_error("hpod", beam, n_modes=r, cubature_tolerance=tolerance) <= 1.2 * plain[r]
            )
    assert plain[40] < plain[10] < plain[3]


def test_quick_umesh_on_the_random_split(cache: Path) -> None:
    pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")
    data = mor_bench.load_dataset("beam-coarse", split="sample", cache=cache)
    assert mean_error("umesh", data, **load_method_spec("umesh").parameters_of("quick")) <= 1e-3
