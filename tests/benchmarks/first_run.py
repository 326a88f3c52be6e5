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

ROOT = Path(__file__).parents[2]

AVX2 = {
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ATEN_CPU_CAPABILITY": "avx2",
    "NUMBA_CPU_NAME": "haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
    "OPENBLAS_CORETYPE": "Haswell",
}
"""Environment in which oneDNN, PyTorch, Numba, NumPy and OpenBLAS use AVX2 at most."""

RUN = """
import json, sys, time
import mor_bench
from mor_bench.runs.listener import Listener

last = {}
def noting(stage):
    return lambda *_: last.update({stage: time.perf_counter() - begun})

begun = time.perf_counter()
stages = ("compiling", "generating", "fitted", "timing")
mor_bench.run(out=sys.argv[1], listener=Listener(**{stage: noting(stage) for stage in stages}))
last["all"] = time.perf_counter() - begun
print(json.dumps(last))
"""
"""Program that runs the default comparison; it prints when each stage ended, s."""


def first_run(torch: str | None, environment: Mapping[str, str]) -> dict[str, Any]:
    """Install and run in new folders.

    Returns
    -------
    dict
        Seconds of the installation and of each stage, `total_s` of the run, and `estimated_s` and
        `estimate_s`: what the dry run says, and the seconds that it takes.
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
    ended = json.loads(printed.splitlines()[-1])
    return {
        "install_s": installed - begun,
        "estimated_s": _minutes(said) * 60,
        "estimate_s": estimated - installed,
        "compilation_s": ended["compiling"],
        "data_s": ended["generating"] - ended["compiling"],
        "fits_and_scores_s": ended["fitted"] - ended["generating"],
        "timing_s": ended["timing"] - ended["fitted"],
        "report_s": ended["all"] - ended["timing"] + report_s,
        "total_s": ended["all"] + report_s,
    }


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
