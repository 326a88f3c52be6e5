"""The tables of single test loads name the right loads, with their places and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mor_bench.report.entries import entries_of
from mor_bench.report.hardest_loads import hardest_loads
from mor_bench.report.page_samples import sampled
from tests.report_runs import N_TEST, add_row, tiny
from tests.synthetic import put_samples, sample_errors_of

ARRAYS = {
    "patch_centres": np.arange(3.0 * N_TEST).reshape(-1, 3),
    "test_regions": np.arange(N_TEST)[:, None],
    "test_force_n": np.linspace(0.0, 3.9, N_TEST),
}


def test_the_worst_loads_are_named_with_place_and_error(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {}, 0.01, 1.0)
    add_row(made, "partial", {}, 0.01, 1.0, n_failed=2)
    add_row(made, "fem", {}, 1e-9, 1.0, reference=True)
    entries = entries_of(made, "beam-tiny")
    worst, shared = hardest_loads(sampled(made, entries, entries), ARRAYS)
    assert worst.rows[0] == ["pod", "39", "0.75", "1.5", "200", "3.9", "117, 118, 119"]
    assert [row[1] for row in worst.rows] == ["39", "38", "37", "0", "1", "39"]
    assert worst.rows[3][2:4] == ["no prediction", "no prediction"]
    assert {row[0] for row in worst.rows} == {"pod", "partial"}
    assert shared.rows[0] == ["39", "2 of 2", "1.5", "1.5", "200", "3.9", "117, 118, 119"]


def test_a_load_that_one_method_finds_easy_is_not_hard_for_all(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {}, 0.01, 1.0)
    row = add_row(made, "hpod", {}, 0.01, 1.0)
    relative = 0.01 * np.linspace(0.5, 1.5, N_TEST)
    relative[39] = 1e-4
    errors = sample_errors_of(relative, np.linspace(0.01, 0.2, N_TEST), 0.25)
    put_samples(made, row, errors, {})
    entries = entries_of(made, "beam-tiny")
    shared = hardest_loads(sampled(made, entries, entries), {})[1]
    assert [r[:2] for r in shared.rows[:2]] == [["38", "2 of 2"], ["37", "2 of 2"]]
    assert "39" not in [r[0] for r in shared.rows]
    assert shared.rows[0][-2:] == ["–", "–"]


def test_without_samples_there_is_no_table(tmp_path: Path) -> None:
    assert hardest_loads([], {}) == []
