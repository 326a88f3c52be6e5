"""The ensemble of POD-NN: its answer is the mean of its members, its spread their disagreement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.report.caveat_tables import error_bounds
from mor_bench.report.entries import entries_of
from mor_bench.snapshots.dataset import Dataset
from tests.small_runs import method_file, run_small

pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.surrogates.pod_nn import PODNN, PODNNEnsemble

SIZE: dict[str, Any] = {"n_hidden": 8, "iterations": 100, "n_input_modes": 5, "n_output_modes": 6}


@pytest.mark.parametrize("input_kind", ["force", "linear-response"])
def test_answer_and_spread_are_those_of_the_members(tiny: Dataset, input_kind: Any) -> None:
    ensemble = PODNNEnsemble(n_members=3, input=input_kind, **SIZE).fit(tiny.scene, tiny.train)
    forces = tiny.test.forces
    answers = []
    for name in ensemble.names:
        arrays = {
            key.replace(f"{name}.", "network."): value
            for key, value in ensemble.arrays_.items()
            if not key.startswith("network_") or key.startswith(f"{name}.")
        }
        answers.append(PODNN(input=input_kind, **SIZE).restore(tiny.scene, arrays).predict(forces))
    members = np.array(answers)
    mean = members.mean(axis=0)
    np.testing.assert_allclose(ensemble.predict(forces), mean, atol=1e-12 * np.abs(mean).max())
    away = np.sqrt(((members - mean) ** 2).sum(axis=(2, 3)).mean(axis=0))
    expected = away / np.linalg.norm(mean, axis=(1, 2))
    np.testing.assert_allclose(ensemble.spread(forces), expected, rtol=1e-6)
    assert expected.min() > 0
    assert ensemble.spread(forces[:0]).shape == (0,)


def test_a_load_without_any_answer_has_an_infinite_spread(tiny: Dataset) -> None:
    """From the force alone, a load that no training load resembles may give no displacement."""
    size = {**SIZE, "n_input_modes": 2}
    ensemble = PODNNEnsemble(n_members=2, input="force", **size).fit(tiny.scene, tiny.train)
    touched = tiny.train.forces.any(axis=(0, 2))
    unlike = np.zeros((tiny.scene.mesh.n_nodes, 3))
    unlike[np.flatnonzero(~touched)[0], 2] = 1.0
    assert not ensemble.predict(unlike).any()
    assert ensemble.spread(unlike) == np.inf
    assert ensemble.spread(0.0 * unlike) == 0.0


def test_the_first_member_trains_as_a_single_network(tiny: Dataset) -> None:
    """Batches are drawn after all initial weights, so only the first step sees equal samples."""
    size = {**SIZE, "iterations": 1}
    single = PODNN(**size).fit(tiny.scene, tiny.train[:64])
    ensemble = PODNNEnsemble(n_members=2, **size).fit(tiny.scene, tiny.train[:64])
    for name in ("first", "second", "last"):
        first = ensemble.arrays_[f"network_0.{name}"]
        np.testing.assert_allclose(first, single.arrays_[f"network.{name}"], rtol=1e-4)
        assert not np.allclose(first, ensemble.arrays_[f"network_1.{name}"])


def test_the_spread_counts_wanted_nodes_only(tiny: Dataset) -> None:
    needs = tiny.scene.spec.needs.model_copy(update={"outputs": "x-max"})
    scene = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"needs": needs}))
    part = PODNNEnsemble(n_members=2, **SIZE).fit(scene, tiny.train)
    whole = PODNNEnsemble(n_members=2, **SIZE).fit(tiny.scene, tiny.train)
    forces = tiny.test.forces[:5]
    arrays = [
        PODNN(**SIZE).restore(
            tiny.scene,
            {
                key.replace(f"network_{i}.", "network."): value
                for key, value in whole.arrays_.items()
                if not key.startswith("network_") or key.startswith(f"network_{i}.")
            },
        )
        for i in range(2)
    ]
    first, second = (one.predict(forces)[:, scene.output_nodes] for one in arrays)
    expected = np.linalg.norm(first - second, axis=(1, 2)) / np.linalg.norm(
        first + second, axis=(1, 2)
    )
    np.testing.assert_allclose(part.spread(forces), expected, rtol=1e-6)


def test_a_run_reports_the_scaled_bound(tmp_path: Path, cache: Path) -> None:
    """Every sample is a group of its own here; in beam-tiny's few regions bounds are infinite."""
    made = "mor_bench.surrogates.pod_nn:PODNNEnsemble"
    method = method_file(tmp_path, "ensemble", made, n_members=2, **SIZE)
    found = run_small(["linear-fem", method], tmp_path / "out", cache, split="sample")
    bounds = {row.method: row.bound for row in found.rows}
    assert bounds["linear-fem"] is not None
    assert bounds["linear-fem"].scaled is None
    assert bounds["ensemble"] is not None
    scaled = bounds["ensemble"].scaled
    assert scaled is not None
    assert 0.5 < scaled.coverage["test"] <= 1.0
    assert scaled.widths["test"] > 0
    table = error_bounds(entries_of(found, "beam-tiny"))
    assert table is not None
    assert [row[0] for row in table.rows] == ["linear-fem", "ensemble", "ensemble × spread"]
    assert "× spread" in table.note
    scaled.widths.clear()  # as if the bound were infinite
    table = error_bounds(entries_of(found, "beam-tiny"))
    assert table is not None
    assert [row[0] for row in table.rows] == ["linear-fem", "ensemble"]
    assert "× spread" not in table.note
