"""Ten thousand predictions; `python -m tests.verification.load` makes a million per method."""

from __future__ import annotations

from mmap import mmap
from typing import Any

import pytest

from mor_bench.errors import MissingDependencyError
from mor_bench.runs.configurations import CORE_METHODS
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.linear_fem import LinearFEM
from tests.case_marks import nightly_but
from tests.verification.load import loaded, predict_often


@pytest.mark.slow
@pytest.mark.parametrize("name", nightly_but(3, CORE_METHODS))
def test_memory_stays_flat_and_answers_stay_the_same(name: str, tiny: Dataset) -> None:
    try:
        method = loaded(name, tiny)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    found = predict_often(method, tiny, 10_000 if name != "fem" else 2_000)
    assert found.ok, found


@pytest.mark.slow
@pytest.mark.parametrize("how", ["leaks", "drifts"])
def test_a_leak_and_a_drift_are_found(how: str, tiny: Dataset) -> None:
    class Spoiled(LinearFEM):
        kept: list[Any]

        def predict(self, forces: Any) -> Any:  # type: ignore[override]
            # Mapped pages, since freed heap of earlier tests would take small arrays unseen.
            self.kept.append(mmap(-1, 16_384) if how == "leaks" else 0)
            if how == "leaks":
                self.kept[-1].write(bytes(16_384))
            return super().predict(forces) * (1 + 1e-16 * len(self.kept) * (how == "drifts"))

    method = Spoiled().fit(tiny.scene)
    method.kept = []
    found = predict_often(method, tiny, 10_000)
    assert not found.ok
    assert bool(found.drifted) == (how == "drifts")
