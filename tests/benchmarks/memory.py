"""Peak memory of this process, for the scripts of this folder."""

from __future__ import annotations

import sys


def peak_mb(of_children: bool = False) -> float:
    """Largest resident set of this process, or of any of its children that have ended, MiB; NaN on Windows, which does not say."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    peak = resource.getrusage(
        resource.RUSAGE_CHILDREN if of_children else resource.RUSAGE_SELF
    ).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
