"""Several mistakes of a scene in one error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from mor_bench.errors import SpecError
from mor_bench.specs import listed


class _JoinedError(SpecError):
    parts: tuple[str, ...] = ()


class Problems:
    """A block ``with Problems() as problems`` raises all errors that it kept as one `SpecError`.

    Examples
    --------
    >>> try:
    ...     with Problems() as problems:
    ...         for axis in "xyz":
    ...             with problems.keep():
    ...                 raise SpecError(f"no {axis}.")
    ... except SpecError as error:
    ...     print(error)
    no x. no y. no z.
    """

    def __init__(self) -> None:
        self.found: list[str] = []

    @contextmanager
    def keep(self) -> Iterator[None]:
        """Keep a `SpecError` for later."""
        try:
            yield
        except SpecError as error:
            self.found += error.parts if isinstance(error, _JoinedError) else (str(error),)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None and self.found:
            several = _JoinedError(listed(self.found))
            several.parts = tuple(self.found)
            raise several
