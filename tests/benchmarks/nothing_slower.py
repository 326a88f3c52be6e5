"""Compare start, memory and full-order solves of an earlier commit with those of today.

    python -m tests.benchmarks.nothing_slower 012668a --json nothing-slower.json

Both versions run in processes of their own, in turns, on one thread, with the same loads and with
compiled kernels. Times of solves are medians over the loads.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

import mor_bench
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.store import write_atomically

ROOT = Path(__file__).parents[2]
SCENES = {"beam-coarse": 200, "beam-fine": 40}
"""Number of loads of each scene."""
REPEATS = 3
"""Solves of each load; the fastest counts."""

CHILD = """
import json, resource, sys, time
begun = time.perf_counter()
import mor_bench
mor_bench.load_method
started = time.perf_counter() - begun
import numpy as np
scene = mor_bench.load_scene(sys.argv[1])
forces = np.load(sys.argv[2], allow_pickle=False)
begun = time.perf_counter()
method = mor_bench.load_method("fem").fit(scene, None)
method.predict(forces[0])
set_up = time.perf_counter() - begun
times = []
for force in forces:
    each = []
    for _ in range(int(sys.argv[3])):
        begun = time.perf_counter()
        method.predict(force)
        each.append(time.perf_counter() - begun)
    times.append(min(each))
memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps([started, set_up, float(np.median(times)), memory]))
"""
"""What each process does; it keeps to names that both versions have."""

FIGURES = ("import_s", "fit_and_first_solve_s", "solve_s", "memory_bytes")


def figures_of(code: Path, scene: str, forces: Path) -> dict[str, float]:
    """Run a version once; return its figures."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", CHILD, scene, forces, str(REPEATS)],
        cwd=code,
        env={**os.environ, **threads, "PYTHONPATH": str(code)},
        check=True,
        capture_output=True,
        text=True,
    )
    return dict(zip(FIGURES, json.loads(done.stdout.splitlines()[-1]), strict=True))


def main(
    commit: Annotated[str, typer.Argument(help="The earlier commit.")],
    rounds: Annotated[int, typer.Option(help="Processes of each version and scene.")] = 5,
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("nothing-slower.json"),
) -> None:
    """Compare start, memory and full-order solves of two versions."""
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory() as text:
        folder = Path(text)
        old, loads = folder / "code", folder / "forces.npy"
        subprocess.run(["git", "worktree", "add", "--detach", old, commit], cwd=ROOT, check=True)
        try:
            for name, n in SCENES.items():
                scene = mor_bench.load_scene(name)
                drawn = draw_loads(scene, 0, n)
                np.save(loads, drawn.nodal_forces(scene.patch_weights), allow_pickle=False)
                versions = {"before": old, "now": ROOT}
                found: dict[str, list[dict[str, float]]] = {version: [] for version in versions}
                for number in range(rounds + 1):  # the first compiles kernels
                    for version, code in versions.items():
                        figures = figures_of(code, name, loads)
                        if number:
                            found[version].append(figures)
                rows += [
                    {
                        "dataset": name,
                        "version": version,
                        **{figure: median(run[figure] for run in runs) for figure in FIGURES},
                    }
                    for version, runs in found.items()
                ]
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", old], cwd=ROOT, check=True)
    content = {"commit": commit, "rounds": rounds, "rows": rows}
    write_atomically(report, (json.dumps(content, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
