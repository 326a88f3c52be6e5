"""The time left that is stated in recorded runs, against the true one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from mor_bench.cli import run_progress
from mor_bench.cli.run_progress import show_run
from mor_bench.measure.course import Course
from mor_bench.runs.listener import Listener
from mor_bench.runs.plan import Plan
from mor_bench.runs.time_left import Task, TimeLeft

COURSES: dict[str, Any] = json.loads(
    (Path(__file__).parent / "benchmarks" / "courses.json").read_text(encoding="utf-8")
)
"""Recorded by `tests.benchmarks.courses` on two cores with a load that changed between 4 and 8."""

RIGHT_FROM_S = {"with training": 70.0, "two methods": 290.0}
"""When the stated time is right, s: from the first fit on, and from the beginning of the timing.

Before it, the load made each run three to five times slower than planned.
"""


@pytest.mark.parametrize("name", RIGHT_FROM_S)
def test_the_stated_time_left_of_recorded_runs_is_right(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = replayed(COURSES[name], monkeypatch)
    checked = [(now, left, true) for now, left, true in stated if now >= RIGHT_FROM_S[name]]
    assert len(checked) > 100
    for now, left, true in checked:
        assert left == pytest.approx(true, rel=0.3, abs=5.0), now


def replayed(
    course: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> list[tuple[float, float, float]]:
    """Return times and the stated and true times left then, s, until timing ends."""
    (timing,) = course["timing"]
    end = timing["ended"][-1][0]
    estimate = TimeLeft({Task(*what): s for *what, s in course["tasks"] if what[1] != "report"})
    events = [(at, stage, what) for at, stage, *what in course["events"]]
    events += [(timing["begun"], "begun", [])]
    events += [(at, "done", [kind]) for at, kind in timing["ended"]]
    events.sort(key=lambda event: event[0])
    clock, stated = [0.0], []
    monkeypatch.setattr(run_progress, "monotonic", lambda: clock[0])
    monkeypatch.setattr(TimeLeft, "of", lambda _: estimate)
    parts = {kind: (n, seconds) for kind, (n, seconds) in timing["parts"].items()}
    dataset = course["tasks"][0][0]
    with show_run(Console(quiet=True), lambda: Plan([], [])) as listener:
        for (at, stage, what), (until, *_) in zip(events, [*events[1:], (end, "")], strict=True):
            clock[0] = at
            if stage == "begun":
                counted = Course(parts, lambda *w: listener.timing(dataset, *w), lambda: clock[0])
            elif stage == "done":
                counted.done(*what)
            else:
                tell(listener, stage, what)
            while clock[0] < until:
                stated.append((clock[0], estimate.seconds(clock[0]), end - clock[0]))
                clock[0] += 2.0
    return stated


def tell(listener: Listener, stage: str, what: list[Any]) -> None:
    """Call a listener as in the run."""
    getattr(listener, stage)(*what)
