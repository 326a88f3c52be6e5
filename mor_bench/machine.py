"""Threads, the summary of latencies, and the machine that they hold for; light enough to be imported by a method's process."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import psutil
from threadpoolctl import threadpool_limits


@contextmanager
def pinned_threads(threads: int) -> Iterator[None]:
    """Limit BLAS, OpenMP and, where it is loaded, torch to a number of threads."""
    torch: Any = sys.modules.get("torch")
    before = torch.get_num_threads() if torch else None
    with threadpool_limits(threads):
        if torch:
            torch.set_num_threads(threads)
        try:
            yield
        finally:
            if torch:
                torch.set_num_threads(before)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def gpu_name() -> str:
    """Of the CUDA device that trains."""
    import torch

    return str(torch.cuda.get_device_name(0))


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory, load over the last 1, 5 and 15 minutes, system and the versions that timings depend on."""
    versions = {}
    for package in ("mor-bench", "numpy", "scipy", "numba", "scikit-learn", "torch"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "memory_bytes": int(psutil.virtual_memory().total),
        "load": [round(load, 2) for load in psutil.getloadavg()],
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": versions,
    }
