"""The time left in a run: from the plan at first, then from what the run has measured."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from rich.console import Console

from mor_bench.cli import run_progress
from mor_bench.cli.run_progress import show_run
from mor_bench.runs.plan import Plan, StageName, Step
from mor_bench.runs.time_left import NO_FASTER, Task, TimeLeft
from tests.published.stored import content_of
from tests.synthetic import a_row

FITS: dict[str, list[float | None]] = {
    "fem": [0.5],
    "pod": [2.0, 3.0, 5.0],
    "umesh": [60.0],
    "mine": [None],
}


def planned() -> Plan:
    """A plan of 40 s of samples, 80 s of fits and 100 s of timing."""
    steps = [Step("beam", "samples", False, 40.0, "samples")]
    steps += [
        Step("beam", f"{method} [n={i}]", False, seconds, "fit", method)
        for method, times in FITS.items()
        for i, seconds in enumerate(times)
    ]
    stages = [
        Step("beam", "compilation", False, 20.0, "compilation"),
        *(Step("beam", f"{method}: scores", False, 1.0, "scores", method) for method in FITS),
        Step("beam", "timing", False, 100.0, "timing"),
        Step("beam", "report", False, 5.0, "report"),
    ]
    return Plan(steps, stages)


def events(left: TimeLeft, pace: Mapping[StageName, float]) -> Iterator[tuple[float, Task, float]]:
    """Yield time, task and fraction of a run whose stages take `pace` times their plan."""
    now = 0.0
    for task, steps in left.steps.items():
        seconds = sum(steps) * pace[task.stage]
        for i in range(10):
            known = task.stage in ("samples", "timing")
            yield now + i / 10 * seconds, task, i / 10 if known else 0.0
        now += seconds
    yield now, Task("", "report"), 0.0


def test_at_first_the_time_left_is_that_of_the_plan() -> None:
    left = TimeLeft.of(planned())
    known = planned().seconds
    assert left.seconds(0.0) == pytest.approx(known + 5.0)  # a fit of unknown duration
    left.enter(Task("beam", "compilation"), 0.0)
    left.enter(Task("beam", "samples"), 20.0)
    assert left.seconds(30.0) == pytest.approx(known + 5.0 - 30.0)


@pytest.mark.parametrize("seed", range(20))
def test_after_a_minute_the_time_left_is_right_within_a_third_if_the_plan_is_fair(
    seed: int,
) -> None:
    generator = np.random.default_rng(seed)
    left = TimeLeft.of(planned())
    common = generator.uniform(0.8, 1.25)
    pace = {
        task.stage: (max(common, 1.0) if task.stage in NO_FASTER else common)
        * generator.uniform(0.85, 1.15)
        for task in left.steps
    }
    passed = list(events(left, pace))
    end, checked = passed[-1][0], 0
    for now, task, fraction in passed[:-1]:
        left.enter(task, now, fraction)
        if now > 60:
            checked += 1
            assert left.seconds(now) == pytest.approx(end - now, rel=0.3, abs=3.0), (now, task)
    assert checked > 20


def test_a_known_share_of_a_task_corrects_a_plan_that_is_far_off() -> None:
    left = TimeLeft.of(planned())
    timing = Task("beam", "timing")
    left.enter(timing, 0.0)
    left.enter(timing, 150.0, 0.5)  # planned: 100 s, real: 300 s
    assert left.seconds(150.0) == pytest.approx(150.0 + 5.0)


def test_a_task_that_takes_longer_than_planned_keeps_a_rest() -> None:
    left = TimeLeft.of(planned())
    left.enter(Task("beam", "fit", "fem"), 0.0)
    rest = left.seconds(0.0) - 1.5
    assert left.seconds(100.0) == pytest.approx(rest + 10.0)


def test_what_is_not_planned_is_ignored_and_a_share_of_fits_counts() -> None:
    left = TimeLeft.of(planned())
    left.enter(Task("beam", "fit", "unknown"), 3.0)
    assert left.seconds(3.0) == left.seconds(0.0)
    assert left.share(Task("beam", "fit", "pod"), 2) == pytest.approx(5 / 11)


def test_progress_in_a_pipe_is_lines_with_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_progress, "PRINT_EVERY_S", 0.0)
    console = Console(width=80)
    failed = a_row("umesh", status="failed", reason="no [b]memory[/b]", n_failed=None)
    with show_run(console, planned) as listener:
        listener.generating("beam", 0, 100)
        listener.generating("beam", 50, 100)
        listener.starting("beam", "pod [n=0]", 2, 6)
        listener.fitted(
            a_row("pod", error={"rel_l2_median": 0.01}, offline_s={"data": 1, "fit": 2})
        )
        listener.fitted(failed)
        listener.timing("beam", 40, 50)
    shown = capsys.readouterr().out
    assert "beam: 50 of 100 samples; " in shown
    assert re.search(r"beam: fit 2 of 6, pod \[n=0\]; [\d.]+ (s|min) left\n", shown)
    assert "umesh: failed: no [b]memory[/b]" in shown
    assert "beam: timing in turns, 80 %" in shown
    assert "pod: error" not in shown
    with show_run(console, planned, verbose=True) as listener:
        listener.fitted(
            a_row("pod", error={"rel_l2_median": 0.01}, offline_s={"data": 1, "fit": 2})
        )
    assert "pod: error 1 % (median), fit 2 s" in capsys.readouterr().out
    with show_run(console, planned, quiet=True) as listener:
        listener.fitted(failed)
    assert capsys.readouterr().out == ""


def test_the_times_stated_in_the_stored_first_run_were_right_within_30_percent() -> None:
    runs = content_of("reports/start/first-run.json")["runs"]
    assert len(runs) == 2
    for run in runs:
        assert run["estimated_s"] == pytest.approx(run["total_s"], rel=0.3)
        assert run["time_left_off_percent"] <= 30
