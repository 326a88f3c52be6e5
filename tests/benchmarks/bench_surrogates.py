"""Latency, error, memory, fitting time and model size of every method, on one thread."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.errors import MissingDependencyError, MorBenchError, SpecError, UnsupportedSceneError

if TYPE_CHECKING:
    from mor_bench.snapshots.dataset import Dataset

LIMITS = {"beam-tiny": 210, "beam-coarse": 400}
"""Samples of each dataset: few, so that generating and fitting everything takes seconds."""

METHODS: dict[str, dict[str, Any]] = {
    path.stem: tomllib.loads(path.read_text(encoding="utf-8"))
    .get("battery", {})
    .get("benchmark", {})
    for path in sorted((Path(__file__).parents[2] / "methods").glob("*.toml"))
}
"""Methods of the working tree and their hyperparameters, from the table `[battery]` of each file.

The files are read here because the library may be of a commit before this table. The latency of
U-Mesh does not depend on the length of its training; the error of so short a training says little.
"""

UNAVAILABLE = (MissingDependencyError, UnsupportedSceneError, SpecError)
"""An extra is missing, or the commit is from before the method or one of its knobs."""


def load_limited(dataset: str) -> Dataset:
    """Load the first samples of a dataset, cached in the working folder that asv deletes."""
    return mor_bench.load_dataset(dataset, limit=LIMITS[dataset], cache=Path("cache"), workers=1)


def model_file(dataset: str, method: str) -> Path:
    return Path(f"{dataset}-{method}.safetensors")


def record_file(dataset: str, method: str) -> Path:
    """Return the path of the results of `measure`, or of the reason for a missing model."""
    return Path(f"{dataset}-{method}.json")


def measure(data: Dataset, method: str, model: Path) -> dict[str, Any]:
    """Fit, save, and compare with the test part, which shares no load region with training."""
    try:
        surrogate = mor_bench.load_method(method, **METHODS[method])
        surrogate.fit(data.scene, data.train)
    except UNAVAILABLE as error:
        return {"unavailable": str(error)}
    surrogate.save(model)
    reference = data.test.displacements
    difference = surrogate.predict(data.test.forces) - reference
    relative = np.linalg.norm(difference, axis=(1, 2)) / np.linalg.norm(reference, axis=(1, 2))
    return {
        "bytes": model.stat().st_size,
        "mean_dof_m": float(np.abs(difference).mean()),
        "relative": float(np.median(relative)),
    }


class _Fitted:
    """Base of all measurements: `setup_cache` fits every method once; each measurement loads it."""

    params = (tuple(LIMITS), tuple(METHODS))
    param_names = ("dataset", "method")
    timeout = 300

    def setup_cache(self) -> None:
        with threadpool_limits(1):
            for dataset in LIMITS:
                data = load_limited(dataset)
                for method in METHODS:
                    record = measure(data, method, model_file(dataset, method))
                    record_file(dataset, method).write_text(json.dumps(record), encoding="utf-8")

    setup_cache.timeout = 600  # type: ignore[attr-defined]

    def setup(self, dataset: str, method: str) -> None:
        self.pinned = threadpool_limits(1)  # first, since what is skipped is torn down too
        self.record = json.loads(record_file(dataset, method).read_text(encoding="utf-8"))
        if "unavailable" in self.record:
            raise NotImplementedError(self.record["unavailable"])

    def teardown(self, dataset: str, method: str) -> None:
        self.pinned.restore_original_limits()


class Query(_Fitted):
    """One load at a time, from forces on the host to displacements on the host."""

    def setup(self, dataset: str, method: str) -> None:
        super().setup(dataset, method)
        test = load_limited(dataset).test
        self.surrogate = mor_bench.load_surrogate(model_file(dataset, method))
        sizes = np.linalg.norm(test.forces, axis=(1, 2))
        self.force = test.forces[int(sizes.argsort()[len(sizes) // 2])]
        self.surrogate.predict(self.force)

    def time_predict(self, dataset: str, method: str) -> None:
        self.surrogate.predict(self.force)

    def peakmem_predict(self, dataset: str, method: str) -> None:
        self.surrogate.predict(self.force)


class NetworkQuery(_Fitted):
    """A query of U-Mesh with each of its back ends."""

    params = (tuple(LIMITS), ("eager", "packed", "packed-bfloat16", "onnx"))
    param_names = ("dataset", "backend")

    def setup(self, dataset: str, method: str) -> None:
        super().setup(dataset, "umesh-small")
        try:
            from mor_bench.learning.inference import Inference

            surrogate: Any = mor_bench.load_surrogate(model_file(dataset, "umesh-small"))
            backend: Any = method
            surrogate.inference_ = Inference(surrogate.network_, backend)
        except (
            ImportError,
            MorBenchError,
        ) as error:  # the commit is from before, or the machine lacks it
            raise NotImplementedError(str(error)) from None
        self.surrogate = surrogate
        self.force = load_limited(dataset).test.forces[0]
        self.surrogate.predict(self.force)

    def time_predict(self, dataset: str, method: str) -> None:
        self.surrogate.predict(self.force)


class Fit(_Fitted):
    """Training time, and the size of the model."""

    rounds = 1
    number = 1
    repeat = (2, 5, 2.0)
    warmup_time = 0

    def setup(self, dataset: str, method: str) -> None:
        super().setup(dataset, method)
        self.data = load_limited(dataset)
        self.surrogate = mor_bench.load_method(method, **METHODS[method])

    def time_fit(self, dataset: str, method: str) -> None:
        self.surrogate.fit(self.data.scene, self.data.train)

    def peakmem_fit(self, dataset: str, method: str) -> None:
        self.surrogate.fit(self.data.scene, self.data.train)

    def track_model_size(self, dataset: str, method: str) -> int:
        return int(self.record["bytes"])

    track_model_size.unit = "bytes"  # type: ignore[attr-defined]


class Error(_Fitted):
    """Error on the test loads, which share no load region with training."""

    def track_mean_dof_error(self, dataset: str, method: str) -> float:
        """The mean over samples of the mean absolute error per degree of freedom."""
        return float(self.record["mean_dof_m"])

    track_mean_dof_error.unit = "m"  # type: ignore[attr-defined]

    def track_relative_error(self, dataset: str, method: str) -> float:
        """The median over samples of the relative l2 error."""
        return float(self.record["relative"])

    track_relative_error.unit = "relative l2"  # type: ignore[attr-defined]
