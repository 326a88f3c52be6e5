"""Check of the files that an export is about to write."""

from __future__ import annotations

from pathlib import Path

from mor_bench.errors import InvalidInputError


def new_file(out: str | Path, suffix: str, *beside: str) -> Path:
    """Check the ending of a new file's name, and that no file is overwritten.

    Parameters
    ----------
    out : path
    suffix : str
        Required ending, such as ``.npz``.
    *beside : str
        Other endings: files with the same stem and these endings must not exist.

    Raises
    ------
    InvalidInputError
        If the ending is wrong, or one of the files exists.
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
