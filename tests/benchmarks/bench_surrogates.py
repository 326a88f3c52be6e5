"""Every method of the suite on one thread: latency of a single query, error on the test loads, memory, fit and size of the model."""

from __future__ import annotations

import json
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
    "fem": {"tolerance": 1e-4},
    "fem-coarse": {"coarsening": 2, "tolerance": 1e-4},
    "fem-jacobi-pcg": {"tolerance": 1e-4},
    "fem-pardiso": {"tolerance": 1e-4},
    "fem-warm": {"start": "nearest", "tolerance": 1e-4},
    "linear-fem": {},
    "pod": {"n_modes": 20},
    "hpod": {"n_modes": 20, "cubature_tolerance": 1e-2},
    "hybrid": {"start_parameters": {"n_modes": 20}, "steps": 1},
    "pod-tensor": {"n_modes": 20},
    "autoencoder": {"n_latent": 10, "iterations": 500},
    "local-pod": {"n_clusters": 8, "n_modes": 10},
    "modal-derivatives": {"n_linear": 5, "n_modes": 20},
    "quadratic-manifold": {"n_modes": 5},
    "ecm": {"n_modes": 20, "cubature_tolerance": 1e-2},
    "deim": {"n_modes": 20, "n_force_modes": 40},
    "pca-regression": {"n_input_modes": 10},
    "pca-regression-force": {"n_input_modes": 20, "n_output_modes": 20},
    "explicit-dynamics": {"tolerance": 1e-2},
    "pgd": {"n_terms": 60, "position_degree": 3},
    "pgd-force": {"n_terms": 60, "position_degree": 3},
    "umesh": {
        "channels": 8,
        "steps": 2,
        "iterations": 200,
        "batch_size": 16,
        "learning_rate": 3e-3,
    },
    "umesh-small": {"channels": 8, "iterations": 200},
    "umesh-linear": {"channels": 8, "iterations": 200},
    "pca-ridge": {},
    "pca-kernel-ridge": {},
    "pca-gaussian-process": {"n_input_modes": 10},
    "pca-random-forest": {},
    "pca-extra-trees": {},
    "pca-polynomial-force": {"n_input_modes": 40},
    "pod-nn-force": {"iterations": 500},
    "sparse-polynomial-force": {"max_terms": 500},
    "pod-nn": {"iterations": 500},
    "pod-nn-derivative": {"iterations": 500},
    "sparse-polynomial": {"max_terms": 500},
    "sparse-polynomial-derivative": {"max_terms": 500},
    "deeponet": {"input": "linear-response", "iterations": 500},
    "pod-deeponet": {"input": "linear-response", "iterations": 500},
    "fno": {"input": "linear-response", "iterations": 100},
    "mesh-graph-net": {"input": "linear-response", "iterations": 30},
    "gappy-pod": {"n_modes": 20},
}
"""Methods and their knobs. U-Mesh's latency does not depend on how long it was trained; the error of so short a training says little."""

UNAVAILABLE = (MissingDependencyError, UnsupportedSceneError, SpecError)
"""An extra is missing, or the commit is from before the method or one of its knobs."""


def load_limited(dataset: str) -> Dataset:
    """The first samples of a dataset, from a cache in the working folder, which asv throws away afterwards."""
    return mor_bench.load_dataset(dataset, limit=LIMITS[dataset], cache=Path("cache"), workers=1)


def model_file(dataset: str, method: str) -> Path:
    return Path(f"{dataset}-{method}.safetensors")


def record_file(dataset: str, method: str) -> Path:
    """What `measure` found, or why there is no model."""
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
    """What all measurements share: every method fitted on every dataset by one `setup_cache`, then read back."""

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
    """U-Mesh's query by each of its back ends."""

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
    """Learning from the training part, and the size of what is learned."""

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
    """Against the full-order solutions of the test loads, which share no load region with training."""

    def track_mean_dof_error(self, dataset: str, method: str) -> float:
        """The mean over samples of the mean absolute error per degree of freedom."""
        return float(self.record["mean_dof_m"])

    track_mean_dof_error.unit = "m"  # type: ignore[attr-defined]

    def track_relative_error(self, dataset: str, method: str) -> float:
        """The median over samples of the relative l2 error."""
        return float(self.record["relative"])

    track_relative_error.unit = "relative l2"  # type: ignore[attr-defined]
