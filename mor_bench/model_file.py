"""The file of a fitted model: safetensors arrays, and a JSON header with class and scene."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.checked_files import check_file, parse_json
from mor_bench.digests import digest_of_arrays
from mor_bench.errors import InvalidInputError, MorBenchError, StoreError
from mor_bench.model_arrays import has_shape
from mor_bench.snapshots.store import check_replaceable, write_atomically
from mor_bench.specs import check_parameters

FORMAT = "mor-bench surrogate"
SCHEMA_VERSION = 1

RANGE, SIZE, TIMING = "range.", "size.", "timing."
"""Prefixes of array names: range of the training loads, chosen values, measured times."""

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class StoredModel:
    """Content of a model file.

    Attributes
    ----------
    surrogate : str
        Class, as ``module:Class``.
    parameters, scene : str
        Hyperparameters and the dataset's file, as JSON.
    arrays : dict of str to array
        The arrays from `Surrogate.learn`.
    load_range : dict of str to array
        Range of the training loads, as `LoadRange.arrays`; empty if unknown.
    sizes : dict of str to Any
        Values chosen for hyperparameters set to "auto".
    timings_ms : dict of str to float
        Times, ms, by which the fit chose between equivalent ways to predict.
    """

    surrogate: str
    parameters: str
    scene: str
    arrays: Arrays
    load_range: Arrays = field(default_factory=dict)
    sizes: dict[str, Any] = field(default_factory=dict)
    timings_ms: dict[str, float] = field(default_factory=dict)


class Startable(Protocol):
    """The members of `mor_bench.Surrogate` that `weights_to_start_from` uses."""

    @property
    def architecture(self) -> tuple[str, ...]: ...
    @property
    def parameters(self) -> dict[str, Any]: ...


def class_path(surrogate: type[Any]) -> str:
    """Return ``module:Class``, the name of a class in files."""
    return f"{surrogate.__module__}:{surrogate.__qualname__}"


def write_model(path: str | Path, model: StoredModel) -> None:
    """Write a model file; the same model always gives the same bytes."""
    from safetensors.numpy import save as serialise

    arrays = {
        **model.arrays,
        **_prefixed(RANGE, model.load_range),
        **size_arrays(model.sizes),
        **_prefixed(TIMING, {name: np.array([t]) for name, t in model.timings_ms.items()}),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    header = {
        "format": FORMAT,
        "schema_version": str(SCHEMA_VERSION),
        "surrogate": model.surrogate,
        "parameters": model.parameters,
        "scene": model.scene,
    }
    header["sha256"] = model_digest(header, arrays)
    check_replaceable(Path(path))
    write_atomically(Path(path), _in_order(serialise(arrays, metadata=header)))


def read_model(path: str | Path) -> StoredModel:
    """Read a model file.

    Raises
    ------
    StoreError
        If the file is missing, damaged, of another format or of a newer schema.
    """
    header, arrays = read_header_and_arrays(path)
    load_range, timings = _taken(RANGE, arrays), _taken(TIMING, arrays)
    try:
        return StoredModel(
            header["surrogate"],
            header["parameters"],
            header["scene"],
            arrays,
            load_range,
            take_sizes(arrays),
            {name: _positive(time) for name, time in timings.items()},
        )
    except (InvalidInputError, KeyError, ValueError) as error:
        raise StoreError(
            f"{path}: its header or its chosen values are not valid: {error}"
        ) from None


def read_header_and_arrays(path: str | Path) -> tuple[dict[str, str], Arrays]:
    """Read a model file's raw content and verify its checksum; errors as in `read_model`."""
    from safetensors import SafetensorError, safe_open

    try:
        check_file(Path(path))
    except FileNotFoundError:
        raise StoreError(f"{path}: no such file.") from None
    try:
        with safe_open(str(path), framework="numpy") as file:
            header = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    # AttributeError and TypeError: NumPy lacks the dtype.
    except (SafetensorError, OSError, ValueError, AttributeError, TypeError) as error:
        raise StoreError(f"{path}: not a readable safetensors file: {error}") from None
    if header.get("format") != FORMAT:
        raise StoreError(f"{path}: not a surrogate of mor-bench.")
    if header.get("schema_version") != str(SCHEMA_VERSION):
        raise StoreError(
            f"{path}: schema version {header.get('schema_version')}; "
            f"this version of mor-bench reads version {SCHEMA_VERSION}."
        )
    if header.get("sha256") != model_digest(header, arrays):
        raise StoreError(f"{path}: damaged: the checksum does not match.")
    return header, arrays


def model_digest(header: Mapping[str, str], arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of the content of a model file, except the digest itself."""
    return digest_of_arrays(arrays, {key: header[key] for key in header if key != "sha256"})


def size_arrays(sizes: Mapping[str, Any]) -> Arrays:
    """Return chosen values as arrays for a file; words become the bytes of their letters."""
    return {
        SIZE + name: np.frombuffer(value.encode(), np.uint8)
        if isinstance(value, str)
        else np.array([value])
        for name, value in sizes.items()
    }


def take_sizes(arrays: Arrays) -> dict[str, Any]:
    """Remove the arrays of `size_arrays` from a model's arrays; return the chosen values."""
    return {
        name: array.tobytes().decode() if array.dtype == np.uint8 else array.item()
        for name, array in _taken(SIZE, arrays).items()
    }


def weights_to_start_from(path: str | Path, method: Startable) -> Arrays:
    """Read the arrays of a saved model with the method's class and architecture, from any scene.

    Raises
    ------
    StoreError
        If the file is missing, damaged or of a newer schema.
    InvalidInputError
        If it has another class or architecture.
    """
    header, arrays = read_header_and_arrays(path)
    surrogate = type(method)
    expected = class_path(surrogate)
    if header.get("surrogate") != expected:
        raise InvalidInputError(
            f"{path}: `start_from` must be a model of class {expected!r}; "
            f"got one of {header.get('surrogate')!r}."
        )
    try:
        saved = check_parameters(surrogate, parse_json(header["parameters"], "parameters"))
    except (MorBenchError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{path}: its parameters do not match the class {surrogate.__qualname__}: {error}"
        ) from None
    unlike = [name for name in method.architecture if saved[name] != method.parameters[name]]
    if unlike:
        wanted, got = (
            ", ".join(f"`{name}` {knobs[name]!r}" for name in unlike)
            for knobs in (method.parameters, saved)
        )
        raise InvalidInputError(
            f"{path}: `start_from` must be a model with {wanted}; got one with {got}."
        )
    return arrays


def fitting_arrays(
    path: str | Path,
    arrays: Mapping[str, NDArray[Any]],
    shapes: Mapping[str, tuple[int | None, ...]],
    dtype: type[np.floating[Any]],
) -> Arrays:
    """Return the checked arrays of `weights_to_start_from` with the given names and shapes.

    None in a shape stands for any length but 0.

    Raises
    ------
    StoreError
        If an array is missing, has another dtype, or is not finite.
    InvalidInputError
        If an array has another shape.
    """
    for name, shape in shapes.items():
        if name not in arrays or arrays[name].dtype != dtype:
            got = f"got {arrays[name].dtype}" if name in arrays else "it is missing"
            raise StoreError(f"{path}: `{name}` must be {np.dtype(dtype)}; {got}.")
        array = arrays[name]
        if not has_shape(array, shape):
            wanted = ", ".join("at least 1" if n is None else str(n) for n in shape)
            raise InvalidInputError(
                f"{path}: `start_from`: the array `{name}` must be of shape ({wanted}); "
                f"got {array.shape}."
            )
        if not np.isfinite(array).all():
            raise StoreError(f"{path}: `{name}` holds NaN or infinity.")
    return {name: arrays[name] for name in shapes}


def _prefixed(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {prefix + name: array for name, array in arrays.items()}


def _taken(prefix: str, arrays: Arrays) -> Arrays:
    """Remove the arrays with a prefix in their names from a model's arrays; return them."""
    names = [name for name in arrays if name.startswith(prefix)]
    return {name.removeprefix(prefix): arrays.pop(name) for name in names}


def _positive(time: NDArray[Any]) -> float:
    value = time.item()
    if not isinstance(value, float) or not value > 0:
        raise InvalidInputError(f"measured times must be positive numbers; got {value}.")
    return value


def _in_order(content: bytes) -> bytes:
    """Sort the metadata of a safetensors file, because the library's order varies."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # keeps the arrays aligned
    return len(text).to_bytes(8, "little") + text + content[end:]
