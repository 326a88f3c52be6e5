"""A job object of Windows: all processes of the command end with it, even if it is killed.

This follows the documentation of Windows. Only its tables were tested, not on Windows itself.
"""

from __future__ import annotations

import ctypes
import sys
from typing import Any

EXTENDED_LIMITS, KILL_ON_JOB_CLOSE = 9, 0x2000
"""Numbers of JobObjectExtendedLimitInformation and JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE."""


class BasicLimits(ctypes.Structure):
    """JOBOBJECT_BASIC_LIMIT_INFORMATION."""

    _fields_ = (
        ("process_time", ctypes.c_int64),
        ("job_time", ctypes.c_int64),
        ("flags", ctypes.c_uint32),
        ("least_working_set", ctypes.c_size_t),
        ("most_working_set", ctypes.c_size_t),
        ("active_processes", ctypes.c_uint32),
        ("affinity", ctypes.c_size_t),
        ("priority_class", ctypes.c_uint32),
        ("scheduling_class", ctypes.c_uint32),
    )


class ExtendedLimits(ctypes.Structure):
    """JOBOBJECT_EXTENDED_LIMIT_INFORMATION."""

    _fields_ = (
        ("basic", BasicLimits),
        ("io_counters", ctypes.c_uint64 * 6),
        ("process_memory", ctypes.c_size_t),
        ("job_memory", ctypes.c_size_t),
        ("peak_process_memory", ctypes.c_size_t),
        ("peak_job_memory", ctypes.c_size_t),
    )


def end_children_with_this_process() -> None:
    """Put this process into a job object that Windows ends with it; nothing elsewhere.

    Processes that it starts from now on are in the job too. The handle stays open on purpose:
    Windows closes it when this process ends, whatever the reason, and then ends the others.
    """
    if sys.platform == "win32":
        join_new_job(ctypes.WinDLL("kernel32", use_last_error=True))


def join_new_job(kernel: Any) -> bool:
    """Create the job and join it; return whether it succeeded."""
    kernel.CreateJobObjectW.restype = kernel.GetCurrentProcess.restype = ctypes.c_void_p
    job = ctypes.c_void_p(kernel.CreateJobObjectW(None, None))
    limits = ExtendedLimits()
    limits.basic.flags = KILL_ON_JOB_CLOSE
    size = ctypes.c_uint32(ctypes.sizeof(limits))
    return bool(
        job
        and kernel.SetInformationJobObject(job, EXTENDED_LIMITS, ctypes.byref(limits), size)
        and kernel.AssignProcessToJobObject(job, ctypes.c_void_p(kernel.GetCurrentProcess()))
    )
