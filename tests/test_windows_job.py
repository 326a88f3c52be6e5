"""The job object of Windows: layout of its tables, and order of its calls. Runs everywhere."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

import pytest

from mor_bench.cli.windows_job import (
    BasicLimits,
    ExtendedLimits,
    end_children_with_this_process,
    join_new_job,
)

JOB, PROCESS = 1234, 2**64 - 1
"""A handle, and the constant handle of the current process."""


class Kernel:
    """Records the calls of kernel32; calls whose names are in `failing` fail."""

    def __init__(self, *failing: str) -> None:
        self.calls: list[tuple[Any, ...]] = []
        for name in ("CreateJobObjectW", "GetCurrentProcess"):
            result = JOB if name.startswith("Create") else PROCESS
            setattr(self, name, self.call(name, None if name in failing else result))
        for name in ("SetInformationJobObject", "AssignProcessToJobObject"):
            setattr(self, name, self.call(name, name not in failing))

    def call(self, name: str, result: Any) -> Any:
        def called(*arguments: Any) -> Any:
            self.calls.append((name, *arguments))
            return result

        return called


@pytest.mark.skipif(ctypes.sizeof(ctypes.c_void_p) != 8, reason="sizes of 64-bit systems")
def test_the_tables_have_the_layout_that_windows_documents() -> None:
    assert (ctypes.sizeof(BasicLimits), ctypes.sizeof(ExtendedLimits)) == (64, 144)
    flags: Any = BasicLimits.flags
    memory: Any = ExtendedLimits.process_memory
    assert (flags.offset, flags.size, memory.offset) == (16, 4, 112)


def test_the_process_joins_a_job_that_ends_with_it() -> None:
    kernel = Kernel()
    assert join_new_job(kernel)
    made, limited, _, joined = kernel.calls
    assert made == ("CreateJobObjectW", None, None)
    name, job, kind, limits, size = limited
    assert (name, job.value, kind, size.value) == ("SetInformationJobObject", JOB, 9, 144)
    found = ctypes.cast(limits, ctypes.POINTER(ExtendedLimits)).contents
    assert found.basic.flags == 0x2000
    assert (joined[0], joined[1].value, joined[2].value) == (
        "AssignProcessToJobObject",
        JOB,
        PROCESS,
    )


@pytest.mark.parametrize(
    "name", ["CreateJobObjectW", "SetInformationJobObject", "AssignProcessToJobObject"]
)
def test_a_process_that_may_not_join_a_job_runs_on(name: str) -> None:
    assert not join_new_job(Kernel(name))


@pytest.mark.skipif(sys.platform == "win32", reason="it joins a job there")
def test_elsewhere_nothing_happens() -> None:
    end_children_with_this_process()
