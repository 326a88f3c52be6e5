"""Small comparisons for tests: method files, short timings, and a run that tests share."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

import pytest

import mor_bench
from mor_bench.measure import latency, timing
from mor_bench.results.comparison import Comparison
from mor_bench.runs.cached_fit import FitRecord
from mor_bench.runs.listener import Listener

LIMIT = 60
"""Samples of beam-tiny in small runs."""

COMMAND = [sys.executable, "-m", "mor_bench"]

PLAIN: list[str | Path] = ["linear-fem", "pca-regression"]
"""Methods of the suite that are quick to fit: one learns from samples."""


def method_file(
    folder: Path,
    name: str,
    surrogate: str,
    sweep: dict[str, list[Any]] | None = None,
    **parameters: Any,
) -> Path:
    """Write a method file."""
    path = folder / f"{name}.toml"
    lines = ['title = "t"', 'source = "s"', f'surrogate = "{surrogate}"', "[parameters]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in parameters.items()]
    lines += ["[sweep]"] if sweep else []
    lines += [f"{key} = {json.dumps(values)}" for key, values in (sweep or {}).items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def descent_file(
    folder: Path, sweep: dict[str, list[Any]] | None = None, **parameters: Any
) -> Path:
    """Write the file of a method that trains by gradient descent in milliseconds."""
    return method_file(folder, "descent", "tests.third_party:Descent", sweep, **parameters)


def keep_fit_record(
    cache: Path, method: str, parameters: dict[str, Any], size: tuple[int, int], fit_s: float
) -> None:
    """Write the record of a fit to a cache; the size is the number of dofs and of samples."""
    record = FitRecord(
        method=method,
        n_dofs=size[0],
        n_train=size[1],
        fit_s=fit_s,
        fit_core_s=fit_s,
        fit_memory_bytes=1,
        model_bytes=1,
        needs_snapshots=True,
        parameters=parameters,
        warnings=[],
    )
    folder = cache / "fits" / f"{method}-{size[0]}-{size[1]}"
    folder.mkdir(parents=True)
    (folder / "fit.json").write_text(record.model_dump_json())


def wait_for(done: Callable[[], Any], process: Popen[str], within_s: float = 120.0) -> None:
    """Wait until something has happened while a process lives."""
    until = time.monotonic() + within_s
    while not done():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < until
        time.sleep(0.01)


@contextmanager
def short_timing() -> Iterator[None]:
    """Time with few queries, and reuse timings even if the machine is busy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(latency.PROTOCOLS, "quick", latency.Protocol(1, 3))
        patch.setattr(latency, "LEAST_QUERIES", 20)
        patch.setattr(latency, "LEAST_TURN_S", 0.002)
        patch.setattr(latency, "BATCH_S", 0.01)
        patch.setattr(timing, "SAME_SPEED", float("inf"))
        yield


def run_small(methods: list[str | Path], out: Path, cache: Path, **options: Any) -> Comparison:
    """Compare methods on a few samples of beam-tiny with a short timing."""
    with short_timing():
        return mor_bench.run(
            ["beam-tiny"], methods, out=out, cache=cache, **{"limit": LIMIT, **options}
        )


class Heard:
    """Records the events that a listener receives."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def listener(self) -> Listener:
        """Return the listener."""
        return Listener(
            starting=lambda dataset, label, number, total: self.events.append(
                f"start {number}/{total} {label}"
            ),
            fitted=lambda row: self.events.append(f"fitted {row.label} {row.latency_ms}"),
            finished=lambda row: self.events.append(
                f"timed {row.label} {row.latency_ms is not None}"
            ),
        )
