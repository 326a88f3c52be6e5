"""Train the networks whose weights the suite ships, and write weights and records to ``trained/``.

    python -m tests.benchmarks.train_shipped

Each network is trained on the training part of beam-coarse with its quick parameters, but for more
iterations. A run uses the weights only while they agree with the dataset, the split, the parameters
and the code; `tests/test_shipped_models.py` fails when they do not. The cache keeps checkpoints, so
a stopped training continues.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from mor_bench.measure.method_session import MethodSession
from mor_bench.results.parts import TrainedElsewhere
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.code_digest import library_versions
from mor_bench.runs.configurations import configurations_of
from mor_bench.runs.fitting import fit_configuration
from mor_bench.runs.shipped_models import FOLDER, Binding, ShippedModel
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import default_cache
from mor_bench.specs import DatasetSpec, load_dataset_spec, load_method_spec

DATASET = "beam-coarse"

ITERATIONS = {"umesh": 20_000, "umesh-linear": 10_000}
"""Iterations of each shipped network."""

LIMIT_S = 10 * 3600.0
"""Time limit of a training, s."""

ROOT = Path(__file__).parents[2]


def ship(
    method: str, dataset: str, iterations: int, out: Path, environment: RunEnvironment
) -> Path:
    """Train a method's first quick configuration and write its weights; return their file."""
    spec = load_dataset_spec(dataset)
    assert isinstance(spec, DatasetSpec)
    data = load_dataset(spec, cache=environment.cache)
    configuration = configurations_of([load_method_spec(method)], "quick")[0]
    longer = replace(
        configuration, parameters={**configuration.parameters, "iterations": iterations}
    )
    with tempfile.TemporaryDirectory() as scratch:
        samples = TrainingData.of(data, Path(scratch))
        cached = CachedFit(longer, samples, environment)
        fit = fit_configuration(cached, LIMIT_S)
        origin = TrainedElsewhere(
            machine=environment.machine,
            core_s=fit.fit_core_s,
            wall_s=fit.fit_s,
            threads=environment.fit_threads,
            iterations=iterations,
            seed=fit.parameters["seed"],
            commit=_commit(),
            date=f"{datetime.now(UTC):%Y-%m-%d}",
            versions=library_versions(),
        )
        fit = fit.model_copy(update={"trained_elsewhere": origin})
        out.mkdir(parents=True, exist_ok=True)
        stem = out / f"{method}-{dataset}"
        ShippedModel.of(Binding.of(configuration, spec), samples, fit).write(cached.model, stem)
    return stem.with_suffix(".safetensors")


def _commit() -> str:
    asked = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Train the methods that are named, by default all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("methods", nargs="*", choices=[*ITERATIONS, []], help="default: all")
    parser.add_argument("--out", type=Path, default=ROOT / FOLDER)
    parser.add_argument("--cache", type=Path, default=default_cache())
    parser.add_argument("--jobs", type=int, default=1, help="a training uses cores / jobs threads")
    given = parser.parse_args()
    with closing(ForkServer(MethodSession, passive_wait=True)) as server:
        environment = RunEnvironment(given.cache, jobs=given.jobs, fork_server=server)
        for method in given.methods or ITERATIONS:
            print(ship(method, DATASET, ITERATIONS[method], given.out, environment))


if __name__ == "__main__":
    main()
