"""Threads, memory, and a description of the machine."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from threadpoolctl import ThreadpoolController, threadpool_limits

MEMBERSHIP, GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")

OPENMP_THREADS = "OMP_NUM_THREADS"
"""Environment variable from which torch takes its number of threads when it is imported."""

SIGNAL_CHECK_S = 0.2
"""Longest wait of the main thread, s.

Linux may deliver a signal to any thread. Python acts on it only when the main thread runs again.
"""


def usable_cores() -> int:
    """Return the number of cores that this process may use; a queue or container may allow few."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_kernel_threads = 1


def kernel_threads() -> int:
    """Return the number of threads of compiled kernels, one unless `pinned_threads` sets it."""
    return _kernel_threads


@contextmanager
def pinned_threads(threads: int) -> Iterator[None]:
    """Set the threads of BLAS, OpenMP, compiled kernels and, if it is loaded, torch.

    Compiled kernels use more than one thread on large meshes only. Libraries that are loaded inside
    start with this number. Afterwards torch has that of OMP_NUM_THREADS again, or all usable cores;
    other libraries that were loaded inside keep it.

    Parameters
    ----------
    threads : int

    Examples
    --------
    >>> import mor_bench
    >>> from mor_bench.machine import pinned_threads
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> method = mor_bench.load_method("fem").fit(scene, None)
    >>> with pinned_threads(2):
    ...     displacements = method.predict(0.0 * scene.mesh.points)
    >>> displacements.shape
    (63, 3)
    """
    global _kernel_threads
    torch: Any = sys.modules.get("torch")
    usual = os.environ.get(OPENMP_THREADS)
    before = torch.get_num_threads() if torch else _openmp_threads(usual or "")
    kernels_before = _kernel_threads
    with threadpool_limits(threads):
        if torch:
            torch.set_num_threads(threads)
        _kernel_threads = threads
        os.environ[OPENMP_THREADS] = str(threads)
        try:
            yield
        finally:
            _kernel_threads = kernels_before
            if usual is None:
                os.environ.pop(OPENMP_THREADS, None)
            else:
                os.environ[OPENMP_THREADS] = usual
            if torch := sys.modules.get("torch"):
                torch.set_num_threads(before)


def _openmp_threads(said: str) -> int:
    """Return the first number of a list such as "4,2", or the number of usable cores."""
    first = said.split(",")[0].strip()
    return int(first) if first.isdecimal() and int(first) > 0 else usable_cores()


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread.

    In Newton's method on two cores, a second one gained nothing, and beside two other programs made
    queries forty times as long.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@contextmanager
def kernels_alone() -> Iterator[None]:
    """Let BLAS use one thread where kernels use more: its waiting threads would slow them down."""
    if _kernel_threads == 1:
        yield
        return
    with one_blas_thread():
        yield


def memory_limit_bytes(membership: Path = MEMBERSHIP, groups: Path = GROUPS) -> float:
    """Return the memory that this process may use: the machine's, or less in a container.

    Parameters
    ----------
    membership, groups : Path
        Linux's list of the process's control groups, and the folder of all groups.
    """
    import psutil  # here, because a solve needs no psutil, and its import takes 10 ms

    limits = [float(psutil.virtual_memory().total)]
    with suppress(OSError):
        for line in membership.read_text(encoding="utf-8").splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds and "memory" not in kinds.split(","):
                continue
            top, name = (
                (groups / "memory", "memory.limit_in_bytes") if kinds else (groups, "memory.max")
            )
            group = top / path.lstrip("/")
            for place in (group, *group.parents):
                if place.is_relative_to(top):
                    with suppress(OSError, ValueError):  # "max" is no limit
                        limits.append(float((place / name).read_text(encoding="ascii")))
    return min(limits)


def free_memory_bytes() -> float:
    """Return the memory that is free, or the limit of this process if that is less."""
    import psutil

    return min(float(psutil.virtual_memory().available), memory_limit_bytes())


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this process, bytes."""
    # getrusage would report the parent's peak if that is higher.
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        import psutil

        info = psutil.Process().memory_info()
        return int(getattr(info, "peak_wset", info.rss))


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _processor_model() -> str:
    """Return family, model and stepping, since virtual machines often hide the name of the chip."""
    wanted = {"cpu family": "family", "model": "model", "stepping": "stepping"}
    found: dict[str, str] = {}
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        for line in file:
            key, _, value = line.partition(":")
            if key.strip() in wanted:
                found.setdefault(wanted[key.strip()], value.strip())
            elif key.strip() == "flags":
                found["instructions"] = _widest(value.split())
                break
    numbers = ", ".join(f"{name} {found[name]}" for name in wanted.values() if name in found)
    parts = (numbers, found.get("instructions", ""))
    return ", ".join(filter(None, parts)) or platform.machine()


def _widest(flags: Sequence[str]) -> str:
    """Name the widest vector instructions, which libraries choose their kernels by."""
    names = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX"}
    return next((name for flag, name in names.items() if flag in flags), "")


def gpu_name() -> str:
    """Return the name of the CUDA device for training."""
    import torch

    return str(torch.cuda.get_device_name(0))


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, load, system, and the versions that affect timings.

    ``processor_model`` has family, model, stepping and vector instructions.
    ``load`` is the mean number of running processes over the last 1, 5 and 15 minutes.
    """
    import psutil

    versions = {}
    for package in ("mor-bench", "numpy", "scipy", "numba", "scikit-learn", "torch"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "processor": _processor(),
        "processor_model": _processor_model(),
        "cores": usable_cores(),
        "memory_bytes": int(psutil.virtual_memory().total),
        "load": [round(load, 2) for load in psutil.getloadavg()],
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": versions,
    }
