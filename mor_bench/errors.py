"""The errors that this package raises on purpose, with one base class, and its warnings.

Callers should use the class and attributes of an error; its text is for people. The text names the
wrong value, the allowed values and the given value.
"""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from typing import TypeGuard


class MorBenchError(Exception):
    """Base class of the errors of mor-bench.

    Examples
    --------
    >>> import mor_bench
    >>> try:
    ...     mor_bench.load_scene("no-such-scene")
    ... except MorBenchError as error:
    ...     type(error).__name__
    'UnknownNameError'
    """


def printable(text: str, most: int = 2000, keep: str = "\n\t") -> str:
    """Return a text that is safe to print: control characters escaped, and not endless."""
    shown = text if len(text) <= most else f"{text[:most]}…"
    return "".join(
        letter if letter.isprintable() or letter in keep else ascii(letter)[1:-1]
        for letter in shown
    )


def text_of(error: BaseException) -> str:
    """Return an error's text; foreign errors may fail to form theirs."""
    try:
        return str(error)
    except Exception:  # foreign code runs here
        return "its text cannot be formed"


class SpecError(MorBenchError, ValueError):
    """A dataset, method or hyperparameter is not valid.

    The message names the file, the key and the allowed values.
    """


class UnknownNameError(SpecError):
    """A suite has no dataset or method of this name; the message gives the most similar one.

    Attributes
    ----------
    kind : str
        "datasets" or "methods".
    name : str
        The name that was asked for.
    known : tuple of str
        The names that exist.
    """

    def __init__(
        self, message: str, *, kind: str = "", name: str = "", known: Iterable[str] = ()
    ) -> None:
        super().__init__(message)
        self.kind, self.name, self.known = kind, name, tuple(known)


class UnusableClassError(SpecError):
    """A method's class cannot be imported, is abstract, or lacks the methods of a method."""


class InvalidInputError(MorBenchError, ValueError):
    """An argument is out of range, or an array has a wrong shape or dtype or is not finite."""


def is_integer(value: object) -> TypeGuard[int]:
    """Return True for an integer, also of NumPy, but not for a boolean."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_count(name: str, value: object) -> None:
    """Raise `InvalidInputError` unless an argument is None or an integer >= 1, also of NumPy."""
    if value is not None and not (is_integer(value) and value >= 1):
        raise InvalidInputError(f"`{name}` must be an integer >= 1; got {value!r}.")


class OutsideMeshError(MorBenchError, ValueError):
    """A point lies in no cell of a mesh; the message names the point and the bounds of the mesh."""


class NotFittedError(MorBenchError, RuntimeError):
    """`predict` or `save` was called before `fit`."""


class UnknownRangeError(MorBenchError, RuntimeError):
    """The range of a method's training loads is unknown, so it cannot flag extrapolation."""


class UnsupportedSceneError(MorBenchError):
    """A method cannot handle a scene; the message gives the reason."""


class SolverError(MorBenchError, RuntimeError):
    """The nonlinear solve did not end in a valid equilibrium.

    Attributes
    ----------
    cuts : int or None
        Number of halvings of the load increment, if the solve steps the load.
    """

    def __init__(self, message: str, *, cuts: int | None = None) -> None:
        super().__init__(message)
        self.cuts = cuts


class NoEquilibriumError(SolverError):
    """The solve did not converge, even with smaller load increments."""


class LimitPointError(NoEquilibriumError):
    """The path of stable equilibria from rest ends before the whole load is reached.

    Attributes
    ----------
    load_factor : float or None
        Fraction of the load at the end of the path.
    lowest_eigenvalue : float or None
        Lowest eigenvalue of the tangent at the end of the path, relative to that at rest.
    """

    def __init__(
        self,
        message: str,
        *,
        load_factor: float | None = None,
        lowest_eigenvalue: float | None = None,
    ) -> None:
        super().__init__(message)
        self.load_factor, self.lowest_eigenvalue = load_factor, lowest_eigenvalue


class InvertedElementError(SolverError):
    """The solve found only states with det F <= 0 at some Gauss point."""


class UnconstrainedBodyError(MorBenchError, ValueError):
    """The supports leave rigid motions free; `free_motions` names them."""

    def __init__(self, message: str, *, free_motions: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.free_motions = free_motions


class OutOfTimeError(MorBenchError):
    """Fitting would exceed its time limit; the message gives the estimated time."""


class StoreError(MorBenchError):
    """A stored file is damaged, has another format, or has a newer schema."""


class NewerSchemaError(StoreError):
    """A stored file has a newer schema than this version reads; it is never overwritten."""


class WorkerError(MorBenchError, RuntimeError):
    """Worker processes for data generation were lost, or cannot be reached or used."""


class MissingDependencyError(MorBenchError, ImportError):
    """An optional dependency is not installed; the message names the extra to install."""


class UnavailableBackendError(MorBenchError, RuntimeError):
    """The chosen back end cannot compute a network; the message gives the reason."""


class RankDeficientWarning(UserWarning):
    """The snapshots have fewer independent directions than the requested number of modes."""


class IllConditionedWarning(UserWarning):
    """The stiffness at rest is so ill-conditioned that answers lose most digits."""


class DamagedFileWarning(UserWarning):
    """A stored file is damaged and is regenerated."""


class LockingWarning(UserWarning):
    """The elements lock: displacements of a nearly incompressible material are too small."""


class RenamedWarning(UserWarning):
    """A method has another name now."""


class FallbackWarning(UserWarning):
    """A faster implementation is not available, so a slower one is used."""
