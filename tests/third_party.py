"""Methods of third parties: honest ones, broken ones, and ones that search for the test set."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as serialise

import mor_bench
from mor_bench.errors import MorBenchError, NoEquilibriumError, OutOfTimeError, StoreError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.store import write_atomically
from mor_bench.surrogates.fem import FullFEM


class Zero(mor_bench.Surrogate):
    """Predicts no displacement, and can be saved."""

    needs_snapshots = False

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.zeros_like(forces)


class Slowed(FullFEM):
    """The full-order model, followed by a pause in proportion to its time."""

    def __init__(self, tolerance: float = 1e-4, part: float = 0.0) -> None:
        super().__init__(tolerance)
        self.part = part

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        start = time.perf_counter()
        answer = super().predict(forces)
        until = time.perf_counter() + self.part * (time.perf_counter() - start)
        while self.part and time.perf_counter() < until:
            pass
        return answer


class Recorder(mor_bench.Surrogate):
    """Records its inputs, then overwrites them; overrides `fit` and `predict` only."""

    def __init__(self, notes: str, spoil: str = "test") -> None:
        self.notes = notes
        self.spoil = spoil

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Recorder:
        assert snapshots is not None
        content = {
            "regions": snapshots.regions.tolist(),
            "vectors": snapshots.loads.vectors.tolist(),
        }
        Path(self.notes).write_text(json.dumps(content))
        if self.spoil == "train":
            snapshots.free_displacements[:] *= 0.5
        if self.spoil == "exit":
            raise SystemExit(3)
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        array = np.asarray(forces)
        out = np.zeros(array.shape)
        array *= 0.0
        return out


class Plain:
    """Predicts no displacement, knows nothing of mor-bench, and takes several loads only."""

    def __init__(self, factor: float = 0.0) -> None:
        self.factor = factor

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> None:
        assert snapshots is not None

    def predict(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        n, n_nodes, n_axes = forces.shape
        return self.factor * forces.reshape(n, n_nodes * n_axes).reshape(n, n_nodes, n_axes)


class Broken(Zero):
    """Fits, and then misbehaves in a chosen way."""

    def __init__(self, how: str = "crash") -> None:
        self.how = how

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Broken:
        super().fit(scene, snapshots)
        if self.how == "hang":
            time.sleep(3600)
        if self.how == "memory":
            self.hoard_ = [np.ones(20_000_000) for _ in range(20)]
        if self.how == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if self.how == "end":
            os._exit(7)
        if self.how == "orphan":  # a child that would keep the pipe open
            if os.fork() == 0:
                time.sleep(60)
            os._exit(7)
        if self.how == "fork":  # and both go on
            os.fork()
        if self.how == "kill-group":
            os.killpg(0, signal.SIGKILL)
        if self.how == "kill-parent":
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(60)
        if self.how == "odd-text":
            raise RuntimeError("file \udcff")
        if self.how == "in-library":
            np.linalg.inv(np.zeros((1, 1)))
        return self

    def save(self, path: str | Path) -> None:
        if self.how == "save-pipe":
            os.mkfifo(path)
        else:
            super().save(path)

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        batch = np.asarray(forces, dtype=float).reshape(-1, *np.shape(forces)[-2:])
        if self.how == "crash":
            raise ZeroDivisionError("on purpose")
        if self.how == "sometimes" and any(force[:, 0].sum() > 0 for force in batch):
            raise NoEquilibriumError("on purpose")
        if self.how == "shape":
            return batch[:, :-1]
        if self.how == "batches-only" and np.ndim(forces) == 2:
            return None  # type: ignore[return-value]
        if self.how == "worse-alone" and np.ndim(forces) == 2:
            return np.asarray(5.0 * batch[0])
        if self.how == "print":
            print('{"fit_s": 0}', flush=True)
        out = np.full_like(batch, 1e-3)
        if self.how == "nan":
            out[batch[:, :, 0].sum(axis=1) > 0] = np.nan
        return out.reshape(np.shape(forces))


class Vandal(Zero):
    """Tries to write to files and folders, says where it could, and solves with the equations."""

    def __init__(self, paths: list[str]) -> None:
        self.paths = paths

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Vandal:
        super().fit(scene, snapshots)
        for path in self.paths:
            try:
                with open(path, "a") as file:
                    file.write("# spoilt")
            except PermissionError:
                continue
            warnings.warn(f"wrote {path}", stacklevel=1)
        FullFEM().fit(scene).predict(np.zeros((scene.mesh.n_nodes, 3)))
        return self


class Poison(Zero):
    """Overwrites the training samples in place."""

    needs_snapshots = True

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        mapped: Any = samples.free_displacements
        while not isinstance(mapped, np.memmap):
            mapped = mapped.base
        np.load(str(mapped.filename), mmap_mode="r+")[:] = 1.0
        return {}


class Leaky(Zero):
    """Passes the forces of its queries on to its next configuration."""

    def __init__(self, path: str, n: int = 1) -> None:
        self.path = path
        self.n = n

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Leaky:
        if Path(self.path).exists():
            warnings.warn("saw forces of the test set", stacklevel=2)
        super().fit(scene, snapshots)
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        np.save(self.path, np.asarray(forces))
        return super().predict(forces)


class Peeker(Zero):
    """Searches memory and disk for the test set during the fit; warns of every find."""

    def __init__(self, folders: list[str], dataset: str = "beam-tiny") -> None:
        self.folders = folders
        self.dataset = dataset

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Peeker:
        found = [*self._in_memory(snapshots), *self._on_disk()]
        warnings.warn(f"saw {json.dumps(found)}", stacklevel=2)
        super().fit(scene, snapshots)
        return self

    def _in_memory(self, snapshots: Snapshots | None) -> list[str]:
        found = ["dataset" for item in gc.get_objects() if isinstance(item, Dataset)]
        found += [
            "snapshots"
            for item in gc.get_objects()
            if isinstance(item, Snapshots)
            and item is not snapshots
            and item is not self.training.validation
        ]
        if (
            snapshots is not None
            and getattr(snapshots.free_displacements, "base", None) is not None
        ):
            base = snapshots.free_displacements.base
            found += ["base"] if isinstance(base, np.ndarray) and len(base) > len(snapshots) else []
        frame = sys._getframe()
        while frame.f_back:
            frame = frame.f_back
            found += [name for name, value in frame.f_locals.items() if isinstance(value, Dataset)]
        return found

    def _on_disk(self) -> list[str]:
        found = []
        for folder in map(Path, self.folders):
            for way in (self._list, self._open, self._hdf5, self._program, self._load):
                try:
                    found += [f"{way.__name__} {item}" for item in way(folder)[:3]]
                except (OSError, subprocess.SubprocessError, MorBenchError):
                    continue
        return found

    def _list(self, folder: Path) -> list[str]:
        return os.listdir(folder)

    def _open(self, folder: Path) -> list[str]:
        return [path.name for path in folder.rglob("*") if path.is_file() and path.read_bytes()]

    def _hdf5(self, folder: Path) -> list[str]:
        found = []
        for name in _known(folder):
            with h5py.File(name, "r") as file:
                found += list(file)
        return found

    def _program(self, folder: Path) -> list[str]:
        return subprocess.run(
            ["ls", "-R", str(folder)], capture_output=True, text=True, check=True
        ).stdout.split()

    def _load(self, folder: Path) -> list[str]:
        data = mor_bench.load_dataset(self.dataset, cache=folder, workers=1)
        return [f"{len(data.test)} test samples"]


def _known(folder: Path) -> list[str]:
    """Return names that can be guessed from the source, without listing the folder."""
    return [
        line
        for line in os.environ.get("MOR_BENCH_TEST_SHARDS", "").split(os.pathsep)
        if line.startswith(str(folder))
    ]


@dataclass(eq=False)
class Descent(mor_bench.Surrogate):
    """Displacements linear in the sum of the nodal forces, by gradient descent.

    A stopped training resumes from its checkpoint and warns of the iteration. The environment
    variable ``DESCENT_NAP_S`` slows its iterations down.
    """

    iterations: Annotated[int, Field(ge=1)] = 40
    seed: int = 0
    channels: int = 1
    steps: int = 1
    fails: int = -1

    EACH: ClassVar[int] = 10
    """Iterations per point of the loss curve, and between two checkpoints."""

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        if self.seed == self.fails:
            raise OutOfTimeError("all iterations would take 7 h; the limit is 9 s.")
        size = self.channels * self.steps
        if self.time_limit_s is not None and size * 60 > self.time_limit_s:
            raise OutOfTimeError(
                f"all iterations would take {size / 60:.3g} h; "
                f"the limit is {self.time_limit_s:.0f} s."
            )
        forces = samples.forces.sum(axis=1)
        displacements = samples.displacements.reshape(len(samples), -1)
        generator = np.random.default_rng(self.seed)
        weights = 1e-3 * generator.normal(size=(forces.shape[1], displacements.shape[1]))
        losses, first = np.zeros(0), 0
        seconds, checkpoint = self.training.fit_seconds, self.training.checkpoint
        iterations = self.iterations if seconds is None else int(100 * seconds)
        if checkpoint is not None and checkpoint.exists():
            try:
                kept = load_file(checkpoint)
            except SafetensorError as error:
                raise StoreError(f"{checkpoint}: {error}") from None
            weights, losses = kept["weights"], kept["losses"]
            first, iterations = map(int, kept["numbers"])
            warnings.warn(f"goes on from iteration {first} of {iterations}", stacklevel=2)
        rate = 0.5 / np.linalg.norm(forces, 2) ** 2
        for iteration in range(first, iterations):
            off = forces @ weights - displacements
            weights = weights - rate * forces.T @ off
            time.sleep(float(os.environ.get("DESCENT_NAP_S", "0")))
            if (iteration + 1) % self.EACH == 0:
                losses = np.append(losses, np.square(off).mean())
                if checkpoint is not None:
                    numbers = np.array([iteration + 1, iterations])
                    kept = {"weights": weights, "losses": losses, "numbers": numbers}
                    write_atomically(checkpoint, serialise(kept))
                if self.training.progress is not None:
                    self.training.progress(iteration + 1, iterations, float(losses[-1]))
        self.loss_curve_, self.validation_curve_ = losses, 1.5 * losses
        self.iterations_ = iterations
        if checkpoint is not None:
            checkpoint.unlink(missing_ok=True)
        return {"weights": weights}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.weights_ = model["weights"]

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(forces.sum(axis=1) @ self.weights_).reshape(forces.shape)
