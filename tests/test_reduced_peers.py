"""Reduced models of other codes solve our equations; one with other equations is refused."""

from __future__ import annotations

import numpy as np
import pytest

from mor_bench.snapshots.dataset import Dataset
from tests.benchmarks.contenders import MAX_DIFFERENCE, DisagreementError, installed
from tests.benchmarks.kratos_reduced import KRATOS_ROM
from tests.benchmarks.reduced_peers import (
    METHODS,
    SAME_AS_POD,
    Ours,
    compare,
    make_contenders,
    own_methods,
)


def test_kratos_solves_the_same_reduced_equations(tiny: Dataset) -> None:
    missing = [name for name in KRATOS_ROM if not installed(name)]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    contenders = make_contenders(tiny.scene, tiny.train, 2)
    rows = {
        row.name: row
        for row in compare(tiny.test.forces[:2], tiny.test.displacements[:2], contenders, rounds=2)
    }
    kratos = [row for name, row in rows.items() if name.startswith("Kratos")]
    assert len(kratos) == 5
    for row in kratos:
        assert len(row.differences) == 4
        assert max(row.differences) <= MAX_DIFFERENCE
        assert min(row.steps) >= 2
        assert row.n_cells is not None
        assert (row.n_cells < tiny.scene.mesh.n_cells) == ("HROM" in row.name)
    assert rows["mor-bench, pod"].errors_m == pytest.approx(rows["Kratos POD, global"].errors_m)
    by_name = {contender.name: contender for contender in contenders}
    pod, ecm = by_name["mor-bench, pod"], by_name["mor-bench, hpod, ECM cells"]
    assert np.linalg.norm(ecm.displacement() - pod.displacement()) < 2e-3 * np.linalg.norm(
        pod.displacement()
    )  # cells for 1e-3


def test_wrong_reduced_solutions_are_refused(tiny: Dataset) -> None:
    said: list[str] = []
    fitted = own_methods(tiny.scene, tiny.train, [*METHODS, "knn"], 3, said.append)
    assert {"pod", "hpod"} <= set(fitted) <= set(METHODS)
    assert len(said) == len(METHODS) + 1 - len(fitted)
    pod = fitted["pod"]
    load = tiny.test.forces[:1], tiny.test.displacements[:1]
    same = [Ours(name, fitted[name], pod) for name in ("pod", *SAME_AS_POD) if name in fitted]  # type: ignore[arg-type]
    compare(*load, same, rounds=1)
    with pytest.raises(DisagreementError, match="another problem"):
        compare(*load, [Ours("hpod", fitted["hpod"], pod)], rounds=1)  # type: ignore[arg-type]
