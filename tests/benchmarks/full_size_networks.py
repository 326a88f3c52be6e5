"""Train networks in their authors' sizes on a graphics processor, side by side.

    python -m tests.benchmarks.full_size_networks --json umesh-paper-size.json

The datasets have the deformation of the paper of U-Mesh, the split is at random, and a batch has
four samples, as in that paper. `umesh-small` has the batches of its file. All trainings run side by
side, each in its own stream, because one small batch does not fill a graphics processor. Products
in float32 are rounded to TF32. Times of queries are measured after all trainings; they do not
depend on the weights, so few iterations and samples are enough for them.
"""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

import mor_bench
from mor_bench.learning.cuda_graphs import ALONE, ReplayedNetwork, volumes_last
from mor_bench.machine import gpu_name
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.report.published_figures import SCENES
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import load_dataset_spec
from mor_bench.specs.inline_parameters import split_method
from mor_bench.surrogates.field_network import FieldNetwork, OperatorSurrogate
from mor_bench.training_options import TrainingOptions
from tests.benchmarks.choices import PUBLISHED

AT_THE_PAPERS_DEFORMATION = {
    name if name == "liver-tet" else f"{name}-paper": scene for name, scene in SCENES.items()
}
"""Scenes of the paper, by the name of our dataset; `liver-tet` deforms less than in the paper."""

UMESH = {"schedule": "one-cycle", "precision": "bfloat16", "inference": "cuda"}
OTHERS: dict[str, dict[str, Any]] = {
    "mesh-graph-net": {
        "width": 128,
        "steps": 15,
        "hidden_layers": 2,
        "batch_size": 4,
        "learning_rate": 1e-3,
    },
    "graph-u-net": {"width": 128, "levels": 3, "steps": 2, "batch_size": 4, "learning_rate": 1e-3},
    "transolver": {
        "width": 128,
        "heads": 8,
        "slices": 64,
        "layers": 8,
        "batch_size": 4,
        "learning_rate": 1e-3,
    },
    "umesh-small": {**PUBLISHED, "inference": "cuda"},
}
"""Other networks from the force, in the sizes of their authors or of their authors' code.

`graph-u-net` has the width of the other graph network, and the levels of its file. `umesh-small`
has the size of its file, with the paper's loss and activation.
"""

EXTRA_SEED = 1
"""Seed of the loads of samples beyond those of a dataset."""

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
    """A network in training on a dataset.

    Attributes
    ----------
    method_name, name : str
        Names of the method and of the dataset.
    train : Snapshots
        Samples to learn from.
    method : Surrogate
    finished : SimpleQueue
        Receives this object when its training has ended.
    seconds : float
        Wall time of the fit, beside the other trainings.
    error : Exception or None
        What ended the training, if it did not end by itself.
    """

    method_name: str
    name: str
    data: Dataset
    train: Snapshots
    method: Any
    finished: SimpleQueue[Contestant]
    seconds: float = 0.0
    error: Exception | None = None

    def fit(self) -> None:
        begun = perf_counter()
        try:
            self.method.training = TrainingOptions(device="cuda", progress=self._progress)
            self.method.fit(self.data.scene, self.train)
        except Exception as error:
            self.error = error
        self.seconds = perf_counter() - begun
        self.finished.put(self)

    def _progress(self, done: int, planned: int, loss: float) -> None:
        if done % max(1, planned // 20) == 0:
            print(
                f"{self.method_name}, {self.name}: {done} of {planned}, loss {loss:.3g}", flush=True
            )


def joined(*parts: Snapshots) -> Snapshots:
    """Return the samples of several sets in one."""
    loads = [part.loads for part in parts if isinstance(part.loads, PatchLoads)]
    return Snapshots(
        parts[0].scene,
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


def network_of(method: Any) -> Any:
    """Return a copy of the network, without what its `precompute` has left on the processor."""
    network = method.build_network({})
    network.load_state_dict(method.network_.state_dict(), assign=True)
    return network.eval()


@torch.inference_mode()
def latency(contestant: Contestant) -> dict[str, Any]:
    """Return the times of single queries: the network with and without replay, whole ones."""
    method, forces = contestant.method, contestant.data.test.forces[:8]
    network = network_of(method)
    if isinstance(network, FieldNetwork):
        features = network.encode(torch.from_numpy(forces.astype(np.float32)))
        given = [features[i : i + 1] for i in range(len(features))]
    else:
        given = [torch.randn(1, *method.grid_.shape, 3).permute(0, 4, 1, 2, 3) for _ in forces]
    on_device = volumes_last(deepcopy(network).to("cuda"))

    def launched(inputs: torch.Tensor) -> torch.Tensor:
        answer: torch.Tensor = on_device(inputs.to("cuda")).cpu()
        return answer

    found = {
        "replayed": queries_ms(ReplayedNetwork(network), given),
        "launched": queries_ms(launched, given),
    }
    if method.parameters.get("inference") == "cuda":
        found["predict"] = queries_ms(method.predict, list(forces))
    return found


def scored(contestant: Contestant, samples: Snapshots) -> dict[str, float]:
    """Return the errors of samples, predicted on the graphics processor."""
    method = contestant.method
    if isinstance(method, OperatorSurrogate):
        network: Any = network_of(method).to("cuda")
        evaluate: Any = lambda fields: network(network.encode(fields.to("cuda"))).cpu()  # noqa: E731
        method.evaluate = evaluate  # type: ignore[method-assign]
    with ALONE:
        predicted: NDArray[np.float64] = np.concatenate(
            [method.predict(samples[i : i + 64].forces) for i in range(0, len(samples), 64)]
        )
    found = summary(sample_errors(predicted, samples.displacements))
    return {name: found[name] for name in SCORES}


def row_of(contestant: Contestant) -> dict[str, Any]:
    """Return the setting of a training, its loss over the iterations, and its errors."""
    method, data = contestant.method, contestant.data
    row: dict[str, Any] = {"method": contestant.method_name, "dataset": contestant.name}
    if contestant.error is not None:
        return row | {"error": repr(contestant.error)}
    curve = method.loss_curve_[:: max(1, len(method.loss_curve_) // N_POINTS)]
    row |= {
        **method.parameters,
        "n_weights": sum(weights.numel() for weights in method.network_.parameters()),
        "n_train": len(contestant.train),
        "n_test": len(data.test),
        "fit_s": contestant.seconds,
        "loss_curve": [float(f"{loss:.4g}") for loss in curve],
        "test": scored(contestant, data.test),
    }
    if _holds_out(method):
        row["validation"] = scored(contestant, data.validation)
    return row


def contestant_of(
    text: str, iterations: int, limit: int | None, finished: SimpleQueue[Contestant]
) -> Contestant:
    """Return a network and its samples from [METHOD[KEY=VALUE]@]DATASET[:ITERATIONS[:SAMPLES]].

    The method is U-Mesh by default. It learns from the samples of training and validation, without
    a choice by validation, unless its file holds samples out. Those that SAMPLES has beyond their
    number have loads of another seed.
    """
    chosen, _, rest = text.rpartition("@")
    method_name, given = split_method(chosen or "umesh")
    name, *numbers = rest.split(":")
    if name not in AT_THE_PAPERS_DEFORMATION:
        known = ", ".join(AT_THE_PAPERS_DEFORMATION)
        raise typer.BadParameter(f"a dataset must be one of {known}; got {name!r}.")
    known_methods = ["umesh", *OTHERS]
    if method_name not in known_methods:
        raise typer.BadParameter(f"a method must be one of {known_methods}; got {method_name!r}.")
    network = AT_THE_PAPERS_DEFORMATION[name].network
    umesh = {"channels": network.channels, "steps": network.steps, **UMESH}
    parameters = {k: v for k, v in OTHERS.get(method_name, umesh).items() if k not in given}
    method = mor_bench.load_method(
        chosen or "umesh", **parameters, iterations=int(numbers[0]) if numbers else iterations
    )
    data = mor_bench.load_dataset(name, limit, split="sample")
    train = data.train if _holds_out(method) else joined(data.train, data.validation)
    if len(numbers) > 1:
        if (more := int(numbers[1]) - len(train)) < 1:
            raise typer.BadParameter(f"SAMPLES must exceed {len(train)}; got {numbers[1]}.")
        train = joined(train, _more_samples(name, more))
    return Contestant(method_name, name, data, train, method, finished)


def _holds_out(method: mor_bench.Surrogate) -> bool:
    return float(method.parameters.get("validation_fraction", 0.0)) > 0.0


def _more_samples(name: str, n: int) -> Snapshots:
    """Return samples of a dataset with other loads."""
    spec: Any = load_dataset_spec(name)
    number = {"samples": n, "samples_per_patch": None}
    loads = spec.loads.model_copy(update={**number, "seed": EXTRA_SEED})
    data = mor_bench.load_dataset(spec.model_copy(update={"loads": loads}), split="sample")
    return joined(data.train, data.validation, data.test)


def main(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="[METHOD[KEY=VALUE]@]DATASET[:ITERATIONS[:SAMPLES]]; by default U-Mesh, all data."
        ),
    ] = None,
    iterations: Annotated[int, typer.Option(help="By default as in the paper.")] = 100_000,
    limit: Annotated[int | None, typer.Option(help="Samples of a dataset; all by default.")] = None,
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("full-size-networks.json"),
) -> None:
    """Train networks in their full sizes on a graphics processor."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    finished: SimpleQueue[Contestant] = SimpleQueue()
    names = scenes or list(AT_THE_PAPERS_DEFORMATION)
    for text in names:
        one = contestant_of(text, iterations, limit, finished)
        print(f"{text}: {len(one.train)} training samples", flush=True)
        Thread(target=one.fit, daemon=True).start()
    found: dict[str, Any] = {"gpu": gpu_name(), "torch": torch.__version__, "rows": []}
    ended = []
    for _ in names:
        ended.append(finished.get())
        row = row_of(ended[-1])
        found["rows"].append(row)
        print(row["method"], row["dataset"], row.get("error") or row["test"], flush=True)
        write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())
    for one, row in zip(ended, found["rows"], strict=True):
        if one.error is None:
            row["latency_ms"] = latency(one)
            print(row["method"], row["dataset"], row["latency_ms"], flush=True)
    write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
