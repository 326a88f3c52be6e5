"""Checks of the arrays of a model, learned or read from a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mor_bench.errors import InvalidInputError


def has_shape(array: NDArray[Any], shape: tuple[int | None, ...]) -> bool:
    """Return whether an array has a shape, in which None stands for any length but 0."""
    return array.ndim == len(shape) and all(
        n == m if m is not None else n > 0 for n, m in zip(array.shape, shape, strict=True)
    )


def take_array(
    model: Mapping[str, NDArray[Any]],
    name: str,
    shape: tuple[int | None, ...],
    dtype: DTypeLike = np.float64,
) -> NDArray[Any]:
    """Return one array of a model in C order, checked.

    Parameters
    ----------
    shape : tuple of int or None
        Required shape; None stands for any length but 0.
    dtype : dtype
        Required type.

    Raises
    ------
    InvalidInputError
        If the array is missing, has another shape or type, or holds NaN or infinity.
    """
    if name not in model:
        raise InvalidInputError(f"the array `{name}` is missing.")
    array = model[name]
    if array.dtype != dtype or not has_shape(array, shape) or not np.isfinite(array).all():
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise InvalidInputError(
            f"`{name}` must be a finite {np.dtype(dtype)} array of shape ({wanted}); "
            f"got {array.dtype} of shape {array.shape}."
        )
    return np.ascontiguousarray(array)


def take_indices(
    model: Mapping[str, NDArray[Any]], name: str, size: int, *, distinct: bool = True
) -> NDArray[np.int64]:
    """Return one array of at least one integer in [0, size), by default distinct ones.

    Raises
    ------
    InvalidInputError
        If the array is missing or has other content.
    """
    if name not in model:
        raise InvalidInputError(f"the array `{name}` is missing.")
    indices = model[name]
    good = indices.dtype.kind == "i" and indices.ndim == 1 and len(indices) > 0
    if (
        not good
        or indices.min() < 0
        or indices.max() >= size
        or (distinct and len(np.unique(indices)) != len(indices))
    ):
        kind = "different integers" if distinct else "integers"
        raise InvalidInputError(f"`{name}` must be {kind} in [0, {size - 1}].")
    return indices.astype(np.int64)


def check_finite(owner: str, model: Mapping[str, NDArray[Any]]) -> None:
    """Raise `InvalidInputError` unless all arrays of a learned model are finite."""
    for name, array in model.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            raise InvalidInputError(f"`{name}` of a {owner} must be an array of numbers.")
        if not np.isfinite(array).all():
            raise InvalidInputError(f"`{name}` of a {owner} holds NaN or infinity.")
