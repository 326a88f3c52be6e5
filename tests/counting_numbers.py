"""Numbers that count their multiplications, to execute kernels with."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


class Counted:
    """A number that counts its products, quotients, powers, roots, logarithms, exponentials."""

    total = 0

    def __init__(self, value: float) -> None:
        self.value = float(value)

    def _times(self, value: float) -> Counted:
        Counted.total += 1
        return Counted(value)

    def __mul__(self, other: Any) -> Any:
        return (
            NotImplemented
            if isinstance(other, np.ndarray)
            else self._times(self.value * float(other))
        )

    def __truediv__(self, other: Any) -> Any:
        return (
            NotImplemented
            if isinstance(other, np.ndarray)
            else self._times(self.value / float(other))
        )

    def __pow__(self, other: Any) -> Counted:
        return self._times(self.value ** float(other))

    def __rmul__(self, other: Any) -> Any:
        return self * other

    def __rtruediv__(self, other: Any) -> Counted:
        return self._times(float(other) / self.value)

    def __add__(self, other: Any) -> Any:
        return (
            NotImplemented if isinstance(other, np.ndarray) else Counted(self.value + float(other))
        )

    def __radd__(self, other: Any) -> Any:
        return self + other

    def __sub__(self, other: Any) -> Any:
        return (
            NotImplemented if isinstance(other, np.ndarray) else Counted(self.value - float(other))
        )

    def __rsub__(self, other: Any) -> Counted:
        return Counted(float(other) - self.value)

    def __neg__(self) -> Counted:
        return Counted(-self.value)

    def __abs__(self) -> Counted:
        return Counted(abs(self.value))

    def __float__(self) -> float:
        return self.value

    def __lt__(self, other: Any) -> bool:
        return self.value < float(other)

    def __gt__(self, other: Any) -> bool:
        return self.value > float(other)

    def __ge__(self, other: Any) -> bool:
        return self.value >= float(other)

    def sqrt(self) -> Counted:
        return self._times(math.sqrt(self.value))


def counted_array(values: Any) -> np.ndarray:
    return np.asarray(np.vectorize(Counted, otypes=[object])(np.asarray(values, dtype=float)))


class CountingNumpy:
    """The part of numpy that the kernels use, with arrays of `Counted`."""

    inf = math.inf
    array, uint64 = staticmethod(np.array), int
    zeros = empty = staticmethod(lambda shape: counted_array(np.zeros(shape)))
    full = staticmethod(lambda shape, value: counted_array(np.full(shape, value)))


def interpreted(module: Any) -> dict[str, Any]:
    """Return a module's kernels, uncompiled, with one element per batch, for `Counted`."""
    source = Path(module.__file__).read_text(encoding="utf-8")
    source = re.sub(r"^(from|import) .*\n", "", source, flags=re.MULTILINE)
    source = source.replace("LANES = 32", "LANES = 1")

    def njit(**_: Any) -> Callable[[Any], Any]:
        return lambda function: function

    names = {
        "np": CountingNumpy,
        "njit": njit,
        "cache": lambda function: function,
        "intrinsic": lambda function: function,
        "sqrt": Counted.sqrt,
    }
    exec(compile(source, module.__file__, "exec"), names)
    names["_log"] = lambda x: x._times(math.log(x.value))
    names["_inverse_cube_root"] = lambda x: x._times(x.value ** (-1 / 3))
    names["_exp"] = lambda x: x._times(math.exp(x.value))
    return names
