"""Break-even, profile, budgets, regimes and hidden sets, against hand-computed numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.analysis.break_even import break_even
from mor_bench.analysis.caveats import hidden, regimes, tuning
from mor_bench.analysis.draws import VALIDATION, error_bound
from mor_bench.analysis.frontier import compare, selecting_error
from mor_bench.analysis.performance_profile import profile, share_within
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import ErrorSummary, TrainingRecord
from mor_bench.results.row import Row, SetErrors
from tests.synthetic import a_row

Record = dict[str, Any]


def scored(
    method: str,
    label: str,
    error: float,
    latency_ms: float,
    data: float | None = 30.0,
    n_failed: int = 0,
) -> Row:
    """Return a row with only the figures that hand-computed checks need."""
    return a_row(
        method,
        label=label,
        error={"rel_l2_median": error},
        latency_ms={"median": latency_ms},
        offline_s={"data": data, "fit": 5.0, "fit_core_s": 10.0},
        n_dofs=600,
        n_train=1000,
        n_test=100,
        n_failed=n_failed,
    )


def medians(rows: Sequence[Row]) -> dict[str, float]:
    """Return the errors that select rows whose samples are not known."""
    return {row.label: selecting_error(row) for row in rows}


def at_one_percent(rows: Sequence[Row], bounds: Mapping[str, float]) -> list[dict[str, Any]]:
    records = compare(rows, bounds)["time_at_error"]
    return [record for record in records if record["target_rel_l2_median"] == 0.01]


def test_break_even_matches_hand_computed_values() -> None:
    rows = [
        scored("fem", "loose", 0.005, 1.0, 0.0),
        scored("fem", "tight", 1e-9, 2.0, 0.0),
        scored("quick", "quick", 0.008, 0.6),
        scored("slow", "slow", 0.008, 1.0),
        scored("exact", "exact", 1e-12, 0.1),
        scored("bought", "bought", 1e-3, 0.5, None),
    ]
    far = scored("far", "far", 0.5, 1.0)
    bounds = medians([*rows, far])
    records = [r for some in (rows, [far]) for r in compare(some, bounds)["time_at_error"]]
    records = [r for r in records if r["target_rel_l2_median"] == 0.01]
    rows += [
        scored("quick", "other", 0.9, 0.1),
        a_row("quick", label="failed", status="failed", tuning_s=15.0),
        a_row("quick", label="skipped", status="skipped"),
    ]
    found = {record["method"]: record for record in break_even(rows, records, medians(rows))}
    assert "fem" not in found
    # 40 core-seconds, less 10 to prepare the full-order model, over 0.4 ms.
    assert found["quick"]["queries"] == 75_000
    # Data, two fits, and 15 s of a failed fit on two cores like the others: 80 core-seconds.
    assert found["quick"]["queries_with_tuning"] == 175_000
    assert found["slow"]["verdict"] == "never"
    # The same full-order configuration for every method: 30 core-seconds over 0.9 ms.
    assert found["exact"]["queries"] == 33_334
    assert {record["fem_label"] for record in found.values() if record["label"]} == {"loose"}
    assert found["bought"]["verdict"] == "unknown"  # the cost of its data is unknown
    assert found["far"]["verdict"] == "not reached"
    inexact = {"loose": 0.02, "tight": 0.02}
    assert break_even(rows, records, bounds | inexact)[0]["verdict"] == "unknown"


def test_a_break_even_selects_by_the_rule_of_the_verdict() -> None:
    rows = [
        scored("fem", "fem", 0.001, 1.0, 0.0),
        scored("quick", "unsure", 0.008, 0.5).with_parts(
            validation=ErrorSummary(rel_l2_median=0.009)
        ),
        scored("quick", "sure", 0.008, 0.6).with_parts(
            validation=ErrorSummary(rel_l2_median=0.008)
        ),
        scored("quick", "partial", 0.008, 0.1, n_failed=1),
    ]
    bounds = {"fem": 0.002, "unsure": 0.011, "sure": 0.0095, "partial": np.inf}
    records = at_one_percent(rows, bounds)
    assert [r["best"] and r["best"]["label"] for r in records] == ["fem", "sure"]
    assert break_even(rows, records, bounds)[0]["queries"] == 75_000
    none = at_one_percent(rows, bounds | {"sure": 0.02})
    assert break_even(rows, none, bounds)[0]["verdict"] == "not reached"
    intervals: dict[str, dict[str, tuple[float, float]]] = {
        "unsure": {VALIDATION: (0.007, 0.011)},
        "sure": {VALIDATION: (0.007, 0.0095)},
    }
    found = {row.label: error_bound(row, intervals.get(row.label, {})) for row in rows}
    assert found == bounds | {"fem": 0.001}


def test_the_full_order_model_of_a_break_even_is_chosen_on_the_validation_part() -> None:
    def row(method: str, label: str, test: float, validation: float, latency_ms: float) -> Row:
        found = scored(method, label, test, latency_ms)
        return found.with_parts(validation=ErrorSummary(rel_l2_median=validation))

    rows = [
        row("fem", "loose", 0.005, 0.011, 1.0),
        row("fem", "tight", 1e-9, 1e-9, 2.0),
        row("quick", "quick", 0.008, 0.008, 0.6),
    ]
    bounds = medians(rows)
    assert break_even(rows, at_one_percent(rows, bounds), bounds)[0]["fem_label"] == "tight"


def test_a_break_even_counts_all_threads_and_no_training_on_a_gpu() -> None:
    rows = [scored("fem", "fem", 0.005, 1.0, 0.0), scored("quick", "quick", 0.008, 0.6)]
    bounds = medians(rows)
    records = at_one_percent(rows, bounds)
    two = [row.with_parts(threads=2) for row in rows]
    assert break_even(two, records, bounds)[0]["queries"] == 37_500
    on_gpu = [rows[0], rows[1].with_parts(training=TrainingRecord(device="cuda"))]
    found = break_even(on_gpu, records, bounds)[0]
    assert (found["verdict"], found["queries"]) == ("unknown", None)
    assert "its fit" in found["reason"]


def test_the_performance_profile_matches_hand_computed_values() -> None:
    times = {
        ("x", 0.1): (1.0, 2.0),
        ("x", 0.01): (4.0, None),
        ("y", 0.1): (3.0, 1.0),
        ("y", 0.01): (None, None),
    }
    records = [
        {"dataset": dataset, "target_rel_l2_median": target, "method": method, "latency_ms": time}
        for (dataset, target), both in times.items()
        for method, time in zip("ab", both, strict=True)
    ]
    found = profile(records)
    assert (found["n_unsolved"], found["n_datasets"], len(found["problems"])) == (1, 2, 3)
    assert found["factors"] == {"a": [1.0, 1.0, 3.0], "b": [2.0, None, 1.0]}
    shares = [share_within(found["factors"]["b"], tau) for tau in (1.0, 1.9, 2.0, np.inf)]
    assert shares == pytest.approx([1 / 3, 1 / 3, 2 / 3, 2 / 3])
    assert share_within([], 1.0) == 0.0


def test_tuning_reports_the_used_and_the_allowed_budget(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {}, settings={"budget": {"configurations": 2, "seconds": 15.0}})
    made.rows = [scored("a", f"a{i}", 0.1, 1.0) for i in range(2)]
    made.rows.append(a_row("a", label="a2", status="skipped"))
    assert tuning(made) == [
        {
            "dataset": "beam-tiny",
            "method": "a",
            "configurations": 2,
            "seconds": 10.0,
            "configurations_allowed": 2,
            "seconds_allowed": 15.0,
        }
    ]


@pytest.mark.parametrize(
    ("regime", "device", "lacks"),
    [
        ({"min_dofs": 600}, "cpu", ""),
        ({"min_dofs": 601}, "cpu", "600 degrees of freedom; it needs 601"),
        ({"min_train": 1001}, "cpu", "1,000 training samples; it needs 1,001"),
        ({"min_iterations": 5}, "cpu", "0 iterations; it needs 5"),
        ({"split": "sample"}, "cpu", "split by region"),
        ({"gpu": True}, "cpu", "no graphics processor"),
        ({"gpu": True}, "cuda", "trained on a graphics processor, but queried on the CPU"),
    ],
)
def test_a_method_is_in_its_regime_only_if_all_its_conditions_hold(
    tmp_path: Path, regime: Record, device: str, lacks: str
) -> None:
    made = Comparison(tmp_path, {}, settings={"device": device})
    made.rows = [scored(name, name, 0.1, 1.0) for name in "ab"]
    made.methods = {"a": {"regime": {"says": "large meshes", **regime}}, "b": {"regime": None}}
    lacking = f"not tested in its regime ({lacks}). It is for: large meshes"
    verdict = lacking if lacks else "in its regime"
    assert [(record["in_regime"], record["verdict"]) for record in regimes(made)] == [
        (not lacks, verdict),
        (None, "its file names no regime"),
    ]


@pytest.mark.parametrize(
    ("shipped", "fresh", "interval", "expected"),
    [
        (0.01, 0.0135, (0.009, 0.011), {"worse": True, "ratio": 1.35}),
        (0.01, 0.0135, (0.008, 0.0125), {"worse": False, "limit": 1.25**2**0.5}),
        (0.01, 0.0115, None, {"worse": False, "limit": 1.2}),
        (0.01, np.inf, (0.009, 0.011), {"worse": True, "ratio": None, "limit": 1.2}),
        (0.0, 0.0, (0.0, 0.0), {"worse": False}),
    ],
)
def test_a_hidden_set_is_called_worse_only_beyond_its_sampling_error(
    shipped: float, fresh: float, interval: tuple[float, float] | None, expected: Record
) -> None:
    plain = scored("a", "a", shipped, 1.0)
    row = plain.with_parts(hidden=SetErrors(n=100, rel_l2_median=fresh))
    intervals = {"a": {"rel_l2_median": interval}} if interval else {}
    (record,) = hidden([row, plain], "beam-tiny", intervals)
    assert {key: record[key] for key in expected} == pytest.approx(expected)
