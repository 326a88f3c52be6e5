"""Time the parts of a training step of U-Mesh, with choices that might make it faster.

    python -m tests.benchmarks.training_speed --json training-speed.json

A step trains on a batch of random values, because times do not depend on them. The choices take
turns, so that other load on the machine affects all of them. Each time is the median of the rounds,
on one thread.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated, Any

import torch
import typer

from mor_bench.machine import describe_machine, pinned_threads
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.store import write_atomically
from mor_bench.surrogates.umesh.axes import longest_last, turned_grid
from mor_bench.surrogates.umesh.network import new_network
from mor_bench.surrogates.umesh.padded_grid import padded_grid

CASES = (("beam-coarse", 16, 2, 32), ("l-shape", 16, 2, 32), ("liver-hex", 16, 2, 16))
"""Scenes, channels, steps and batch sizes."""
CHOICES = ("as in the mesh", "longest last", "longest last, kernels channels-last")
PARTS = ("forward_ms", "backward_ms", "optimiser_ms")


class Step:
    """A training step of a network on a grid."""

    def __init__(self, case: tuple[str, int, int, int], choice: str) -> None:
        scene, channels, steps, self.batch = case
        loaded = load_scene(scene)
        grid = grid_map(loaded.mesh, loaded.spec.grid_nodes)
        if choice != CHOICES[0]:
            grid = turned_grid(grid, longest_last(grid.shape))
        self.shape = padded_grid(grid, steps).shape
        self.network = new_network(channels, steps, torch.Generator().manual_seed(0))
        if choice == CHOICES[2]:
            self.network.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        self.optimiser = torch.optim.Adam(self.network.parameters(), fused=True)
        values = torch.randn(2, self.batch, *self.shape, 3, generator=torch.Generator())
        self.given, self.wanted = values.permute(0, 1, 5, 2, 3, 4)

    def __call__(self) -> tuple[float, ...]:
        """Take the step; return its times in the order of `PARTS`."""
        times = [perf_counter()]
        loss = (self.network(self.given) - self.wanted).square().mean()
        times.append(perf_counter())
        self.optimiser.zero_grad()
        loss.backward()
        times.append(perf_counter())
        self.optimiser.step()
        times.append(perf_counter())
        return tuple(1e3 * (end - begin) for begin, end in pairwise(times))


def rows_of(case: tuple[str, int, int, int], rounds: int) -> list[dict[str, Any]]:
    """Return a row for each choice."""
    steps = {choice: Step(case, choice) for choice in CHOICES}
    found: dict[str, dict[str, list[float]]] = {
        choice: {part: [] for part in PARTS} for choice in steps
    }
    for number in range(rounds + 1):  # the first compiles kernels
        for choice, step in steps.items():
            for part, time in zip(PARTS, step(), strict=True):
                if number:
                    found[choice][part].append(time)
    scene, channels, n_steps, batch = case
    size = {"scene": scene, "channels": channels, "steps": n_steps, "batch_size": batch}
    return [
        {
            **size,
            "grid": " × ".join(map(str, steps[choice].shape)),
            "choice": choice,
            **{part: median(times) for part, times in found[choice].items()},
        }
        for choice in steps
    ]


def main(
    rounds: Annotated[int, typer.Option(help="Steps of each choice.")] = 15,
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("training-speed.json"),
) -> None:
    """Time the parts of a training step of U-Mesh."""
    with pinned_threads(1):
        rows = [row for case in CASES for row in rows_of(case, rounds)]
    found = {"machine": describe_machine(), "rounds": rounds, "rows": rows}
    write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
