"""Surrogates on one thread: the latency of a single query, and the error on the test loads. Fitted once for both."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import mor_bench
from mor_bench.errors import MissingDependencyError
from mor_bench.harness.metrics import sample_errors
from mor_bench.harness.timing import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import list_suite

LIMITS = {"beam-tiny": 210, "beam-coarse": 400}
"""Samples of each dataset: few, so that generating and fitting everything takes seconds."""

METHODS: dict[str, dict[str, Any]] = {
    "fem": {"tolerance": 1e-4},
    "linear-fem": {},
    "pod": {"n_modes": 20},
    "hpod": {"n_modes": 20, "cubature_tolerance": 1e-2},
    "pca-regression": {"n_input_modes": 10},
    "umesh": {"channels": 8, "steps": 2, "iterations": 200, "batch_size": 16, "learning_rate": 3e-3},
}
"""Methods and their knobs. U-Mesh's latency does not depend on how long it was trained; the error of so short a training says little."""


def load_limited(dataset: str) -> Dataset:
    """The first samples of a dataset, from a cache in the working folder, which asv throws away afterwards."""
    return mor_bench.load_dataset(dataset, limit=LIMITS[dataset], cache=Path("cache"), workers=1)


def model_file(dataset: str, method: str) -> Path:
    return Path(f"{dataset}-{method}.safetensors")


class _Fitted:
    """What both measurements share: every method fitted on every dataset by one `setup_cache`, then read back."""

    params = (tuple(LIMITS), tuple(METHODS))
    param_names = ("dataset", "method")
    timeout = 300

    def setup_cache(self) -> None:
        known = list_suite("methods")
        for dataset in LIMITS:
            data = load_limited(dataset)
            for method, knobs in METHODS.items():
                if method not in known:  # a commit from before the method
                    continue
                try:
                    surrogate = mor_bench.load_method(method, **knobs)
                except MissingDependencyError:
                    continue
                with pinned_threads(1):
                    surrogate.fit(data.scene, data.train)
                surrogate.save(model_file(dataset, method))

    def setup(self, dataset: str, method: str) -> None:
        self.pinned = ExitStack()
        path = model_file(dataset, method)
        if not path.exists():
            raise NotImplementedError(f"{method} is not there, or needs an extra that is not installed.")
        self.test = load_limited(dataset).test
        self.surrogate = mor_bench.load_surrogate(path)
        sizes = np.linalg.norm(self.test.loads.vectors, axis=(1, 2))
        self.force = self.test.forces[int(sizes.argsort()[len(sizes) // 2])]
        self.pinned.enter_context(pinned_threads(1))
        self.surrogate.predict(self.force)

    def teardown(self, dataset: str, method: str) -> None:
        self.pinned.close()


class Query(_Fitted):
    """One load at a time, from forces on the host to displacements on the host."""

    def time_predict(self, dataset: str, method: str) -> None:
        self.surrogate.predict(self.force)


class Error(_Fitted):
    """The mean over the test loads, which share no load region with training, of the mean absolute error per dof."""

    unit = "m"

    def track_mean_dof_error(self, dataset: str, method: str) -> float:
        return float(sample_errors(self.surrogate.predict(self.test.forces), self.test.displacements).mean_dof_m.mean())
