"""Time the first run of a new user: installation, compilation, data, fits, timing and report.

    python -m tests.benchmarks.first_run --torch 2.13.0 --json first-run.json

clones this repository, makes an environment, installs the suite as README.md says, and runs the
default comparison with an empty cache and without compiled kernels. With `--avx2`, it does so a
second time with libraries held to AVX2. With `--torch`, that version of PyTorch is installed first.
It takes about nine minutes, and wants an idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

from tests.benchmarks.instructions import AVX2

ROOT = Path(__file__).parents[2]

RUN = r"""
import io, json, re, sys, time
import mor_bench
from rich.console import Console
from mor_bench.cli.run_progress import show_run
from mor_bench.runs.listener import Listener
from mor_bench.runs.plan import plan

ended, said = {}, []

class Lines(io.StringIO):
    def write(self, text):
        for left, unit in re.findall(r"; (\d+) (s|min) left", text):
            said.append([time.perf_counter() - begun, int(left) * {"s": 1, "min": 60}[unit]])
        return len(text)

def noting(stage, shown):
    def note(*what):
        getattr(shown, stage)(*what)
        ended[stage] = time.perf_counter() - begun
    return note

begun = time.perf_counter()
with show_run(Console(file=Lines(), width=200), plan) as shown:
    stages = ("compiling", "generating", "starting", "fitted", "timing")
    listener = Listener(**{stage: noting(stage, shown) for stage in stages})
    mor_bench.run(out=sys.argv[1], listener=listener)
ended["all"] = time.perf_counter() - begun
print(json.dumps({"ended": ended, "said": said}))
"""
"""Program that runs the default comparison with the progress that the terminal shows.

It prints when each stage ended, s, and what time left was stated when, s.
"""

FAIR_AFTER_S, FAIR_UNTIL_S = 60.0, 10.0
"""Statements of the time left are compared with the truth from the one time on, s, until the other
time before the end, s."""


def first_run(torch: str | None, environment: Mapping[str, str]) -> dict[str, Any]:
    """Install and run in new folders.

    Returns
    -------
    dict
        Seconds of the installation and of each stage, `total_s` of the run, and `estimated_s` and
        `estimate_s`: what the dry run says, and the seconds that it takes. `time_left` holds pairs
        of the time, s, and the time left that the progress stated then, s.
    """
    with tempfile.TemporaryDirectory() as folder:
        clone, home = Path(folder) / "clone", Path(folder) / "home"
        _call(["git", "clone", "--quiet", str(ROOT), str(clone)], Path(folder), {})
        env = {**environment, "XDG_CACHE_HOME": str(home)}
        begun = perf_counter()
        _call([sys.executable, "-m", "venv", ".venv"], clone, env)
        pip = [".venv/bin/pip", "install", "--quiet"]
        if torch:
            _call([*pip, f"torch=={torch}"], clone, env)
        _call([*pip, "-c", "constraints.txt", ".[all]"], clone, env)
        installed = perf_counter()
        # Its caches are its own, so that the run compiles and generates everything.
        apart = {"XDG_CACHE_HOME": f"{home}-dry", "NUMBA_CACHE_DIR": f"{home}-kernels"}
        said = _call([".venv/bin/mor-bench", "run", "--dry-run"], clone, {**env, **apart})
        estimated = perf_counter()
        printed = _call([".venv/bin/python", "-I", "-c", RUN, "out"], clone, env)
        drawn = perf_counter()
        _call([".venv/bin/mor-bench", "report", "out"], clone, env)
        report_s = perf_counter() - drawn
    found = json.loads(printed.splitlines()[-1])
    ended, total_s = found["ended"], found["ended"]["all"] + report_s
    return {
        "install_s": installed - begun,
        "estimated_s": _minutes(said) * 60,
        "estimate_s": estimated - installed,
        "compilation_s": ended["compiling"],
        "data_s": ended["generating"] - ended["compiling"],
        "fits_and_scores_s": ended["fitted"] - ended["generating"],
        "timing_s": ended["timing"] - ended["fitted"],
        "report_s": ended["all"] - ended["timing"] + report_s,
        "total_s": total_s,
        "time_left": found["said"],
        "time_left_off_percent": _worst_time_left(found["said"], total_s),
    }


def _worst_time_left(said: list[tuple[float, float]], total_s: float) -> float:
    """Return the largest difference between the stated and the true time left, %."""
    off = [
        100 * abs(left / (total_s - at) - 1)
        for at, left in said
        if at >= FAIR_AFTER_S and total_s - at >= FAIR_UNTIL_S
    ]
    return max(off)


def _call(command: list[str], folder: Path, environment: Mapping[str, str]) -> str:
    whole = {**os.environ, **environment}
    whole.pop("PYTHONPATH", None)
    done = subprocess.run(
        command, cwd=folder, env=whole, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def _minutes(said: str) -> float:
    """Read the estimate of a dry run.

    Raises
    ------
    ValueError
        If there is none.
    """
    found = re.search(r"^about ([\d.]+) (s|min|h)$", said, re.MULTILINE)
    if found is None:
        raise ValueError(f"The dry run gave no estimate: {said!r}.")
    return float(found[1]) * {"s": 1 / 60, "min": 1.0, "h": 60.0}[found[2]]


def main() -> None:
    """Print and store the seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", default=None)
    parser.add_argument("--avx2", action="store_true")
    parser.add_argument("--json", type=Path, default=None)
    given = parser.parse_args()
    runs = [{"instructions": "all", **first_run(given.torch, {})}]
    if given.avx2:
        runs.append({"instructions": "AVX2 only", **first_run(given.torch, AVX2)})
    text = json.dumps({"runs": runs}, indent=1)
    print(text)
    if given.json:
        given.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
