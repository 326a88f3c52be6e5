"""The choice among synthetic comparisons, and a real one on beam-tiny."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.results.comparison import Comparison
from mor_bench.runs.pick import Requirements, choose, figure, newest_run, offline_rank
from mor_bench.specs import load_dataset_spec

NAMES = ("error", "latency_ms", "memory_bytes", "offline_s")


def a_row(label: str = "a", **changes: Any) -> dict[str, Any]:
    """A row that meets an error of 0.01, 3 ms, 200 MB and 100 s."""
    row: dict[str, Any] = {
        "dataset": "d",
        "split": "region",
        "method": label,
        "label": label,
        "parameters": {},
        "status": "ok",
        "reason": None,
        "n_train": 80,
        "n_test": 20,
        "n_failed": 0,
        "n_dofs": 189,
        "threads": 1,
        "error": {
            "mean_dof_m": 1e-4,
            "std_dof_m": 1e-5,
            "max_dof_m": 2e-4,
            "rel_l2_median": 0.005,
            "rel_l2_p95": 0.02,
            "rel_l2_max": 0.03,
            "max_nodal_m": 1e-3,
            "slope": 0.1,
        },
        "latency_ms": {
            "median": 1.0,
            "p95": 1.2,
            "p99": 1.3,
            "low": 0.9,
            "high": 1.1,
            "stable": True,
            "unstable_because": [],
        },
        "all_threads_ms": None,
        "throughput": None,
        "offline_s": {"data": 50.0, "fit": 1.0},
        "memory_bytes": {"fit": 3e8, "predict": 1.5e8},
        "model_bytes": 1000,
        "cost": None,
        "sets": {},
        "hidden": None,
        "warnings": [],
        "discretisation_error_m": None,
        "discretisation_rel_l2": 0.05,
    }
    return {**row, **changes}


ASKED = Requirements(0.01, 3.0, 2e8, 100.0)


def changed(row: dict[str, Any], part: str, **changes: Any) -> dict[str, Any]:
    return {**row, part: {**row[part], **changes}}


def test_the_row_that_all_tests_start_from_qualifies() -> None:
    chosen = choose([a_row()], ASKED, "d")
    assert chosen.choice == a_row()
    assert (chosen.runner_up, chosen.relaxations, chosen.nearest) == (None, [], None)


DISQUALIFIED = {
    "error": changed(a_row(), "error", rel_l2_median=0.011),
    "upper end of the error": changed(a_row(), "error", rel_l2_median_high=0.011),
    "error on fresh loads": a_row(
        hidden={"n": 20, "seed": 1, "rel_l2_median": 0.011, "rel_l2_p95": 0.02, "rel_l2_max": 0.03}
    ),
    "no answer on a fresh load": a_row(
        hidden={"n": 20, "seed": 1, "rel_l2_median": 0.005, "rel_l2_p95": 0.02, "rel_l2_max": inf}
    ),
    "error that is not a number": changed(a_row(), "error", rel_l2_median=nan),
    "one load without an answer": a_row(n_failed=1),
    "failed": a_row(
        status="failed",
        n_failed=None,
        error=None,
        latency_ms=None,
        offline_s=None,
        memory_bytes=None,
    ),
    "upper end of the latency": changed(
        a_row(), "latency_ms", high=3.1, stable=False, unstable_because=["a process was slow"]
    ),
    "latency without an interval": a_row(latency_ms={"median": 3.1, "p95": 3.2, "p99": 3.3}),
    "unknown latency": a_row(latency_ms=None),
    "memory": a_row(memory_bytes={"fit": 1.0, "predict": 2.1e8}),
    "unknown memory": a_row(memory_bytes=None),
    "memory of an older run": {
        key: value for key, value in a_row().items() if key != "memory_bytes"
    },
    "offline": a_row(offline_s={"data": 99.5, "fit": 1.0}),
    "unknown cost of data": a_row(offline_s={"data": None, "fit": 1.0}),
    "another dataset": a_row(dataset="e"),
}


@pytest.mark.parametrize("row", DISQUALIFIED.values(), ids=DISQUALIFIED)
def test_what_disqualifies(row: dict[str, Any]) -> None:
    assert choose([row], ASKED, "d").choice is None
    assert choose([row, a_row("b")], ASKED, "d").choice == a_row("b")


def test_what_is_not_asked_for_may_be_unknown() -> None:
    row = a_row(memory_bytes=None, offline_s={"data": None, "fit": 1.0})
    chosen = choose([row], Requirements(0.01, 3.0), "d")
    assert chosen.choice == row
    assert "unknown" in chosen.text()


def test_ranking_by_offline_cost_then_latency() -> None:
    """Seconds that differ within two digits, or below a second, decide nothing: then latency does."""
    slower = changed(a_row("slower"), "latency_ms", high=2.0)
    assert (
        choose([a_row("b", offline_s={"data": 0.0, "fit": 30.0}), a_row("a")], ASKED, "d").choice[
            "label"
        ]
        == "b"
    )  # type: ignore[index]
    for offline in ({"data": 50.0, "fit": 0.6}, {"data": 50.0, "fit": 1.4}):
        assert (
            choose([{**slower, "offline_s": offline}, a_row("fast")], ASKED, "d").choice["label"]
            == "fast"
        )  # type: ignore[index]
    tiny = [
        {**slower, "offline_s": {"data": 0.0, "fit": 0.01}},
        a_row("fast", offline_s={"data": 0.0, "fit": 0.4}),
    ]
    chosen = choose(tiny, ASKED, "d")
    assert (chosen.choice, chosen.runner_up) == (tiny[1], tiny[0])
    same = [{**row, "method": "same"} for row in tiny]
    assert choose(same, ASKED, "d").runner_up is None
    assert offline_rank(a_row(offline_s={"data": None, "fit": 0.1})) > offline_rank(
        a_row(offline_s={"data": 1e6, "fit": 0.1})
    )


positive = st.floats(1e-3, 1e3)
rows_of_figures = st.lists(
    st.tuples(
        positive,
        positive,
        st.none() | positive,
        st.none() | positive,
        st.integers(0, 5).map(lambda n: max(0, n - 4)),
    ),
    max_size=8,
)
limits = st.tuples(positive, positive, st.none() | positive, st.none() | positive)


def synthetic(
    number: int, figures: tuple[float, float, float | None, float | None, int]
) -> dict[str, Any]:
    error, latency, memory, data, n_failed = figures
    row = changed(
        changed(a_row(f"m{number}"), "error", rel_l2_median=error),
        "latency_ms",
        median=0.9 * latency,
        high=latency,
    )
    return {
        **row,
        "memory_bytes": memory and {"fit": 1.0, "predict": memory},
        "offline_s": {"data": data, "fit": 1.0},
        "n_failed": n_failed,
    }


@given(rows_of_figures, limits)
def test_the_choice_meets_everything_and_nothing_cheaper_does(
    figures: list[Any], limit: tuple[Any, ...]
) -> None:
    rows = [synthetic(number, row) for number, row in enumerate(figures)]
    requirements = Requirements(*limit)

    def meets(row: dict[str, Any]) -> bool:
        return row["n_failed"] == 0 and all(
            figure(row, name) <= value for name, value in requirements.asked.items()
        )

    def cost(row: dict[str, Any]) -> tuple[Any, ...]:
        return (*offline_rank(row), figure(row, "latency_ms"))

    chosen = choose(rows, requirements, "d")
    meeting = sorted((row for row in rows if meets(row)), key=cost)
    assert chosen.n_meeting == len(meeting)
    assert (chosen.choice is None) == (not meeting)
    assert chosen.text()
    json.dumps(chosen.as_json(), allow_nan=False)
    if chosen.choice is not None:
        assert meets(dict(chosen.choice))
        assert cost(dict(chosen.choice)) == cost(meeting[0])
        assert (chosen.relaxations, chosen.nearest) == ([], None)
        if len(meeting) > 1:
            assert chosen.runner_up is not None  # every row is a method of its own
            assert cost(dict(chosen.runner_up)) == cost(meeting[1])


@given(rows_of_figures, limits)
def test_a_relaxation_is_enough_and_less_is_not(figures: list[Any], limit: tuple[Any, ...]) -> None:
    rows = [synthetic(number, row) for number, row in enumerate(figures)]
    requirements = Requirements(*limit)
    chosen = choose(rows, requirements, "d")
    if chosen.choice is not None:
        return
    relaxed = {relaxation.name: relaxation for relaxation in chosen.relaxations}
    for name, value in requirements.asked.items():
        if name not in relaxed:
            assert choose(rows, replace(requirements, **{name: 1e300}), "d").choice is None
            continue
        relaxation = relaxed[name]
        assert relaxation.asked == value < relaxation.needed
        assert (
            choose(rows, replace(requirements, **{name: relaxation.needed}), "d").choice is not None
        )
        assert (
            choose(
                rows, replace(requirements, **{name: relaxation.needed * (1 - 1e-12)}), "d"
            ).choice
            is None
        )
    for line in chosen.text().splitlines():
        if line.startswith("Enough alone: error <= "):
            said = float(line.removeprefix("Enough alone: error <= ").split()[0]) / 100
            assert (
                choose(rows, replace(requirements, error=said * (1 + 1e-15)), "d").choice
                is not None
            )


def test_what_would_have_to_give_is_said() -> None:
    slow = changed(
        changed(a_row("exact"), "latency_ms", median=11.9, high=12.34), "error", rel_l2_median=1e-6
    )
    rough = changed(a_row("rough"), "error", rel_l2_median=0.02)
    chosen = choose([slow, rough, a_row("broken", n_failed=2)], Requirements(0.01, 3.0, 1e9), "d")
    assert chosen.nearest == rough
    text = chosen.text()
    assert (
        "d needs error <= 1 % (relative l2, median), latency <= 3 ms (median), memory <= 1000 MB."
        in text
    )
    assert (
        "None of 3 configurations meets all; 1 of them failed, were skipped or left loads without an answer."
        in text
    )
    assert "Enough alone: error <= 2 % (relative l2, median), by rough" in text
    assert "Enough alone: latency <= 12.4 ms (median), by exact" in text
    assert "Not enough alone: memory, whatever the limit" in text
    without = [{**row, "memory_bytes": None} for row in (slow, rough)]
    assert (
        "Not known of any configuration: memory"
        in choose(without, Requirements(0.01, 3.0, 1e9), "d").text()
    )
    assert "Nearest, with error 2 times the limit:" in text


def test_the_evidence_of_a_choice() -> None:
    sets = {
        "2x": {
            "n": 60,
            "n_failed": 3,
            "n_flagged": None,
            "mean_dof_m": inf,
            "rel_l2_median": 0.04,
            "rel_l2_p95": inf,
            "rel_l2_max": inf,
        }
    }
    unstable = changed(
        a_row("hpod [n_modes=20]", sets=sets),
        "latency_ms",
        stable=False,
        unstable_because=["processes differ by 9 %"],
    )
    chosen = choose([unstable], ASKED, "d")
    text = chosen.text()
    for said in (
        "Cheapest by offline cost",
        "hpod [n_modes=20]",
        "0.5 % median, 2 % p95, 3 % max on 20 test loads",
        "1 ms median [0.9, 1.1], 1.2 p95, 1 thread; unstable: processes differ by 9 %",
        "150 MB to predict",
        "data 50 s of 80 samples, fit 1 s",
        "4 % median, inf % p95, inf % max on 60 loads, 3 without an answer",
        "No other method meets all.",
    ):
        assert said in text
    assert (
        json.loads(json.dumps(chosen.as_json(), allow_nan=False))["choice"]["sets"]["2x"][
            "rel_l2_max"
        ]
        == "inf"
    )


@pytest.mark.parametrize("limit", [0.0, -1.0, nan, inf])
@pytest.mark.parametrize("name", NAMES)
def test_limits_out_of_range(name: str, limit: float) -> None:
    with pytest.raises(InvalidInputError, match=f"`{name}` must be a positive number; got {limit}"):
        Requirements(**{name: limit})


@pytest.fixture(scope="module")
def comparison(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """A real run in the default folder under a working folder of its own."""
    out = tmp_path_factory.mktemp("work") / "reports" / "runs" / "first"
    methods = ["fem", "linear-fem", "pca-regression"]
    return mor_bench.run(["beam-tiny"], methods, out=out, cache=cache, workers=1)


def test_a_real_choice(comparison: Comparison) -> None:
    exact = mor_bench.pick("beam-tiny", error=0.01, latency_ms=1e4, comparison=comparison)
    assert exact.choice is not None
    assert exact.choice["method"] == "fem"  # it needs no data, and linear elasticity errs by more
    assert figure(exact.choice, "error") <= 0.01
    assert exact.run == comparison.out
    rough = mor_bench.pick("beam-tiny", error=10.0, latency_ms=1e4, comparison=comparison.out)
    assert rough.choice is not None
    assert rough.choice["method"] in ("fem", "linear-fem")
    assert rough.n_meeting >= 3
    assert rough.runner_up is not None
    assert rough.runner_up["method"] != rough.choice["method"]
    impossible = mor_bench.pick("beam-tiny", error=1e-7, latency_ms=1e-4, comparison=comparison)
    assert impossible.choice is None
    assert [r.name for r in impossible.relaxations] == [
        "latency_ms"
    ]  # whatever error is allowed, nothing is that fast
    again = mor_bench.pick(
        "beam-tiny", error=1e-7, latency_ms=impossible.relaxations[0].needed, comparison=comparison
    )
    assert again.choice == impossible.relaxations[0].row


def test_where_the_evidence_comes_from(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = load_dataset_spec("beam-tiny")
    runs = comparison.out.parent
    found = newest_run(spec, runs)
    assert found is not None
    assert found.out == comparison.out
    older = Comparison(
        runs / "older",
        comparison.machine,
        comparison.rows,
        comparison.datasets,
        comparison.settings,
    )
    older.write()
    (older.out / "comparison.json").write_text("{}", encoding="utf-8")
    os.utime(older.out / "comparison.json", (0, 0))
    (runs / "damaged").mkdir()
    for name in ("results.json", "comparison.json"):
        (runs / "damaged" / name).write_text("{", encoding="utf-8")
    Comparison(
        runs / "unfinished",
        comparison.machine,
        comparison.rows,
        comparison.datasets,
        comparison.settings,
    ).write()
    (runs / "unfinished" / "comparison.json").unlink(missing_ok=True)
    found = newest_run(spec, runs)
    assert found is not None
    assert found.out == comparison.out
    content = spec.model_dump(mode="json")
    assert (
        newest_run(load_dataset_spec({**content, "needs": {"error": 0.5, "latency_ms": 7.0}}), runs)
        is not None
    )
    stiffer = load_dataset_spec({**content, "material": {**content["material"], "young_pa": 501.0}})
    assert newest_run(stiffer, runs) is None
    assert newest_run(spec, tmp_path) is None
    with pytest.raises(InvalidInputError, match="holds another beam-tiny"):
        mor_bench.pick(stiffer.model_dump(mode="json"), comparison=comparison)
    with pytest.raises(InvalidInputError, match="holds no beam-coarse; it holds beam-tiny"):
        mor_bench.pick("beam-coarse", comparison=comparison)
    monkeypatch.chdir(runs.parents[1])
    by_default = mor_bench.pick("beam-tiny")
    assert by_default.requirements == Requirements(0.01, 3.0)
    assert by_default.run == Path("reports") / "runs" / "first"


def test_without_evidence_the_comparison_is_run(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mor_bench.runs.configurations.CORE_METHODS", ("fem", "linear-fem"))
    chosen = mor_bench.pick("beam-tiny", latency_ms=1e4, cache=cache)
    assert chosen.run is not None
    assert chosen.run.parent == Path("reports") / "runs"
    assert (chosen.run / "comparison.json").exists()
    assert chosen.choice is not None
    assert chosen.choice["method"] == "fem"


def test_the_command(comparison: Comparison, tmp_path: Path) -> None:
    def command(*options: str) -> subprocess.CompletedProcess[str]:
        arguments = [
            sys.executable,
            "-m",
            "mor_bench",
            "pick",
            "beam-tiny",
            "--run",
            str(comparison.out),
            *options,
        ]
        return subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False)

    done = command(
        "--error", "0.01", "--latency", "10000", "--offline", "1000", "--memory", "1e6", "--json"
    )
    content = json.loads(done.stdout)
    assert content["requirements"] == {
        "error": 0.01,
        "latency_ms": 1e4,
        "memory_bytes": 1e12,
        "offline_s": 1e3,
    }
    assert done.returncode == (0 if comparison.rows[0].get("memory_bytes") else 1), done.stderr
    done = command("--error", "0.01", "--latency", "10000")
    assert done.returncode == 0, done.stderr
    assert "  fem [" in done.stdout
    done = command("--latency", "0.00001")
    assert done.returncode == 1
    assert "Enough alone: latency" in done.stdout
    assert command("--error", "0").returncode == 2
