"""Train U-Mesh in the paper's sizes on a graphics processor, and time its queries there.

    python -m tests.benchmarks.umesh_paper_size --json umesh-paper-size.json

The datasets have the paper's deformation, the split is at random, and a batch has four samples, as
in the paper. The trainings of all scenes run side by side, each in its own stream, because one
small batch does not fill a graphics processor. Times of queries are measured after all trainings.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

import mor_bench
from mor_bench.learning.cuda_graphs import ReplayedNetwork, volumes_last
from mor_bench.machine import gpu_name
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.report.published_figures import SCENES
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.store import write_atomically
from mor_bench.training_options import TrainingOptions

AT_THE_PAPERS_DEFORMATION = {
    name if name == "liver-tet" else f"{name}-paper": scene for name, scene in SCENES.items()
}
"""Scenes of the paper, by the name of our dataset; `liver-tet` deforms less than in the paper."""

SCORES = (
    "mean_dof_m",
    "std_dof_m",
    "max_dof_m",
    "slope",
    "rel_l2_median",
    "rel_l2_p95",
    "rel_l2_max",
    "amplitude_m",
    "tip_rel_at_max_e",
    "tip_rel_at_largest",
)
N_QUERIES, N_WARM_UP, N_POINTS = 200, 20, 100


@dataclass
class Contestant:
    """A scene with its network in training.

    Attributes
    ----------
    method : Surrogate
    finished : SimpleQueue
        Receives this object when its training has ended.
    started : Event
        Set when the steps are recorded.
    seconds : float
        Wall time of the fit, beside the other trainings.
    error : Exception or None
        What ended the training, if it did not end by itself.
    """

    name: str
    data: Dataset
    method: Any
    finished: SimpleQueue[Contestant]
    started: Event = field(default_factory=Event)
    seconds: float = 0.0
    error: Exception | None = None

    def fit(self) -> None:
        begun = perf_counter()
        try:
            self.method.training = TrainingOptions(device="cuda", progress=self._progress)
            self.method.fit(self.data.scene, without_validation(self.data))
        except Exception as error:
            self.error = error
        self.seconds = perf_counter() - begun
        self.started.set()
        self.finished.put(self)

    def _progress(self, done: int, planned: int, loss: float) -> None:
        self.started.set()
        if done % max(1, planned // 20) == 0:
            print(f"{self.name}: {done} of {planned}, loss {loss:.3g}", flush=True)


def without_validation(data: Dataset) -> Snapshots:
    """Return the samples of training and validation; nothing is chosen by validation."""
    parts = data.train, data.validation
    loads = [part.loads for part in parts if isinstance(part.loads, PatchLoads)]
    return Snapshots(
        data.scene,
        PatchLoads(
            np.concatenate([load.patches for load in loads]),
            np.concatenate([load.vectors for load in loads]),
        ),
        np.concatenate([part.free_displacements for part in parts]),
        np.concatenate([part.min_det_f for part in parts]),
    )


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
    """Return the times of single queries: whole ones, and the network with and without replay."""
    method = contestant.method
    shape = method.grid_.shape
    given = [torch.randn(1, *shape, 3).permute(0, 4, 1, 2, 3) for _ in range(8)]
    on_device = volumes_last(method.network_.to("cuda"))

    def launched(inputs: torch.Tensor) -> torch.Tensor:
        answer: torch.Tensor = on_device(inputs.to("cuda")).cpu()
        return answer

    forces = [contestant.data.test.forces[i] for i in range(8)]
    return {
        "replayed": queries_ms(ReplayedNetwork(method.network_), given),
        "launched": queries_ms(launched, given),
        "predict": queries_ms(method.predict, forces),
    }


def scored(contestant: Contestant) -> dict[str, float]:
    """Return the errors of all test samples, predicted on the graphics processor."""
    test = contestant.data.test
    predicted: NDArray[np.float64] = np.concatenate(
        [contestant.method.predict(test[i : i + 64].forces) for i in range(0, len(test), 64)]
    )
    found = summary(sample_errors(predicted, test.displacements))
    return {name: found[name] for name in SCORES}


def row_of(contestant: Contestant) -> dict[str, Any]:
    """Return the setting of a training, its loss over the iterations, and its errors."""
    method, data = contestant.method, contestant.data
    row: dict[str, Any] = {"dataset": contestant.name}
    if contestant.error is not None:
        return row | {"error": repr(contestant.error)}
    names = ("channels", "steps", "iterations", "batch_size", "learning_rate", "schedule")
    curve = method.loss_curve_[:: max(1, len(method.loss_curve_) // N_POINTS)]
    return row | {
        **{name: getattr(method, name) for name in (*names, "precision", "seed")},
        "n_weights": sum(weights.numel() for weights in method.network_.parameters()),
        "n_train": len(data.train) + len(data.validation),
        "n_test": len(data.test),
        "fit_s": contestant.seconds,
        "loss_curve": [float(f"{loss:.4g}") for loss in curve],
        "test": scored(contestant),
    }


def contestant_of(text: str, iterations: int, finished: SimpleQueue[Contestant]) -> Contestant:
    """Return the paper's network for a scene, from DATASET or DATASET:ITERATIONS."""
    name, _, own = text.partition(":")
    if name not in AT_THE_PAPERS_DEFORMATION:
        known = ", ".join(AT_THE_PAPERS_DEFORMATION)
        raise typer.BadParameter(f"a dataset must be one of {known}; got {name!r}.")
    network = AT_THE_PAPERS_DEFORMATION[name].network
    method = mor_bench.load_method(
        "umesh",
        channels=network.channels,
        steps=network.steps,
        iterations=int(own or iterations),
        schedule="one-cycle",
        precision="bfloat16",
        inference="cuda",
    )
    return Contestant(name, mor_bench.load_dataset(name, split="sample"), method, finished)


def main(
    scenes: Annotated[
        list[str] | None, typer.Argument(help="DATASET or DATASET:ITERATIONS; by default all.")
    ] = None,
    iterations: Annotated[int, typer.Option(help="By default as in the paper.")] = 100_000,
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("umesh-paper-size.json"),
) -> None:
    """Train U-Mesh in the paper's sizes on a graphics processor, and time its queries there."""
    finished: SimpleQueue[Contestant] = SimpleQueue()
    names = scenes or list(AT_THE_PAPERS_DEFORMATION)
    for name in names:
        one = contestant_of(name, iterations, finished)
        print(f"{one.name}: {len(one.data.train)} training samples", flush=True)
        Thread(target=one.fit, daemon=True).start()
        one.started.wait()  # one recording at a time
    found: dict[str, Any] = {"gpu": gpu_name(), "torch": torch.__version__, "rows": []}
    ended = []
    for _ in names:
        ended.append(finished.get())
        found["rows"].append(row_of(ended[-1]))
        _write(report, found)
    for one, row in zip(ended, found["rows"], strict=True):
        if one.error is None:
            row["latency_ms"] = latency(one)
    _write(report, found)


def _write(report: Path, found: dict[str, Any]) -> None:
    row = found["rows"][-1]
    print(row["dataset"], row.get("error") or row["test"], row.get("latency_ms"), flush=True)
    write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
