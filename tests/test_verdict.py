"""The verdict on rows: qualification, the winner and those beside it, suggested relaxations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mor_bench.analysis.draws import VALIDATION, draws_of
from mor_bench.analysis.selection import decide
from mor_bench.analysis.selection_text import retime_command
from mor_bench.analysis.verdict import RULE, Requirements, Verdict, offline_rank, speed_rank
from mor_bench.errors import InvalidInputError
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

ASKED = Requirements(0.01, 3.0, 2e8, 100.0)


def a_row(label: str = "a", **changes: Any) -> Row:
    """Make a row that meets `ASKED`; a dict changes single entries of a part."""
    content: dict[str, Any] = {
        "dataset": "d",
        "split": "region",
        "method": label,
        "label": label,
        "status": "ok",
        "n_train": 80,
        "n_test": 20,
        "n_failed": 0,
        "error": {"rel_l2_median": 0.005, "rel_l2_p95": 0.02, "rel_l2_max": 0.03},
        "latency_ms": {"median": 1.0, "p95": 1.2, "low": 0.9, "high": 1.1, "stable": True},
        "offline_s": {"data": 50.0, "fit": 1.0},
        "memory_bytes": {"fit": 3e8, "predict": 1.5e8},
        "model_bytes": 1000,
        "discretisation_rel_l2": 0.05,
    }
    for name, change in changes.items():
        old = content.get(name)
        content[name] = {**old, **change} if isinstance(old, dict) and change else change
    return Row.model_validate(content)


def choose(rows: Sequence[Row], requirements: Requirements, dataset: str = "d") -> Verdict:
    """Decide from rows alone."""
    made = Comparison(Path("nowhere"), {"processor": "p"}, list(rows))
    draws = draws_of(made, dataset, 200, np.random.default_rng(0))
    return decide(made, dataset, requirements, draws)


def fresh(median: float, largest: float) -> dict[str, Any]:
    return {"n": 20, "seed": 1, "rel_l2_median": median, "rel_l2_max": largest}


DISQUALIFIED = {
    "error": a_row(error={"rel_l2_median": 0.011}),
    "error on the validation part": a_row(validation={"rel_l2_median": 0.011}),
    "no answer on a validation load": a_row(validation={"rel_l2_median": 0.005, "rel_l2_max": inf}),
    "error on fresh loads": a_row(hidden=fresh(0.011, 0.03)),
    "no answer on a fresh load": a_row(hidden=fresh(0.005, inf)),
    "error that is not a number": a_row(error={"rel_l2_median": nan}),
    "one load without an answer": a_row(n_failed=1),
    "failed": a_row(status="failed", n_failed=None, error=None, latency_ms=None),
    "upper end of the latency": a_row(latency_ms={"high": 3.1, "stable": False}),
    "latency without an interval": a_row(latency_ms={"median": 3.1, "low": None, "high": None}),
    "unknown latency": a_row(latency_ms=None),
    "memory": a_row(memory_bytes={"predict": 2.1e8}),
    "unknown memory": a_row(memory_bytes=None),
    "offline": a_row(offline_s={"data": 99.5}),
    "unknown cost of data": a_row(offline_s={"data": None}),
    "another dataset": a_row(dataset="e"),
}


def test_the_unchanged_row_qualifies() -> None:
    chosen = choose([a_row()], ASKED, "d")
    assert chosen.choice == a_row()
    assert (chosen.runner_up, chosen.relaxations, chosen.nearest) == (None, (), None)
    assert RULE in chosen.text()


@pytest.mark.parametrize("row", DISQUALIFIED.values(), ids=DISQUALIFIED)
def test_one_figure_beyond_its_limit_disqualifies(row: Row) -> None:
    assert choose([row], ASKED, "d").choice is None
    assert choose([row, a_row("b")], ASKED, "d").choice == a_row("b")


def test_a_figure_without_a_limit_may_be_unknown() -> None:
    row = a_row(memory_bytes=None, offline_s={"data": None})
    chosen = choose([row], Requirements(0.01, 3.0), "d")
    assert chosen.choice == row
    assert "unknown" in chosen.text()


def test_the_fastest_wins_and_the_cheapest_offline_stands_beside_it() -> None:
    quick = a_row("quick", latency_ms={"median": 0.5}, offline_s={"fit": 30.0})
    cheap = a_row("cheap", offline_s={"data": 0.0, "fit": 0.4}, told="equations", reference=True)
    again = a_row("again", latency_ms={"median": 0.7}, method="quick", offline_s={"data": None})
    chosen = choose([cheap, again, quick], Requirements(0.01, 3.0))
    assert [row.label for row in chosen.qualified] == ["quick", "again", "cheap"]
    assert (chosen.choice, chosen.runner_up, chosen.cheapest) == (quick, cheap, cheap)
    assert chosen.best_told == {"equations": cheap, None: quick}
    line = "Cheapest offline: cheap (reference), 1 ms at 0.5 %, less than one core-second of data"
    assert line in chosen.text()
    assert "Such costs count as equal" in chosen.text()
    assert "count as equal" not in choose([quick], ASKED).text()
    assert choose([quick, again], Requirements(0.01)).runner_up is None
    rows = [
        a_row(name, latency_ms={"median": ms}, offline_s={"data": 0.0, "fit": fit_s})
        for name, ms, fit_s in (("a", 1.0, 40.4), ("b", 2.0, 40.1), ("c", 3.0, 30.0))
    ]
    assert choose(rows[:2], ASKED).cheapest == rows[0]  # a tie in two digits goes to the faster
    assert choose(rows, ASKED).cheapest == rows[2]
    brief = [
        a_row(name, latency_ms={"median": ms}, offline_s={"data": 0.0, "fit": fit_s})
        for name, ms, fit_s in (("a", 1.0, 0.9), ("b", 2.0, 0.1), ("c", 3.0, 0.01))
    ]
    assert choose(brief, ASKED).cheapest == brief[0]  # costs below a second are equal


def test_validation_selects_and_the_test_set_confirms() -> None:
    lucky = a_row("lucky", validation={"rel_l2_median": 0.02}, latency_ms={"median": 0.1})
    unlucky = a_row("unlucky", validation={"rel_l2_median": 0.004}, error={"rel_l2_median": 0.013})
    chosen = choose([lucky, unlucky], ASKED)
    assert chosen.choice == unlucky
    assert "1.3 %: it does NOT meet the limit of 1 % there" in chosen.headline
    honest = unlucky.with_parts(error=lucky.error)
    assert "0.5 %: it meets the limit of 1 % there." in choose([honest], ASKED).headline
    without = honest.with_parts(validation=None)
    assert "selected on the test set: optimistic" in choose([without], ASKED).headline


def test_the_upper_bound_of_the_validation_errors_qualifies(tmp_path: Path) -> None:
    regions = np.repeat(np.arange(13), 20)
    errors = 0.009 * np.exp(np.random.default_rng(0).normal(0, 0.3, 13))[regions]
    made = Comparison(tmp_path, {})
    made.add_dataset(
        "d", {}, {"test_regions": regions[:, None], "validation_regions": regions[:, None]}
    )
    row = a_row(validation={"rel_l2_median": float(np.median(errors))})
    row = row.with_parts(n_test=260, n_validation=260)
    made.put(row, {"relative_l2": np.full(260, 0.001), "validation_relative_l2": errors})
    draws = draws_of(made, "d", 500, np.random.default_rng(0))
    high = draws.intervals["a"][VALIDATION][1]
    assert 1.05 < high / np.median(errors) < 2.0
    for limit, qualified in ((0.999 * high, 0), (1.001 * high, 1)):
        assert len(decide(made, "d", Requirements(limit), draws).qualified) == qualified
    made.add_samples(row, {"seeds_validation_relative_l2": np.array([3 * errors, errors / 3])})
    wider = draws_of(made, "d", 500, np.random.default_rng(0)).intervals["a"][VALIDATION][1]
    assert wider > 2 * high


def test_close_latencies_are_listed_as_undecided() -> None:
    rows = [a_row(str(ms), latency_ms={"median": ms}) for ms in (1.0, 1.01, 2.0)]
    chosen = choose(rows, ASKED)
    assert [row.label for row in chosen.undecided] == ["1.01"]
    assert "Cannot be told apart from the winner in latency: 1.01." in chosen.beside


def test_the_command_that_times_again_repeats_what_was_recorded() -> None:
    settings = {"profile": "full", "train": True, "seeds": 2, "limit": None, "device": "cpu"}
    settings |= {"budget": {"configurations": 16, "seconds": 900.0}, "version": "0"}
    made = Comparison(Path("a run"), {}, [a_row(dataset="e")], settings=settings)
    made.datasets |= {"d": {}, "e": {}}
    made.methods["pod"] = {}
    draws = draws_of(made, "e", 20, np.random.default_rng(0))
    command = retime_command(decide(made, "e", Requirements(), draws))
    options = "--profile full --train --seeds 2 --time-limit 900"
    assert sorted(command.split()) == sorted(
        f"mor-bench run d e -m pod {options} --out 'a run' --retime".split()
    )


def test_each_class_of_information_has_its_best() -> None:
    rows = [
        a_row("force", told="input", error={"rel_l2_median": 0.5}),
        a_row("derived", told="linear-response", snapshots=True),
    ]
    chosen = choose(rows, ASKED)
    assert chosen.best_told == {"input": None, "linear-response": rows[1]}
    nearest = "none qualifies; the nearest is force, 1 ms at 50 %."
    assert f"Best when told force only: {nearest}" in chosen.beside
    assert "  derived (force and linear response, snapshots)" in chosen.evidence


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


def synthetic(number: int, figures: tuple[Any, ...]) -> Row:
    error, latency, memory, data, n_failed = figures
    return a_row(
        f"m{number}",
        error={"rel_l2_median": error},
        latency_ms={"median": 0.9 * latency, "high": latency},
        memory_bytes=memory and {"predict": memory},
        offline_s={"data": data},
        n_failed=n_failed,
    )


@given(rows_of_figures, limits)
def test_the_choice_is_the_fastest_row_that_meets_every_limit(
    figures: list[Any], limit: tuple[Any, ...]
) -> None:
    rows = [synthetic(number, row) for number, row in enumerate(figures)]
    requirements = Requirements(*limit)

    def meets(row: Row) -> bool:
        bounds, asked = chosen.figures[row.label], requirements.asked.items()
        return row.n_failed == 0 and all(bounds[name] <= value for name, value in asked)

    chosen = choose(rows, requirements, "d")
    meeting = sorted((row for row in rows if meets(row)), key=speed_rank)
    assert list(chosen.qualified) == meeting
    assert (chosen.choice is None) == (not meeting)
    assert chosen.text()
    json.dumps(chosen.as_json(), allow_nan=False)
    if chosen.choice is not None:
        assert (chosen.relaxations, chosen.nearest) == ((), None)
        assert chosen.runner_up == (meeting[1] if len(meeting) > 1 else None)
        assert chosen.cheapest == min(meeting, key=offline_rank)


@given(rows_of_figures, limits)
def test_a_suggested_relaxation_is_the_smallest_that_is_enough(
    figures: list[Any], limit: tuple[Any, ...]
) -> None:
    rows = [synthetic(number, row) for number, row in enumerate(figures)]
    requirements = Requirements(*limit)

    def qualifies(**changed: float) -> bool:
        return choose(rows, replace(requirements, **changed), "d").choice is not None

    chosen = choose(rows, requirements, "d")
    if chosen.choice is not None:
        return
    relaxed = {relaxation.name: relaxation for relaxation in chosen.relaxations}
    for name, value in requirements.asked.items():
        if name not in relaxed:
            assert not qualifies(**{name: 1e300})
            continue
        assert relaxed[name].asked == value < relaxed[name].needed
        assert qualifies(**{name: relaxed[name].needed})
        assert not qualifies(**{name: relaxed[name].needed * (1 - 1e-12)})
    beginning = "Enough alone: error <= "
    for line in chosen.text().splitlines():
        if line.startswith(beginning):
            shown = float(line.removeprefix(beginning).split()[0]) / 100
            assert qualifies(error=shown * (1 + 1e-15))


def test_a_bound_just_above_its_limit_is_never_rounded_onto_it() -> None:
    just = a_row("just", error={"rel_l2_median": 0.010046})
    text = choose([just], Requirements(0.01, 3.0, 1e9), "d").text()
    assert "error 1.01 times the limit" in text


def test_without_a_choice_the_text_names_the_limits_to_relax() -> None:
    slow = a_row("exact", latency_ms={"median": 11.9, "high": 12.34}, error={"rel_l2_median": 1e-6})
    rough = a_row("rough", error={"rel_l2_median": 0.02})
    limits = Requirements(0.01, 3.0, 1e9)
    chosen = choose([slow, rough, a_row("broken", n_failed=2)], limits, "d")
    assert chosen.nearest == rough
    for line in (
        "d needs error <= 1 % (relative L2 error, median), latency <= 3 ms (median), "
        "memory <= 1000 MB.",
        "No configuration qualifies among 3 configurations.",
        "1 of 3 configurations failed, were skipped or left loads without an answer.",
        "Enough alone: error <= 2 % (relative L2 error, median), by rough",
        "Enough alone: latency <= 12.4 ms (median), by exact",
        "Not enough alone: memory, whatever the limit",
        "The nearest is rough, 1 ms at 2 %, with error 2 times the limit.",
    ):
        assert line in chosen.text()
    without = [row.with_parts(memory_bytes=None) for row in (slow, rough)]
    assert "Not known of any configuration: memory" in choose(without, limits, "d").text()


def test_a_choice_comes_with_its_evidence() -> None:
    far = {"n": 60, "n_failed": 3, "rel_l2_median": 0.04, "rel_l2_p95": inf, "rel_l2_max": inf}
    reasons = ["processes differ by 9 %"]
    unstable = {"stable": False, "unstable_because": reasons}
    row = a_row(
        "hpod [n_modes=20]", sets={"2x": far}, latency_ms=unstable, hidden=fresh(0.001, 0.2)
    )
    chosen = choose([row], ASKED, "d")
    for line in (
        "hpod [n_modes=20] wins: the only one that qualifies among 1 configurations",
        "hpod [n_modes=20]",
        "0.5 % median, 2 % p95, 3 % max on 20 test loads",
        "on 20 freshly drawn loads",
        "1 ms median [0.9, 1.1], 1.2 p95, 1 thread; unstable: processes differ by 9 %",
        "150 MB to predict",
        "data 50 core-s of 80 samples, fit 1 core-s",
        "4 % median, inf % p95, inf % max on 60 loads, 3 without an answer",
        "The discretisation error of the mesh is 5 % (median).",
        "No other method that was tried qualifies.",
        "1 of 1 timings was not stable, the winner among them. Time again: mor-bench run d",
    ):
        assert line in chosen.text()
    content = json.loads(json.dumps(chosen.as_json(), allow_nan=False))
    assert content["choice"]["sets"]["2x"]["rel_l2_max"] == "inf"
    assert content["requirements"] == ASKED.asked


@pytest.mark.parametrize("limit", [0.0, -1.0, nan, inf])
@pytest.mark.parametrize("name", ["error", "latency_ms", "memory_bytes", "offline_s"])
def test_a_limit_must_be_a_positive_number(name: str, limit: float) -> None:
    with pytest.raises(InvalidInputError, match=f"`{name}` must be a positive number; got {limit}"):
        Requirements(**{name: limit})
