"""Peak memory of this process, for the scripts of this folder."""

from __future__ import annotations

import sys


def peak_mb(of_children: bool = False) -> float:
    """Return the peak memory of this process or of its ended children, MiB; NaN on Windows."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    peak = resource.getrusage(
        resource.RUSAGE_CHILDREN if of_children else resource.RUSAGE_SELF
    ).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
