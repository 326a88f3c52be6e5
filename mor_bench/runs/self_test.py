"""A self-test for `mor-bench doctor`: does the machine keep what mor-bench relies on?"""

from __future__ import annotations

import ctypes
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import psutil

from mor_bench.errors import MorBenchError, StoreError
from mor_bench.method_loading import load_method, load_surrogate
from mor_bench.sandbox import landlock
from mor_bench.sandbox.fork_server import environment
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.sandbox.seal import Restrictions
from mor_bench.sandbox.session import Session
from mor_bench.scratch import identity, scratch_folder
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import generate
from mor_bench.specs import load_generated_spec

N_SAMPLES, N_DAMAGED = 120, 200
"""Number of generated samples, and of damaged copies of a model file."""

GRACE_S = 5.0
"""Time in which the processes of a killed one must end, s; usually it takes milliseconds."""

HOLD_S = 20.0
"""Time for which a process holds too much memory unless it is ended, s."""

SECRET = b"sealed"


@dataclass(frozen=True)
class Check:
    """A check and its outcome; ``passed`` is None where this system does not offer it."""

    name: str
    passed: bool | None
    detail: str


class SealedSession(Session):
    """Tries to read a sealed file, and to use too much memory."""

    activities: ClassVar = {"hoard": "hoarding"}

    def by_python(self, path: str) -> dict[str, Any]:
        """Read with Python's own function."""
        with suppress(OSError), open(path, "rb") as file:
            return {"read": file.read() == SECRET}
        return {"read": False}

    def by_native_code(self, path: str) -> dict[str, Any]:
        """Read with the C library, as any library in another language may."""
        descriptor = ctypes.CDLL(None).open(os.fsencode(path), os.O_RDONLY)
        return {"read": descriptor >= 0 and os.read(descriptor, 99) == SECRET}

    def hoard(self, hold_s: float) -> dict[str, Any]:
        """Fill a gigabyte of memory and hold it for some seconds."""
        filled = np.ones(125_000_000)
        time.sleep(hold_s)
        return {"n": len(filled)}


def self_test() -> Iterator[Check]:
    """Run all checks in a temporary folder; an unexpected error is a failed check."""
    checks: dict[str, Callable[[Path], tuple[bool | None, str]]] = {
        "generation": _generation,
        "damaged models": _damaged_models,
        "sealed folders": _sealed_folders,
        "memory limit": _memory_limit,
        "killed process": _killed_process,
    }
    with scratch_folder() as folder:
        for name, check in checks.items():
            try:
                yield Check(name, *check(folder))
            except Exception as error:  # the machine may be broken in any way
                yield Check(name, False, f"{type(error).__name__}: {error}")


def _generation(folder: Path) -> tuple[bool, str]:
    spec = load_generated_spec("beam-tiny")
    found = []
    for workers in (1, 2):
        made = generate(spec, N_SAMPLES, workers, folder / f"cache-{workers}")
        found.append([path.read_bytes() for path in sorted(made.glob("shard-*.h5"))])
    same = found[0] == found[1]
    return same, f"{N_SAMPLES} samples by one and by two processes, same bytes: {same}"


def _damaged_models(folder: Path) -> tuple[bool, str]:
    data = load_dataset("beam-tiny", N_SAMPLES, cache=folder / "cache-1", workers=1)
    method, path = load_method("pod", n_modes=5).fit(data.scene, data.train), folder / "model"
    method.save(path)
    force = data.test.forces[0]
    same = np.array_equal(load_surrogate(path).predict(force), method.predict(force))
    content, draw, refused = path.read_bytes(), random.Random(0), 0
    for _ in range(N_DAMAGED):
        place = draw.randrange(len(content))
        changed = bytes([content[place] ^ (1 << draw.randrange(8))])
        path.write_bytes(content[:place] + changed + content[place + 1 :])
        try:
            load_surrogate(path)
        except StoreError:
            refused += 1
    passed = same and refused == N_DAMAGED
    return passed, f"{refused} of {N_DAMAGED} refused; an undamaged one answers alike: {same}"


def _sealed_folders(folder: Path) -> tuple[bool | None, str]:
    secret = folder / "sealed" / "secret"
    secret.parent.mkdir()
    secret.write_bytes(SECRET)
    with SandboxedProcess(SealedSession, Restrictions((secret.parent,), scratch=folder)) as worker:
        by_python = worker.ask("by_python", 60.0, path=str(secret))["read"]
        if by_python:
            return False, "Python code reads a sealed folder"
        if not landlock.version():
            return None, "only the audit hook seals: native code can still read"
        by_native_code = worker.ask("by_native_code", 60.0, path=str(secret))["read"]
    return not by_native_code, f"Landlock {landlock.version()}; native code reads: {by_native_code}"


def _memory_limit(folder: Path) -> tuple[bool, str]:
    restrictions = Restrictions(scratch=folder, memory_bytes=5e8)
    with SandboxedProcess(SealedSession, restrictions) as worker:
        try:
            worker.ask("hoard", 60.0, hold_s=HOLD_S)
        except MethodFailedError as error:
            return "more memory than the limit" in str(error), str(error)
    return False, "a process exceeds its limit"


PARENT = """
import time
from mor_bench.runs.self_test import SealedSession
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import SandboxedProcess
from mor_bench.scratch import scratch_folder
server = ForkServer(SealedSession) if CAN_FORK else None
with scratch_folder() as folder:
    print(SandboxedProcess(SealedSession, fork_server=server).pid, folder, flush=True)
    time.sleep(60)
"""


def _killed_process(folder: Path) -> tuple[bool | None, str]:
    if sys.platform == "win32":
        return None, "there is no SIGKILL on this system"
    command = [sys.executable, "-c", PARENT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment(), text=True) as parent:
        assert parent.stdout
        child, _, left = parent.stdout.readline().strip().partition(" ")
        parent.send_signal(signal.SIGKILL)
    began = time.monotonic()
    while (alive := identity(int(child))) and time.monotonic() < began + GRACE_S:
        time.sleep(0.01)
    lived_s = time.monotonic() - began
    if alive:
        with suppress(psutil.Error):
            psutil.Process(int(child)).kill()
        return False, f"its child lives on after {GRACE_S:g} s"
    with scratch_folder():  # as the next run does
        removed = not Path(left).exists()
    return removed, f"its child ended within {lived_s:.2f} s; its folder is removed: {removed}"


def require(checks: list[Check]) -> None:
    """Raise an error that names the failed checks, if there are any."""
    failed = [check.name for check in checks if check.passed is False]
    if failed:
        raise MorBenchError(f"the self-test failed: {', '.join(failed)}.")
