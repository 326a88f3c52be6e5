"""Time single queries of the paper's networks on a graphics processor, on its six scenes.

    python -m tests.benchmarks.gpu_queries --json gpu-queries.json

The networks are trained for one iteration, because times do not depend on the weights. A query
copies the forces to the graphics processor and the displacements back.
"""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from queue import SimpleQueue
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import torch
import typer

from mor_bench.learning.cuda_graphs import ReplayedNetwork, volumes_last
from mor_bench.machine import gpu_name
from mor_bench.snapshots.store import write_atomically
from tests.benchmarks.full_size_networks import (
    AT_THE_PAPERS_DEFORMATION,
    Contestant,
    contestant_of,
    network_of,
)

N_SAMPLES, N_QUERIES, N_WARM_UP = 200, 200, 20


def queries_ms(function: Any, inputs: list[Any]) -> dict[str, float]:
    """Return median and 95th percentile of the time of single queries, ms."""
    times: list[float] = []
    for query in range(N_WARM_UP + N_QUERIES):
        given = inputs[query % len(inputs)]
        begun = perf_counter()
        function(given)
        times.append(1e3 * (perf_counter() - begun))
    kept = times[N_WARM_UP:]
    return {"median": float(np.median(kept)), "p95": float(np.percentile(kept, 95))}


@torch.inference_mode()
def latency(contestant: Contestant) -> dict[str, Any]:
    """Return the times of single queries: the network with and without replay, whole ones."""
    method, forces = contestant.method, contestant.data.test.forces[:8]
    network = network_of(method)
    given = [torch.randn(1, *method.grid_.shape, 3).permute(0, 4, 1, 2, 3) for _ in forces]
    on_device = volumes_last(deepcopy(network).to("cuda"))

    def launched(inputs: torch.Tensor) -> torch.Tensor:
        answer: torch.Tensor = on_device(inputs.to("cuda")).cpu()
        return answer

    return {
        "predict": queries_ms(method.predict, list(forces)),
        "replayed": queries_ms(ReplayedNetwork(network), given),
        "launched": queries_ms(launched, given),
    }


def main(
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("gpu-queries.json"),
) -> None:
    """Time single queries of the paper's networks on a graphics processor."""
    found: dict[str, Any] = {"gpu": gpu_name(), "torch": torch.__version__, "rows": []}
    for name in AT_THE_PAPERS_DEFORMATION:
        one = contestant_of(name, 1, SimpleQueue(), limit=N_SAMPLES)
        one.fit()
        if one.error is not None:
            raise one.error
        method = one.method
        row = {
            "dataset": name,
            "channels": method.channels,
            "steps": method.steps,
            "n_weights": sum(weights.numel() for weights in method.network_.parameters()),
            "latency_ms": latency(one),
        }
        print(row, flush=True)
        found["rows"].append(row)
        write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
