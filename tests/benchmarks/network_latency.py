"""Latency of single queries of the U-Net, by back end, network size and grid.

    python -m tests.benchmarks.network_latency --out network-latency.json

The networks have random weights, because times do not depend on them. All back ends of a network
take turns, so that other load on the machine affects all of them. Each row has the median, the 95th
percentile and the minimum over all queries, for the network alone.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from mor_bench.errors import UnavailableBackendError
from mor_bench.learning.inference import BACKENDS, Inference
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import load_scene
from mor_bench.specs import load_dataset_spec
from mor_bench.surrogates.umesh.network import new_network
from mor_bench.surrogates.umesh.padded_grid import padded_grid

SCENES = ("beam-coarse", "beam-fine", "l-shape", "liver-hex")
COLUMNS = (
    "scene",
    "grid",
    "channels",
    "steps",
    "threads",
    "backend",
    "median_ms",
    "p95_ms",
    "shortest_ms",
    "queries",
)


def latencies(
    shape: tuple[int, int, int], channels: int, steps: int, threads: int, turns: int, queries: int
) -> dict[str, list[float]]:
    """Return milliseconds of single queries with each back end, in turns."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        network = new_network(channels, steps, torch.Generator().manual_seed(0)).eval()
        inputs = torch.randn(1, *shape, 3, generator=torch.Generator().manual_seed(1)).permute(
            0, 4, 1, 2, 3
        )
        found: dict[str, list[float]] = {}
        functions = {}
        for backend in BACKENDS:
            try:
                functions[backend] = Inference(network, backend)
            except UnavailableBackendError as error:
                print(f"{backend}: {error}", file=sys.stderr)
                continue
            found[backend] = []
        with torch.inference_mode():
            for _ in range(turns):
                for backend, function in functions.items():
                    function(inputs)
                    for _ in range(queries):
                        start = perf_counter()
                        function(inputs)
                        found[backend].append(1e3 * (perf_counter() - start))
        return found
    finally:
        torch.set_num_threads(before)


def table(
    scenes: list[str],
    channels: list[int],
    steps: list[int],
    threads: list[int],
    turns: int,
    queries: int,
) -> Iterator[dict[str, Any]]:
    """Return rows with the columns `COLUMNS`."""
    for scene in scenes:
        loaded = load_scene(load_dataset_spec(scene))
        grid = grid_map(loaded.mesh, loaded.spec.grid_nodes)
        for k in steps:
            shape = padded_grid(grid, k).shape
            for c in channels:
                for n_threads in threads:
                    for backend, each in latencies(shape, c, k, n_threads, turns, queries).items():
                        median, late = np.percentile(each, [50, 95])
                        size = "x".join(str(n) for n in shape)
                        values = (
                            scene,
                            size,
                            c,
                            k,
                            n_threads,
                            backend,
                            *(round(float(v), 3) for v in (median, late, min(each))),
                            len(each),
                        )
                        yield dict(zip(COLUMNS, values, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene", action="append", choices=SCENES, help="repeat for more; all by default"
    )
    parser.add_argument("--channels", type=int, nargs="+", default=[8, 16, 32, 64])
    parser.add_argument("--steps", type=int, nargs="+", default=[2, 3, 4])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--queries", type=int, default=5, help="of a back end in each turn")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    rows = []
    for row in table(
        options.scene or list(SCENES),
        options.channels,
        options.steps,
        options.threads,
        options.turns,
        options.queries,
    ):
        rows.append(row)
        print("  ".join(f"{row[column]!s:>15}" for column in COLUMNS), flush=True)
    if options.out is not None:
        options.out.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
