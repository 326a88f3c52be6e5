"""Record how real runs went, so that the stated time left can be tested on them.

    python -m tests.benchmarks.courses --json tests/benchmarks/courses.json

runs each of `RUNS` with a cache of its own, and stores the planned seconds of its tasks and when
the listener was called. It takes about a quarter of an hour.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any
from unittest.mock import patch

import mor_bench
from mor_bench.measure import latency
from mor_bench.measure.course import Course
from mor_bench.runs.listener import Listener
from mor_bench.runs.plan import plan
from mor_bench.runs.time_left import tasks_of

RUNS: dict[str, dict[str, Any]] = {
    "the default": {},
    "two methods": {"methods": ["pod", "pca-regression-linear"]},
    "with training": {"methods": ["fem", "umesh"], "train": True, "fit_seconds": 40.0},
    "with a dataset to generate": {
        "datasets": ["beam-fine"],
        "methods": ["pod", "hpod"],
        "limit": 800,
    },
}
"""Arguments of the runs, by name."""

STAGES = ("compiling", "generating", "starting", "repeating")
"""Events of a listener that move the time left, but those of timing."""


def course_of(arguments: dict[str, Any]) -> dict[str, Any]:
    """Run, and return the planned seconds, the events and the parts of timing.

    Returns
    -------
    dict
        `tasks`, each with its planned seconds; `events`, each with its time, s, its name and what
        the listener was told; `timing`, for each dataset the parts of `Course` and when each ended;
        `end_s`.
    """
    events: list[list[Any]] = []
    timings: list[dict[str, Any]] = []
    begun = perf_counter()

    def noting(stage: str) -> Any:
        return lambda *what: events.append([perf_counter() - begun, stage, *what])

    listener = Listener(**{stage: noting(stage) for stage in STAGES})
    with tempfile.TemporaryDirectory() as folder:
        given = {**arguments, "cache": Path(folder) / "cache"}
        planned = plan(**given)
        planned_s = perf_counter() - begun
        with _parts_noted(timings, begun):
            mor_bench.run(out=Path(folder) / "out", listener=listener, **given)
    tasks = [[*task, steps] for task, steps in tasks_of(planned)]
    return {
        "planned_s": planned_s,
        "tasks": tasks,
        "events": events,
        "timing": timings,
        "end_s": perf_counter() - begun,
    }


@contextmanager
def _parts_noted(timings: list[dict[str, Any]], begun: float) -> Iterator[None]:
    class Noted(Course):
        def __init__(self, parts: Any, *given: Any) -> None:
            super().__init__(parts, *given)
            timings.append({"parts": parts, "begun": perf_counter() - begun, "ended": []})

        def done(self, kind: str) -> None:
            timings[-1]["ended"].append([perf_counter() - begun, kind])
            super().done(kind)

    with patch.object(latency, "Course", Noted):
        yield


def main() -> None:
    """Record and store the courses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[])
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    found = json.loads(given.json.read_text()) if given.json.exists() else {}
    for name in given.names or RUNS:
        found[name] = course_of(RUNS[name])
        given.json.write_text(json.dumps(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
