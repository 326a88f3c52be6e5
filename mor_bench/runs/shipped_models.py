"""Trained weights that the suite ships: each a safetensors file with a record beside it.

A run uses them instead of a training if the record agrees with the dataset, the split, the method's
parameters and the code that gives the weights their meaning. Samples that another processor
generated differ in the last digits, so they are compared by numbers, not by bits.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from mor_bench.checked_files import read_bytes, read_json
from mor_bench.digests import digest_of_arrays, digest_of_file
from mor_bench.errors import StoreError
from mor_bench.runs.cached_fit import LOAD_LIMIT_S, CachedFit, FitRecord, RunEnvironment
from mor_bench.runs.code_digest import learning_digest
from mor_bench.runs.configurations import Configuration
from mor_bench.runs.training_data import TrainingData
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.generate import dataset_key
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, find_suite
from mor_bench.specs.one_line_errors import validated

FOLDER = "trained"
"""Folder of the suite with shipped weights, beside ``datasets`` and ``methods``."""

SAME_NUMBERS = 1e-5
"""Relative difference of sketches of samples that another processor's rounding may cause."""


class Binding(BaseModel):
    """The inputs of a training that are known before its samples.

    Attributes
    ----------
    surrogate : str
        The class, ``package.module:Class``.
    parameters : dict
        Parameters of the configuration that the weights stand for.
    dataset : str
        Key of the generated dataset, with the settings of its scene that methods see.
    split : dict
        The split's settings.
    code : str
        Digest of the code that trained the weights, see
        `mor_bench.runs.code_digest.learning_digest`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    surrogate: str
    parameters: dict[str, Any]
    dataset: str
    split: dict[str, Any]
    code: str

    @classmethod
    def of(
        cls, configuration: Configuration, spec: DatasetSpec, split: str | None = None
    ) -> Binding:
        """Describe a configuration on a dataset; `split` replaces the one in the file."""
        seen: list[Any] = [
            spec.needs.model_dump(mode="json", include={"outputs"}),
            spec.grid_nodes,
            spec.observed and spec.observed.model_dump(mode="json"),
        ]
        scene = hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()[:12]
        return cls(
            surrogate=configuration.method.surrogate,
            parameters=configuration.parameters,
            dataset=f"{dataset_key(spec)}-{scene}",
            split={**spec.split.model_dump(mode="json"), "by": split or spec.split.by},
            code=learning_digest(configuration.method.surrogate),
        )


class SampleSketch(BaseModel):
    """Samples as a few numbers.

    Attributes
    ----------
    n : int
    regions : str
        SHA-256 of the load regions of all samples.
    sums : list of float
        Sums of squares and weighted sums of all forces, N, and displacements, m.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    n: int
    regions: str
    sums: list[float]

    @classmethod
    def of(cls, samples: Snapshots) -> SampleSketch:
        """Sketch samples."""
        regions = digest_of_arrays({"regions": samples.loads.patches})
        sums = [*_sums(samples.forces), *_sums(samples.displacements)]
        return cls(n=len(samples), regions=regions, sums=sums)

    def agrees(self, other: SampleSketch) -> bool:
        """Return whether two sketches are of the same samples, up to rounding."""
        same = (self.n, self.regions) == (other.n, other.regions)
        return same and np.allclose(self.sums, other.sums, rtol=SAME_NUMBERS, atol=0.0)


def _sums(values: NDArray[np.float64]) -> list[float]:
    """Return the sum of squares, and the sum of magnitudes weighted by their positions."""
    flat = np.abs(values).ravel()
    return [float(flat @ flat), float(flat @ (1.5 + np.cos(np.arange(flat.size))))]


class ShippedModel(BaseModel):
    """The record beside shipped weights.

    Attributes
    ----------
    binding : Binding
    train, validation : SampleSketch
    fit : FitRecord
        Cost and results of the training, with its origin and the weights' checksum.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    binding: Binding
    train: SampleSketch
    validation: SampleSketch
    fit: FitRecord

    @classmethod
    def of(cls, binding: Binding, data: TrainingData, fit: FitRecord) -> ShippedModel:
        """Describe weights that were trained on these samples."""
        train, validation = SampleSketch.of(data.train), SampleSketch.of(data.validation)
        return cls(binding=binding, train=train, validation=validation, fit=fit)

    def agrees_with(self, data: TrainingData) -> bool:
        """Return whether the weights were trained on these samples."""
        sketches = SampleSketch.of(data.train), SampleSketch.of(data.validation)
        return self.train.agrees(sketches[0]) and self.validation.agrees(sketches[1])

    def write(self, weights: Path, stem: Path) -> None:
        """Write weights and record as ``STEM.safetensors`` and ``STEM.json``, the record last."""
        write_atomically(stem.with_suffix(".safetensors"), weights.read_bytes())
        text = self.model_dump_json(indent=1, exclude_none=True) + "\n"
        write_atomically(stem.with_suffix(".json"), text.encode())


def shipped_models(folder: Path | None = None) -> dict[Path, ShippedModel]:
    """Return the weights' files and records in a folder, by default the suite's.

    Raises
    ------
    StoreError
        If a record is damaged.
    """
    folder = folder or find_suite() / FOLDER
    found = {}
    for path in sorted(folder.glob("*.json")):
        record = validated(ShippedModel, read_json(path), str(path), error=StoreError)
        found[path.with_suffix(".safetensors")] = record
    return found


def find_shipped(
    configuration: Configuration, spec: AnyDatasetSpec, split: str | None
) -> tuple[Path, ShippedModel] | None:
    """Return shipped weights for a configuration on a dataset; None if there are none.

    `ShippedModel.agrees_with` checks the samples. Errors as in `shipped_models`.
    """
    if configuration.method.folder is not None or not isinstance(spec, DatasetSpec):
        return None
    models = shipped_models()
    if not any(m.binding.surrogate == configuration.method.surrogate for m in models.values()):
        return None
    binding = Binding.of(configuration, spec, split)
    return next((item for item in models.items() if item[1].binding == binding), None)


def check_weights(weights: Path, shipped: ShippedModel) -> None:
    """Raise `StoreError` unless weights are readable and those of their record."""
    checksum = shipped.fit.model_sha256
    try:
        intact = checksum is not None and digest_of_file(weights) == checksum
    except OSError as error:
        raise StoreError(f"{weights}: cannot be read: {error.strerror}.") from None
    if not intact:
        raise StoreError(f"{weights}: the checksum differs from the one in its record.")


def adopt(
    weights: Path,
    shipped: ShippedModel,
    configuration: Configuration,
    data: TrainingData,
    environment: RunEnvironment,
) -> CachedFit:
    """Put shipped weights into the cache as the fit of a configuration.

    A sandboxed process loads them first, so that damaged weights are not kept.

    Raises
    ------
    StoreError
        If the weights are damaged, or are not those of the record.
    MorBenchError
        If they cannot be loaded.
    """
    check_weights(weights, shipped)
    checksum = shipped.fit.model_sha256
    iterations = {"iterations": shipped.fit.parameters["iterations"]}
    parameters = {**configuration.parameters, **iterations}
    chosen = replace(configuration, parameters=parameters, shipped=checksum)
    cached = CachedFit(chosen, data, environment)
    if cached.record is None:
        worker = cached.worker()
        try:
            surrogate = configuration.method.surrogate
            worker.ask("load", LOAD_LIMIT_S, surrogate=surrogate, model=weights)
            cached.keep(shipped.fit, read_bytes(weights))
        except BaseException:
            worker.end()
            raise
        cached.hold(worker)
    return cached
