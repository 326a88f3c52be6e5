"""Check that timings can be trusted; run it on an otherwise idle machine.

    python -m tests.verification.timing_trust [comparisons]

It times identical code under two names, code slowed by 10 %, reruns, and a method beside a busy
process. It prints four shares and exits with 1 if one misses its target. A hundred comparisons take
about a quarter of an hour.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.latency_intervals import latency_intervals
from mor_bench.measure.latency import PROTOCOLS, Queries, measure_latencies
from mor_bench.measure.timing import Timing, why_unstable
from mor_bench.results.comparison import Comparison
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.sampling import draw_loads
from tests.synthetic import a_row
from tests.timed_methods import timed_method

DATASET = "beam-tiny"
AT_ONCE = 20
"""Comparisons, of three processes each, that are measured side by side."""

RERUNS = 6
RERUN_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "fem": ("mor_bench.surrogates.fem:FullFEM", {"tolerance": 1e-4}),
    "fem-tight": ("mor_bench.surrogates.fem:FullFEM", {"tolerance": 1e-8}),
    "fem-coarse": ("mor_bench.surrogates.fem_coarse:CoarseFEM", {"coarsening": 2}),
    "fem-jacobi": ("mor_bench.surrogates.fem:FullFEM", {"solver": "jacobi-pcg"}),
    "linear-fem": ("mor_bench.surrogates.linear_fem:LinearFEM", {}),
}


def _queries(scene: Scene, folder: Path) -> Queries:
    forces = draw_loads(scene, 0, 200).nodal_forces(scene.patch_weights)
    return Queries(forces, np.ones_like(forces), np.arange(forces.shape[1]), folder)


def _measured(
    scene: Scene,
    folder: Path,
    methods: dict[str, tuple[str, dict[str, Any]]],
    seed: int,
    processes: str = "full",
) -> dict[str, Timing]:
    protocol = replace(PROTOCOLS[processes], all_cores=False)
    timed = {name: timed_method(scene, folder, *method) for name, method in methods.items()}
    timings = measure_latencies(timed, _queries(scene, folder), protocol, 1, seed=seed)
    failed = {name: timing.failed for name, timing in timings.items() if timing.failed}
    if failed:
        raise SystemExit(f"failed: {failed}")
    return timings


def _matrix(timings: dict[str, Timing], folder: Path) -> dict[tuple[str, str], str]:
    """Return the verdicts of the report's matrix on methods of equal errors, at an error of 1 %."""
    comparison = Comparison(folder / "run", {}, settings={})
    regions = np.repeat(np.arange(13), 20)[:, None]
    comparison.add_dataset(
        DATASET, {"needs": {"error": 0.01, "latency_ms": 3.0}}, {"test_regions": regions}
    )
    errors = 1e-3 * np.random.default_rng(0).uniform(0.5, 2.0, len(regions))
    for name, timing in timings.items():
        row = a_row(
            name,
            dataset=DATASET,
            error={"rel_l2_median": float(np.median(errors)), "mean_dof_m": 1e-4},
            latency_ms={"median": float(np.median(timing.latency_ms))},
        )
        comparison.put(row, {**timing.samples, "relative_l2": errors, "mean_dof_m": 0.1 * errors})
    return {
        (r["a"], r["b"]): r["verdict"]
        for r in analyse(comparison)["pairwise"]
        if r["target_rel_l2_median"] == 0.01
    }


def comparisons(n: int, scene: Scene, folder: Path) -> tuple[int, int]:
    """Count wrong and right verdicts of the report's matrix in n comparisons.

    The first count is of identical code called different. The second is of code slowed by 10 % and
    called slower.
    """
    false, found = 0, 0
    for start in range(0, n, AT_ONCE):
        numbers = range(start, min(n, start + AT_ONCE))
        methods: dict[str, tuple[str, dict[str, Any]]] = {
            f"{name}{i}": ("tests.third_party:Slowed", {"part": 0.1 if name == "slowed" else 0.0})
            for i in numbers
            for name in ("one", "same", "slowed")
        }
        matrix = _matrix(_measured(scene, folder, methods, start), folder)
        false += sum(matrix[f"one{i}", f"same{i}"] != "undecided" for i in numbers)
        found += sum(matrix[f"slowed{i}", f"one{i}"] == "slower" for i in numbers)
        print(
            f"{numbers.stop} comparisons: {false} identical called different, {found} slowed found",
            flush=True,
        )
    return false, found


def reruns(scene: Scene, folder: Path, protocol: str) -> float:
    """Return the share of repeated medians that lie in the interval of the previous measurement."""
    runs = [
        {
            name: timing.samples
            for name, timing in _measured(scene, folder, RERUN_METHODS, seed, protocol).items()
        }
        for seed in range(RERUNS)
    ]
    inside = []
    for before, after in pairwise(runs):
        stated = latency_intervals(before)
        inside += [
            stated[name][0] <= np.median(after[name]["latency_ms"]) <= stated[name][1]
            for name in after
        ]
    return float(np.mean(inside))


def beside_a_busy_process(scene: Scene, folder: Path) -> bool:
    """Return whether a timing is called unstable beside a busy process, and only then."""
    methods = {"fem": RERUN_METHODS["fem"]}
    quiet = why_unstable(_measured(scene, folder, methods, 0)["fem"], 1)
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        disturbed = why_unstable(_measured(scene, folder, methods, 0)["fem"], 1)
    finally:
        busy.kill()
        busy.wait()
    print(json.dumps({"quiet": quiet, "beside a busy process": disturbed}), flush=True)
    return bool(disturbed) and not quiet


def main() -> None:
    """Print the shares, each with its target."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    scene = load_scene(DATASET)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        marked = beside_a_busy_process(scene, folder)
        print(
            f"a timing beside a busy process is marked, and a quiet one is not: {marked}",
            flush=True,
        )
        shares = {protocol: reruns(scene, folder, protocol) for protocol in PROTOCOLS}
        print(
            f"medians measured again inside the stated interval (target 90 %): {shares}", flush=True
        )
        false, found = comparisons(n, scene, folder)
    print(f"identical code called different in {false} of {n} (target at most 5 %)")
    print(f"slowed by a tenth found in {found} of {n} (target at least 95 %)")
    trusted = false <= 0.05 * n and found >= 0.95 * n
    if not (marked and min(shares.values()) >= 0.9 and trusted):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
