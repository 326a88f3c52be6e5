"""Training and validation samples in files for the methods' processes, and test sets in memory."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.digests import digest_of_arrays, digest_of_file
from mor_bench.errors import StoreError
from mor_bench.measure.reaction_errors import ReactionErrors
from mor_bench.measure.stress_errors import StressErrors
from mor_bench.mechanics.indicator import ErrorIndicator
from mor_bench.sandbox.handover import arrays_of, write_snapshots
from mor_bench.sandbox.process import MethodFailedError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots


@dataclass(frozen=True)
class TestSet:
    """Queries and reference displacements; the references stay in the parent process.

    Attributes
    ----------
    forces, references : (n, n_nodes, 3) float64
        Nodal forces, N, and reference displacements, m. In a scene with observed nodes, `forces`
        holds the observed displacements, m.
    nodes : (n_output_nodes,) int64
        Nodes where the error is measured.
    fixed_nodes : (n_fixed,) int64
        Nodes of the supports.
    digest : str
        SHA-256 of all arrays.
    parameters : (n, n_parameters) float64, optional
        Sampled parameters of a parametric scene.
    """

    forces: NDArray[np.float64]
    references: NDArray[np.float64]
    nodes: NDArray[np.int64]
    fixed_nodes: NDArray[np.int64]
    digest: str
    parameters: NDArray[np.float64] | None = None

    def queries(self, chosen: NDArray[np.int64] | slice) -> dict[str, NDArray[np.float64] | None]:
        """Return the arguments of a request for some samples: their forces and parameters."""
        parameters = None if self.parameters is None else self.parameters[chosen]
        return {"forces": self.forces[chosen], "parameters": parameters}

    @classmethod
    def of(cls, snapshots: Snapshots) -> TestSet:
        """Make a test set from snapshots."""
        nodes, fixed_nodes = snapshots.scene.output_nodes, snapshots.scene.fixed_nodes
        arrays: dict[str, NDArray[Any]] = {
            "f": snapshots.given.values,
            "u": snapshots.displacements,
        }
        if len(nodes) < snapshots.scene.mesh.n_nodes:
            arrays["nodes"] = nodes
        parameters = snapshots.parameters if snapshots.scene.parameter_names else None
        if parameters is not None:
            arrays["p"] = parameters
        digest, loads = digest_of_arrays(arrays), snapshots.given.values
        return cls(loads, snapshots.displacements, nodes, fixed_nodes, digest, parameters)


class TrainingData:
    """Samples to learn from, as files for the methods' processes, and the test sets to score on.

    Parameters
    ----------
    scene : Scene
    train, validation : Snapshots
        Only trainings get the validation samples, to stop early.
    sets : dict of str to TestSet
        The main test set is ``test``. If there are validation samples, ``validation`` holds them.
    scratch : Path
        An existing folder that every method's process may write to.
    """

    def __init__(
        self,
        scene: Scene,
        train: Snapshots,
        validation: Snapshots,
        sets: Mapping[str, TestSet],
        scratch: Path,
    ) -> None:
        self.scene, self.scratch, self.sets = scene, scratch, dict(sets)
        self.train, self.validation = train, validation
        folder = Path(tempfile.mkdtemp(dir=scratch))
        self.folder, self.validation_folder = folder / "train", folder / "validation"
        self._write()
        self._written = self._file_digests()

    @classmethod
    def of(cls, data: Dataset, scratch: Path) -> TrainingData:
        """Take the samples of a dataset, with all its test sets."""
        held = {"validation": data.validation} if len(data.validation) else {}
        sets = {"test": data.test, **held, **data.tests}
        tests = {name: TestSet.of(snapshots) for name, snapshots in sets.items()}
        return cls(data.scene, data.train, data.validation, tests, scratch)

    def _write(self) -> None:
        write_snapshots(self.folder, self.train)
        write_snapshots(self.validation_folder, self.validation)

    @property
    def n_train(self) -> int:
        """Number of training samples."""
        return len(self.train)

    def _file_digests(self) -> dict[str, str]:
        folders = (self.folder, self.validation_folder)
        return {str(path): digest_of_file(path) for folder in folders for path in folder.iterdir()}

    def check_unchanged(self) -> None:
        """Raise `MethodFailedError` and restore the samples if a method changed them."""
        try:
            unchanged = self._file_digests() == self._written
        except (OSError, StoreError):
            unchanged = False
        if not unchanged:
            for folder in (self.folder, self.validation_folder):
                shutil.rmtree(folder, ignore_errors=True)
            self._write()
            raise MethodFailedError("the method overwrote the training samples")

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the training samples and the scene."""
        spec = self.scene.spec
        extra: list[dict[str, Any]] = []
        if spec.needs.outputs != "all":
            extra.append(spec.needs.model_dump(mode="json", include={"outputs"}))
        if self.scene.observed_nodes is not None:
            extra.append({"observed": self.scene.observed_nodes.tolist()})
        scene = json.dumps([spec.physics(), spec.grid_nodes, *extra], sort_keys=True)
        return digest_of_arrays(arrays_of(self.train)) + hashlib.sha256(scene.encode()).hexdigest()

    @cached_property
    def validation_digest(self) -> str:
        """SHA-256 of the validation samples."""
        return digest_of_arrays(arrays_of(self.validation))

    @cached_property
    def indicator(self) -> ErrorIndicator | None:
        """Error indicator; None if equations, forces or some nodes' displacements are unknown.

        There is none for bodies with sampled parameters.
        """
        known = self.scene.material is not None and self.scene.observed_nodes is None
        known = known and not self.scene.parameter_names
        if not known or len(self.scene.output_nodes) < self.scene.mesh.n_nodes:
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # methods repeat the scene's warnings
            return ErrorIndicator(self.scene)

    @cached_property
    def reaction_errors(self) -> ReactionErrors | None:
        """Errors of a tool's reaction; None without a tool, or if only some nodes are wanted."""
        whole = len(self.scene.output_nodes) == self.scene.mesh.n_nodes
        tool = self.scene.motion or self.scene.contact
        return ReactionErrors(self.scene) if tool and whole else None

    @cached_property
    def stress_errors(self) -> StressErrors | None:
        """Errors of the stresses; None if the dataset does not ask for them."""
        return StressErrors(self.scene) if self.scene.spec.needs.stress else None

    def derived_errors(
        self,
        predicted: NDArray[np.float64],
        references: NDArray[np.float64],
        parameters: NDArray[np.float64] | None = None,
    ) -> dict[str, NDArray[np.float64]]:
        """Return relative errors (n,) of what follows from displacements (n, n_nodes, 3).

        Bodies with sampled parameters need these, (n, n_parameters).
        """
        found = {}
        if self.reaction_errors:
            found["reaction_relative"] = self.reaction_errors(predicted, references, parameters)
        if self.stress_errors:
            names = "stress_relative", "peak_stress_relative", "peak_tension_relative"
            found |= zip(names, self.stress_errors(predicted, references), strict=True)
        return found

    def first(self, n: int) -> TrainingData:
        """Return the same data with only the first training samples and the main test set."""
        sets = {"test": self.sets["test"]}
        return TrainingData(self.scene, self.train[:n], self.validation, sets, self.scratch)

    def with_sets(self, sets: Mapping[str, TestSet]) -> TrainingData:
        """Return the same training samples with other test sets."""
        other = copy(self)
        other.sets = dict(sets)
        return other
