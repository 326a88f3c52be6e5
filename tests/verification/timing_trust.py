"""Check that timings can be trusted; run it on an otherwise idle machine.

    python -m tests.verification.timing_trust [--only PART] [--out FILE]

`reruns` repeats the measurement of some methods and counts the medians inside the interval of the
measurement before; `reruns-coarse` does so on the coarse beam, with a network. `pairs` times
identical code under two names, and code slowed by 10 %. `busy` times a method beside a busy
process. All but `busy` do so for the quick and the full protocol. It prints every count out of its
total and exits with 1 if one misses its goal. Together they take about 40 minutes on two cores.
With `--out`, each part is stored as soon as it ends, and a later call with the same file skips the
parts that were stored at the same commit.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.latency_intervals import latency_intervals
from mor_bench.measure.latency import PROTOCOLS, Queries, TimedMethod, measure_latencies
from mor_bench.measure.timing import Timing, why_unstable
from mor_bench.results.comparison import Comparison
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.sampling import draw_loads
from tests.synthetic import a_row
from tests.timed_methods import fitted_method, timed_method
from tests.verification.trust_record import trust_record

DATASET, COARSE = "beam-tiny", "beam-coarse"
AT_ONCE = 20
"""Comparisons, of three processes each, that are measured side by side."""

RERUN_PAIRS = 10
"""Pairs of successive measurements; with the methods below, 110 repeated medians."""

COARSE_PAIRS = 6
"""Pairs of `reruns-coarse`: 30 repeated medians."""

RERUN_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "fem": ("mor_bench.surrogates.fem:FullFEM", {"tolerance": 1e-4}),
    "fem-loose": ("mor_bench.surrogates.fem:FullFEM", {"tolerance": 1e-2}),
    "fem-tight": ("mor_bench.surrogates.fem:FullFEM", {"tolerance": 1e-8}),
    "fem-coarse": ("mor_bench.surrogates.fem_coarse:CoarseFEM", {"coarsening": 2}),
    "fem-jacobi": ("mor_bench.surrogates.fem:FullFEM", {"solver": "jacobi-pcg"}),
    "linear-fem": ("mor_bench.surrogates.linear_fem:LinearFEM", {}),
    "slowed": ("tests.third_party:Slowed", {"part": 0.5}),
}
RERUN_FITTED: dict[str, tuple[str, dict[str, Any]]] = {
    "pod": ("mor_bench.surrogates.pod:PODGalerkin", {"n_modes": 20}),
    "pod-tensor": ("mor_bench.surrogates.pod_tensor:TensorPOD", {"n_modes": 20}),
    "hpod": ("mor_bench.surrogates.hpod:HyperReducedPOD", {"n_modes": 20}),
    "pca-regression-linear": ("mor_bench.surrogates.pca_regression:PCARegression", {}),
}
"""Methods that learn from the first `SAMPLES` samples."""

COARSE_METHODS = {name: RERUN_METHODS[name] for name in ("fem", "linear-fem")}
COARSE_FITTED: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: RERUN_FITTED[name] for name in ("pod-tensor", "pca-regression-linear")},
    "umesh-linear": (
        "mor_bench.surrogates.umesh.method:UMesh",
        {"channels": 16, "input": "linear-response", "iterations": 20},
    ),
}
"""Methods of `reruns-coarse`. A network's latency does not depend on its weights."""

SAMPLES = 300

Part = dict[str, Any]
"""Counts of a part, each with its total (`of`), and whether all meet their goals (`trusted`)."""


def _queries(scene: Scene, folder: Path) -> Queries:
    forces = draw_loads(scene, 0, 400).nodal_forces(scene.patch_weights)
    forces = forces[np.argsort(np.linalg.norm(forces, axis=(1, 2)))]
    return Queries(forces, np.ones_like(forces), np.arange(forces.shape[1]), folder)


def _measured(
    scene: Scene,
    folder: Path,
    timed: dict[str, TimedMethod],
    seed: int,
    processes: str = "full",
) -> dict[str, Timing]:
    protocol = replace(PROTOCOLS[processes], all_cores=False)
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
            n_test=len(regions),
            error={"rel_l2_median": float(np.median(errors)), "mean_dof_m": 1e-4},
            latency_ms={"median": float(np.median(timing.latency_ms))},
        )
        comparison.put(row, {**timing.samples, "relative_l2": errors, "mean_dof_m": 0.1 * errors})
    return {
        (r["a"], r["b"]): r["verdict"]
        for r in analyse(comparison)["pairwise"]
        if r["target_rel_l2_median"] == 0.01
    }


def pairs(scene: Scene, folder: Path, n: int) -> Part:
    """Count wrong and right verdicts of the report's matrix in n comparisons per protocol.

    The first count is of identical code called different. The second is of code slowed by 10 % and
    called slower, which only the full protocol promises to find.
    """
    counts = {protocol: _count_pairs(scene, folder, n, protocol) for protocol in PROTOCOLS}
    false = max(found["identical_called_different"] for found in counts.values())
    found = counts["full"]["slowed_found"]
    return {"of": n, **counts, "trusted": false <= 0.05 * n and found >= 0.95 * n}


def _count_pairs(scene: Scene, folder: Path, n: int, protocol: str) -> dict[str, int]:
    false, found = 0, 0
    for start in range(0, n, AT_ONCE):
        numbers = range(start, min(n, start + AT_ONCE))
        methods = {
            f"{name}{i}": timed_method(
                scene,
                folder,
                "tests.third_party:Slowed",
                {"part": 0.1 if name == "slowed" else 0.0},
            )
            for i in numbers
            for name in ("one", "same", "slowed")
        }
        matrix = _matrix(_measured(scene, folder, methods, start, protocol), folder)
        false += sum(matrix[f"one{i}", f"same{i}"] != "undecided" for i in numbers)
        found += sum(matrix[f"slowed{i}", f"one{i}"] == "slower" for i in numbers)
        print(
            f"{protocol}: identical code called different: {false} of {numbers.stop}; "
            f"slow-down of 10 % found: {found} of {numbers.stop}",
            flush=True,
        )
    return {"identical_called_different": false, "slowed_found": found}


def reruns(scene: Scene, folder: Path, n: int) -> Part:
    """Count repeated medians in the interval of the previous measurement, in n pairs of runs."""
    methods = {name: timed_method(scene, folder, *found) for name, found in RERUN_METHODS.items()}
    return _reruns(DATASET, {**methods, **_fitted(DATASET, RERUN_FITTED, folder)}, folder, n)


def reruns_coarse(_: Scene, folder: Path, n: int) -> Part:
    """Do the same on the coarse beam, with a network."""
    scene = load_scene(COARSE)
    methods = {name: timed_method(scene, folder, *found) for name, found in COARSE_METHODS.items()}
    return _reruns(COARSE, {**methods, **_fitted(COARSE, COARSE_FITTED, folder)}, folder, n)


def _fitted(
    dataset: str, learning: dict[str, tuple[str, dict[str, Any]]], folder: Path
) -> dict[str, TimedMethod]:
    samples = load_dataset(dataset, SAMPLES, cache=folder / "cache").train
    return {
        name: fitted_method(
            load_scene(dataset), folder / f"{dataset}-{name}.safetensors", *found, samples
        )
        for name, found in learning.items()
    }


def _reruns(dataset: str, methods: dict[str, TimedMethod], folder: Path, n: int) -> Part:
    """Measure methods n + 1 times. Like a repeated run, every measurement has the same seed."""
    counts: dict[str, dict[str, Any]] = {}
    scene = load_scene(dataset)
    for protocol in PROTOCOLS:
        before: dict[str, Any] = {}
        inside: list[bool] = []
        widths: list[float] = []
        misses: list[str] = []
        for number in range(n + 1):
            timings = _measured(scene, folder, methods, 0, protocol)
            after = {name: timing.samples for name, timing in timings.items()}
            for name, (low, high) in latency_intervals(before).items():
                median = float(np.median(after[name]["latency_ms"]))
                inside.append(low <= median <= high)
                widths.append((high - low) / float(np.median(before[name]["latency_ms"])))
                if not inside[-1]:
                    misses.append(f"{number} {name}: {median:.4g} not in {low:.4g}–{high:.4g} ms")
            before = after
            print(
                f"{protocol}: {sum(inside)} of {len(inside)} medians inside the interval of the "
                "measurement before (goal: at least 90 %)",
                flush=True,
            )
        print("\n".join(misses), flush=True)
        counts[protocol] = {
            "inside": sum(inside),
            "of": len(inside),
            "median_width": round(float(np.median(widths)), 4),
            "misses": misses,
        }
    trusted = all(found["inside"] >= 0.9 * found["of"] for found in counts.values())
    return {**counts, "trusted": trusted}


def busy(scene: Scene, folder: Path, _: int) -> Part:
    """Check that a timing is called unstable beside a busy process, and only then."""
    methods = {"fem": timed_method(scene, folder, *RERUN_METHODS["fem"])}
    quiet = why_unstable(_measured(scene, folder, methods, 0)["fem"], 1)
    other = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        disturbed = why_unstable(_measured(scene, folder, methods, 0)["fem"], 1)
    finally:
        other.kill()
        other.wait()
    return {"alone": quiet, "beside": disturbed, "trusted": bool(disturbed) and not quiet}


PARTS: dict[str, tuple[Callable[[Scene, Path, int], Part], int]] = {
    "busy": (busy, 1),
    "reruns": (reruns, RERUN_PAIRS),
    "reruns-coarse": (reruns_coarse, COARSE_PAIRS),
    "pairs": (pairs, 100),
}
"""Function and default size of each part."""


def _stored(out: Path | None, record: dict[str, Any]) -> dict[str, Any]:
    """Return the record with the parts that a file holds from the same commit."""
    if out is None or not out.exists():
        return record
    kept = json.loads(out.read_text(encoding="utf-8"))
    if kept["commit"] != record["commit"] or kept["commit"].endswith("-dirty"):
        return record
    return {**record, **{name: kept[name] for name in PARTS if name in kept}}


def main() -> None:
    """Measure the parts, print them, and exit with 1 if one misses its goal."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--size", type=int, help="pairs of measurements, or comparisons")
    parser.add_argument("--out", type=Path, help="JSON file for the counts")
    options = parser.parse_args()
    scene, record = load_scene(DATASET), _stored(options.out, trust_record())
    names = [options.only] if options.only else list(PARTS)
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            part, size = PARTS[name][0], options.size or PARTS[name][1]
            if record.get(name, {}).get("size") != size:
                start = perf_counter()
                found = part(scene, Path(folder), size)
                record[name] = {"size": size, "seconds": round(perf_counter() - start), **found}
            if options.out:
                options.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            print(name, json.dumps(record[name]), flush=True)
    if not all(record[name]["trusted"] for name in names):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
