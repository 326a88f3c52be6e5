"""Checks of the files that an export is about to write."""

from __future__ import annotations

from pathlib import Path

from mor_bench.errors import InvalidInputError


def new_file(out: str | Path, suffix: str, *beside: str) -> Path:
    """Check the name of a file that is to be written, and that nothing is overwritten.

    Parameters
    ----------
    out : path
    suffix : str
        Required ending, such as ``.npz``.
    *beside : str
        Endings of further files of the same name that must not exist either.

    Raises
    ------
    InvalidInputError
        If the ending is another one, or one of the files exists.
    """
    out = Path(out)
    if out.suffix != suffix:
        raise InvalidInputError(f"`out` must end in {suffix}; got {str(out)!r}.")
    for path in (out, *(out.with_suffix(ending) for ending in beside)):
        if path.exists():
            raise InvalidInputError(
                f"`out`: {path} exists and is not overwritten; remove it or choose another name."
            )
    return out
