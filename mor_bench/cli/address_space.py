"""The least address space with which a command begins."""

from __future__ import annotations

from mor_bench.errors import MorBenchError

LEAST_ADDRESS_SPACE_BYTES = 2_000_000_000


def check_address_space() -> None:
    """Raise `MorBenchError` if this process may map less memory than numerical libraries need.

    With less, OpenBLAS waits forever or ends the process without a word.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if resource.RLIM_INFINITY != limit < LEAST_ADDRESS_SPACE_BYTES:
        raise MorBenchError(
            f"the address space must be at least {LEAST_ADDRESS_SPACE_BYTES / 1e9:g} GB; "
            f"it is limited to {limit / 1e9:.3g} GB (ulimit -v)"
        )
