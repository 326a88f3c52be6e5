"""The interface that every method implements, and how methods are made by name, saved and loaded."""

from __future__ import annotations

import hashlib
import inspect
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import (
    InvalidInputError,
    MorBenchError,
    NotFittedError,
    StoreError,
    UnknownRangeError,
    UnsupportedSceneError,
)
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import NO_FORCES, check_parameters, list_suite, load_class, load_method_spec

if TYPE_CHECKING:
    import onnx

    from mor_bench.mechanics.indicator import ErrorIndicator, Indication

SCHEMA_VERSION = 1

MAX_FORCE_N = 1e30
"""Largest nodal force component; its cube must not overflow."""

RANGE = "range."
"""Beginning of the names of the arrays that hold the range of the training loads; `_state` has none such."""

SIZE = "size."
"""Beginning of the names of the arrays that hold the values chosen for knobs set to "auto"; `_state` has none such."""


Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class TrainingOptions:
    """How a method that trains does so; methods that do not train ignore it.

    These are no knobs: a model's file does not hold them, and `predict` does not depend on them but through what was learned.

    Attributes
    ----------
    device : str
        Where the training computes; "auto" is a CUDA device if there is one.
    fit_seconds : float or None
        Seconds that the training is to fill: the number of iterations is chosen after the first ones and reported as ``iterations_``;
        the knob ``iterations`` with that number gives the same model again. None: as many as the knob says.
    checkpoint : Path or None
        File that the training is written to now and then. If it is there at the start, the training goes on from it and ends with
        the same bits as one that was never stopped. It is written at the end too, and whoever has kept the model deletes it, as
        `mor_bench.fit` and `mor_bench.run` do: what `fit` does after the training, and `save`, may be stopped as well.
    start_from : Path or None
        A model of the same class and `Surrogate.architecture`, saved by `Surrogate.save`, whose weights the training starts from.
    progress : callable or None
        Called now and then with the iterations done, all, and the loss.
    """

    device: Device = "cpu"
    fit_seconds: float | None = None
    checkpoint: Path | None = None
    start_from: Path | None = None
    progress: Callable[[int, int, float], None] | None = None


TIMING = "timing."
"""Beginning of the names of the arrays that hold times measured in a fit; `_state` has none such."""


def size_arrays(sizes: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """Values chosen for knobs, as arrays that a file can hold: words as the bytes of their letters."""
    return {
        SIZE + name: np.frombuffer(value.encode(), np.uint8)
        if isinstance(value, str)
        else np.array([value])
        for name, value in sizes.items()
    }


def take_sizes(state: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """The values that `size_arrays` wrote, which are taken out of a model's arrays."""
    found = {
        name.removeprefix(SIZE): state.pop(name) for name in list(state) if name.startswith(SIZE)
    }
    return {
        name: array.tobytes().decode() if array.dtype == np.uint8 else array.item()
        for name, array in found.items()
    }


class Surrogate(ABC):
    """A map from nodal forces to nodal displacements of one scene.

    In a scene with observed nodes, `Scene.observed_nodes`, the displacements of these, m, stand everywhere in the place of the
    forces: what other nodes hold is not looked at, and may be NaN. Only a class with `takes_observations` is given such a scene.

    A subclass stores its knobs in ``__init__`` under their own names and nothing else, annotates them (pydantic `Field`
    constraints give their range), fits inside ``with self._fitting(scene)``, takes its samples from `_checked_snapshots`, and
    begins `predict` with `_checked_forces`.
    What it learns ends in an underscore.
    """

    scene_: Scene
    range_: LoadRange
    _indicator: tuple[Scene, ErrorIndicator]
    sizes_: dict[str, Any]
    """Values chosen for the knobs set to "auto"; missing where there are none."""

    timings_ms_: dict[str, float]
    """Times by which the fit chose between ways to the same answer, where it did; they hold on the machine of the fit."""

    needs_snapshots: ClassVar[bool] = True
    """Whether `fit` learns from snapshots; their cost is charged only to methods that do."""

    takes_observations: ClassVar[bool] = False
    """Whether it can be given displacements of a part of the surface in the place of forces, by `Snapshots.inputs`."""

    architecture: ClassVar[tuple[str, ...]] = ()
    """Knobs that decide names, shapes or meaning of the weights: a training starts only from a model that has the same."""

    time_limit_s: float | None = None
    """Seconds that a comparison leaves to `fit`; a method that sees early that they will not do raises `OutOfTimeError`."""

    training: TrainingOptions = TrainingOptions()
    """Device, seconds, checkpoint and starting weights of a training; set before `fit`, and no knob."""

    @abstractmethod
    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        """Learn from snapshots, forgetting earlier fits.

        Parameters
        ----------
        scene : Scene
        snapshots : Snapshots or None
            Training samples; None for methods that need none.

        Returns
        -------
        self
        """

    @abstractmethod
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        """Displacements under nodal forces.

        Parameters
        ----------
        forces : (n_nodes, 3) or (n, n_nodes, 3)
            Nodal forces, N; in a scene with observed nodes, displacements of these, m.

        Returns
        -------
        array of the same shape, float64
            Nodal displacements, m, on the host. Nodes that the scene's ``needs.outputs`` leaves out may hold NaN.

        Raises
        ------
        InvalidInputError
            On a wrong shape or dtype, NaN or infinity.
        NotFittedError
            Before `fit`.
        SolverError
            If a method that solves equations finds no valid equilibrium.
        """

    @classmethod
    def trains(cls) -> bool:
        """Whether `fit` heeds `training`. A method that does has the knobs ``iterations`` and ``seed``."""
        return {"iterations", "seed"} <= inspect.signature(cls.__init__).parameters.keys()

    def supports(self, scene: Scene) -> str | None:
        """None, or the reason why the method cannot handle a scene."""
        return self._needs_forces(scene)

    def _needs_forces(self, scene: Scene) -> str | None:
        """The reason why a method that is given forces cannot handle a scene where they are not known."""
        return None if self.takes_observations or scene.observed_nodes is None else NO_FORCES

    def out_of_range(self, forces: ArrayLike) -> NDArray[np.bool_]:
        """Which loads lie out of the range of the training loads.

        A flag says that training held nothing like the load, see `mor_bench.snapshots.load_range`; it is no bound on the
        error. A method that needs no snapshots has no such range and flags nothing.

        Parameters
        ----------
        forces : (n_nodes, 3) or (n, n_nodes, 3)
            Nodal forces, N.

        Returns
        -------
        bool array of shape () or (n,)

        Raises
        ------
        InvalidInputError
            On a wrong shape or dtype, NaN or infinity.
        NotFittedError
            Before `fit`.
        UnknownRangeError
            If the method learns but its range is not known: its `fit` does not check its snapshots by `_checked_snapshots`,
            or it was loaded from a file that was written before ranges were; and where it is given displacements, not loads.
        """
        batch = self._checked_forces(forces)
        if not self.needs_snapshots:
            flags = np.zeros(len(batch), dtype=bool)
        elif hasattr(self, "range_"):
            flags = self.range_.excludes(batch)
        elif self.scene_.observed_nodes is not None:
            raise UnknownRangeError(
                f"{self.scene_.name}: which loads are like those of training cannot be told: {NO_FORCES}."
            )
        else:
            raise UnknownRangeError(
                f"the loads that this {type(self).__name__} was trained on are not known: its `fit` does not check them by `_checked_snapshots`, "
                "or its file is of an older version; then fit it again."
            )
        return flags.reshape(np.shape(forces)[:-2])

    def indicate_error(self, forces: ArrayLike, displacements: ArrayLike) -> Indication:
        """Indicate how wrong predictions are, by what they leave of the equations; see `mor_bench.mechanics.indicator`.

        Parameters
        ----------
        forces, displacements : (n_nodes, 3) or (n, n_nodes, 3)
            Loads, N, and what `predict` answered, m, at all nodes.

        Returns
        -------
        Indication
            With arrays of shape (1,) or (n,).

        Raises
        ------
        InvalidInputError
            On a wrong shape or dtype, forces that are not finite, or displacements that are only there where outputs are wanted.
        NotFittedError
            Before `fit`.
        UnsupportedSceneError
            If the scene's equations, or the forces, are not known.
        """
        from mor_bench.mechanics.indicator import ErrorIndicator

        batch = self._checked_forces(forces)
        if self.scene_.observed_nodes is not None:
            raise UnsupportedSceneError(
                f"{self.scene_.name}: no error can be indicated, for {NO_FORCES}."
            )
        predicted = np.asarray(displacements)
        if predicted.dtype.kind != "f" or predicted.shape != np.shape(forces):
            raise InvalidInputError(
                f"`displacements` must be floats of shape {np.shape(forces)}; got {predicted.dtype} of shape {predicted.shape}."
            )
        predicted = predicted.reshape(batch.shape).astype(np.float64, copy=False)
        left_out = np.delete(predicted, self.scene_.output_nodes, axis=1)
        if np.isnan(left_out).any():
            raise InvalidInputError(
                "`displacements` must be given at all nodes; those that `needs.outputs` leaves out hold NaN."
            )
        if not hasattr(self, "_indicator") or self._indicator[0] is not self.scene_:
            self._indicator = self.scene_, ErrorIndicator(self.scene_)
        return self._indicator[1](batch, predicted)

    @property
    def parameters(self) -> dict[str, Any]:
        """The knobs and their values."""
        if type(self).__init__ is object.__init__:
            return {}
        return {
            name: getattr(self, name)
            for name in list(inspect.signature(type(self).__init__).parameters)[1:]
        }

    def save(self, path: str | Path) -> None:
        """Write the fitted model to one safetensors file: arrays, and a JSON header with class, knobs and scene.

        Raises
        ------
        NotFittedError
            Before `fit`.
        """
        from safetensors.numpy import save as serialise

        if not hasattr(self, "scene_"):
            raise NotFittedError(f"{type(self).__name__} must be fitted before it is saved.")
        header = {
            "format": "mor-bench surrogate",
            "schema_version": str(SCHEMA_VERSION),
            "surrogate": f"{type(self).__module__}:{type(self).__qualname__}",
            "parameters": json.dumps(self.parameters),
            "scene": self.scene_.spec.model_dump_json(),
        }
        known = (
            {RANGE + name: array for name, array in self.range_.arrays().items()}
            if hasattr(self, "range_")
            else {}
        )
        sizes = size_arrays(getattr(self, "sizes_", {}))
        timings = {
            TIMING + name: np.array([value])
            for name, value in getattr(self, "timings_ms_", {}).items()
        }
        arrays = {
            name: np.ascontiguousarray(array)
            for name, array in {**self._state(), **known, **sizes, **timings}.items()
        }
        header["sha256"] = _digest(header, arrays)
        write_atomically(Path(path), _in_order(serialise(arrays, metadata=header)))

    def _state(self) -> dict[str, NDArray[Any]]:
        """The arrays that make up a fitted model."""
        raise MorBenchError(f"{type(self).__name__} does not support saving.")

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Become fitted from the arrays of `_state`; ``scene_`` is already set."""
        raise MorBenchError(f"{type(self).__name__} does not support loading.")

    def _onnx_model(self) -> onnx.ModelProto:
        """The fitted map as an ONNX graph from `forces` to `displacements`, (n, n_nodes, 3) float32 each; see `export_onnx`."""
        raise MorBenchError(f"{type(self).__name__} has no network that could be written as ONNX.")

    def _sized(self, name: str) -> Any:
        """The value of a knob, or what was chosen for it if it is set to "auto"."""
        value = getattr(self, "sizes_", {}).get(name, getattr(self, name))
        if value == "auto":
            raise InvalidInputError(f"no value was chosen for `{name}`.")
        return value

    @contextmanager
    def _fitting(self, scene: Scene) -> Iterator[None]:
        """Check the knobs and the scene, forget an earlier fit, and stay unfitted if the body fails."""
        check_parameters(type(self), self.parameters)
        reason = self.supports(scene) or self._needs_forces(scene)
        if reason is not None:
            raise UnsupportedSceneError(
                f"{type(self).__name__} cannot handle {scene.name}: {reason}"
            )
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)
        self.scene_ = scene
        try:
            yield
        except BaseException:
            del self.scene_
            raise

    def _checked_snapshots(self, snapshots: Snapshots | None) -> Snapshots:
        """The training samples, which this method cannot do without; the range of their loads is remembered."""
        if snapshots is None or len(snapshots) == 0:
            raise InvalidInputError(
                f"{type(self).__name__} needs at least one training sample; got none."
            )
        displacements, vectors = snapshots.free_displacements, snapshots.loads.vectors
        shape = (len(snapshots), len(self.scene_.free_dofs))
        if displacements.shape != shape or not {
            displacements.dtype.kind,
            vectors.dtype.kind,
        } <= set("fiu"):
            raise InvalidInputError(
                f"the training samples must be real numbers, displacements of shape {shape}; got {displacements.dtype} of shape "
                f"{displacements.shape} and forces in {vectors.dtype}."
            )
        if not np.isfinite(displacements).all() or not np.isfinite(vectors).all():
            raise InvalidInputError("the training snapshots hold NaN or infinity.")
        if not displacements.any() or not vectors.any():
            raise InvalidInputError(
                "the training snapshots are all zero: nothing can be learned from them."
            )
        if self.scene_.observed_nodes is None:
            self.range_ = LoadRange.of(snapshots)
        return snapshots

    def _checked_forces(self, forces: ArrayLike) -> NDArray[np.float64]:
        """Forces, or displacements of observed nodes and zeros elsewhere, as (n, n_nodes, 3) float64; the first line of every `predict`."""
        if not hasattr(self, "scene_"):
            raise NotFittedError(f"{type(self).__name__} must be fitted before it predicts.")
        try:
            array = np.asarray(forces)
        except (ValueError, TypeError) as error:
            raise InvalidInputError(f"`forces` must be an array of real numbers: {error}") from None
        n_nodes = self.scene_.mesh.n_nodes
        if array.dtype.kind not in "fiu":
            raise InvalidInputError(f"`forces` must hold real numbers; got dtype {array.dtype}.")
        if array.ndim not in (2, 3) or array.shape[-2:] != (n_nodes, 3):
            raise InvalidInputError(
                f"`forces` must have shape ({n_nodes}, 3) or (n, {n_nodes}, 3); got {array.shape}."
            )
        observed, unit = self.scene_.observed_nodes, "N"
        if observed is not None:
            seen, unit = np.zeros(array.shape, dtype=array.dtype), "m at the observed nodes"
            seen[..., observed, :] = array[..., observed, :]
            array = seen
        if not (np.abs(array) <= MAX_FORCE_N).all():
            raise InvalidInputError(
                f"`forces` must be finite and at most {MAX_FORCE_N:g} {unit}; got {np.abs(array).max():g}."
            )
        return array.astype(np.float64, copy=False).reshape(-1, n_nodes, 3)


def _in_order(content: bytes) -> bytes:
    """A safetensors file with its metadata sorted: safetensors writes them in an order that changes from call to call."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the arrays stay aligned
    return len(text).to_bytes(8, "little") + text + content[end:]


def _digest(header: dict[str, str], arrays: dict[str, NDArray[Any]]) -> str:
    """SHA-256 of all that a surrogate's file holds."""
    digest = hashlib.sha256(
        json.dumps({key: header[key] for key in sorted(header) if key != "sha256"}).encode()
    )
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def load_method(source: str | Path, **parameters: Any) -> Surrogate:
    """Make an unfitted method.

    Parameters
    ----------
    source : str or Path
        A name in ``methods/``, or the path of a TOML.
    **parameters
        Replace the file's parameters.

    Raises
    ------
    SpecError
        If the method is unknown, or a parameter is unknown, of the wrong type or out of range.
    MissingDependencyError
        If the method needs an extra that is not installed.
    """
    spec = load_method_spec(source)
    surrogate = spec.load_class()
    return make_surrogate(surrogate, {**spec.parameters, **parameters})


def make_surrogate(surrogate: type[Any], parameters: dict[str, Any]) -> Surrogate:
    """Check the knobs and construct."""
    if not issubclass(surrogate, Surrogate):
        raise MorBenchError(
            f"{surrogate.__module__}:{surrogate.__name__} is not a subclass of mor_bench.Surrogate."
        )
    return surrogate(**check_parameters(surrogate, parameters))


def load_surrogate(path: str | Path) -> Surrogate:
    """Read a fitted model written by `Surrogate.save`.

    Only a class that a method of the suite names is ever imported: a file cannot make this run code of its own.

    Raises
    ------
    StoreError
        If the file is missing, damaged, foreign or of a newer schema, or names a class that no method names.
    """
    header, state = _read_model(path)
    known = {load_method_spec(file).surrogate for file in list_suite("methods").values()}
    if header.get("surrogate") not in known:
        raise StoreError(
            f"{path}: class {header.get('surrogate')!r} is not named by any method of the suite."
        )
    return _fitted(path, load_class(header["surrogate"]), None, header, state)


def load_fitted(path: str | Path, surrogate: type[Any], scene: Scene) -> Surrogate:
    """Read a fitted model of a class and a scene that are at hand; otherwise as `load_surrogate`."""
    header, state = _read_model(path)
    expected = f"{surrogate.__module__}:{surrogate.__qualname__}"
    if header.get("surrogate") != expected:
        raise StoreError(
            f"{path}: a model of class {header.get('surrogate')!r}; expected {expected!r}."
        )
    return _fitted(path, surrogate, scene, header, state)


def weights_to_start_from(path: str | Path, method: Surrogate) -> dict[str, NDArray[Any]]:
    """The arrays of a saved model of a method's class and architecture, on whatever scene it was trained; see `fitting_arrays`.

    Raises
    ------
    StoreError
        If the file is missing, damaged or of a newer schema.
    InvalidInputError
        If it is of another class or architecture.
    """
    header, state = _read_model(path)
    surrogate = type(method)
    expected = f"{surrogate.__module__}:{surrogate.__qualname__}"
    if header.get("surrogate") != expected:
        raise InvalidInputError(
            f"{path}: `start_from` must be a model of class {expected!r}; got one of {header.get('surrogate')!r}."
        )
    try:
        saved = check_parameters(surrogate, json.loads(header["parameters"]))
    except (MorBenchError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{path}: its knobs are not those of a {surrogate.__qualname__}: {error}"
        ) from None
    unlike = [name for name in surrogate.architecture if saved[name] != method.parameters[name]]
    if unlike:
        wanted, got = (
            ", ".join(f"`{name}` {knobs[name]!r}" for name in unlike)
            for knobs in (method.parameters, saved)
        )
        raise InvalidInputError(
            f"{path}: `start_from` must be a model with {wanted}; got one with {got}."
        )
    return state


def fitting_arrays(
    path: str | Path,
    state: Mapping[str, NDArray[Any]],
    shapes: Mapping[str, tuple[int | None, ...]],
    dtype: type[np.floating[Any]],
) -> dict[str, NDArray[Any]]:
    """Of the arrays of `weights_to_start_from` those of these names, which must be finite and of these shapes; None is any length but 0.

    Raises
    ------
    StoreError
        If one is missing, of another dtype, or not finite.
    InvalidInputError
        If one is of another shape.
    """
    for name, shape in shapes.items():
        if name not in state or state[name].dtype != dtype:
            got = f"got {state[name].dtype}" if name in state else "it is missing"
            raise StoreError(f"{path}: `{name}` must be {np.dtype(dtype)}; {got}.")
        array, wanted = (
            state[name],
            ", ".join("at least 1" if length is None else str(length) for length in shape),
        )
        if (
            array.ndim != len(shape)
            or 0 in array.shape
            or any(length not in (None, n) for n, length in zip(array.shape, shape, strict=True))
        ):
            raise InvalidInputError(
                f"{path}: to start from it here, `{name}` must be of shape ({wanted}); got {array.shape}."
            )
        if not np.isfinite(array).all():
            raise StoreError(f"{path}: `{name}` holds NaN or infinity.")
    return {name: state[name] for name in shapes}


def _read_model(path: str | Path) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Header and arrays of a model's file, checked."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            header = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (
        SafetensorError,
        OSError,
        ValueError,
        AttributeError,
        TypeError,
    ) as error:  # the last ones of a dtype that NumPy has not
        raise StoreError(f"{path}: not a readable safetensors file: {error}") from None
    if header.get("format") != "mor-bench surrogate":
        raise StoreError(f"{path}: not a surrogate of mor-bench.")
    if header.get("schema_version") != str(SCHEMA_VERSION):
        raise StoreError(
            f"{path}: schema version {header.get('schema_version')}; this version of mor-bench reads version {SCHEMA_VERSION}."
        )
    if header.get("sha256") != _digest(header, state):
        raise StoreError(f"{path}: damaged: the checksum does not match.")
    return header, state


def _fitted(
    path: str | Path,
    surrogate: type[Any],
    scene: Scene | None,
    header: dict[str, str],
    state: dict[str, NDArray[Any]],
) -> Surrogate:
    """The model that a file's content makes; without a scene at hand, of the scene in its header."""
    try:
        method = make_surrogate(surrogate, json.loads(header["parameters"]))
        method.scene_ = scene or load_scene(json.loads(header["scene"]))
        ranges = {
            name.removeprefix(RANGE): state.pop(name)
            for name in list(state)
            if name.startswith(RANGE)
        }
        sizes = take_sizes(state)
        timings = {
            name.removeprefix(TIMING): state.pop(name).item()
            for name in list(state)
            if name.startswith(TIMING)
        }
        if not all(isinstance(value, float) and value > 0 for value in timings.values()):
            raise InvalidInputError(f"its times must be positive numbers; got {timings}.")
        if timings:
            method.timings_ms_ = timings
        if any(method.parameters.get(name) != "auto" for name in sizes):
            raise InvalidInputError(
                f"it holds values for {', '.join(sorted(sizes))}, of which not all are to be chosen."
            )
        if sizes:
            check_parameters(surrogate, {**method.parameters, **sizes})
            method.sizes_ = sizes
        method._restore(state)
        if ranges:
            method.range_ = LoadRange.from_arrays(ranges, method.scene_.mesh.n_nodes)
    except (
        MorBenchError,
        ArithmeticError,
        KeyError,
        ValueError,
        IndexError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise StoreError(
            f"{path}: its content does not make a {header['surrogate'].partition(':')[2]}: {error}"
        ) from None
    return method
