"""The installation: versions and sizes of libraries, extras, and this machine's speed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from importlib.util import find_spec
from typing import Any

from mor_bench.machine import describe_machine
from mor_bench.measure.machine_speed import MachineSpeed, RecordedMachine, recorded_machines

PACKAGE = "mor-bench"

EXTRAS = {
    "learn": (("torch",), "networks such as U-Mesh; without it, runs skip them"),
    "mkl": (("pypardiso",), "the method `fem-pardiso` and the solver `pardiso`"),
    "cluster": (("distributed",), "data generation and fits on a Dask cluster"),
    "onnx": (("onnx", "onnxruntime"), "`mor-bench export onnx` and its check"),
    "viz": (("pyvista",), "rendered meshes; without it, matplotlib draws them"),
    "pymor": (("pymor",), "scenes as models of pyMOR, and its reduced models as methods"),
}
"""The modules of each extra, and its use."""


@dataclass(frozen=True)
class Library:
    """An installed library that mor-bench needs, directly or through another, and its size."""

    name: str
    version: str
    size_bytes: int


@dataclass(frozen=True)
class Installation:
    """The installed libraries and extras, and the speed of this machine.

    Attributes
    ----------
    machine : dict
        See `mor_bench.machine.describe_machine`.
    libraries : list of Library
        Largest first.
    cuda : str or None
        Version of CUDA that PyTorch brings; None without PyTorch or CUDA.
    missing : dict of str to str
        Extras that are not installed, and their use.
    speed : MachineSpeed
    recorded : list of RecordedMachine
    """

    machine: dict[str, Any]
    libraries: list[Library]
    cuda: str | None
    missing: dict[str, str]
    speed: MachineSpeed
    recorded: list[RecordedMachine]

    @classmethod
    def inspect(cls) -> Installation:
        """Inspect the installation and measure the machine."""
        missing = {
            extra: use
            for extra, (modules, use) in EXTRAS.items()
            if not all(map(find_spec, modules))
        }
        libraries = sorted(installed_libraries(), key=lambda item: -item.size_bytes)
        speed = MachineSpeed.measure()
        return cls(describe_machine(), libraries, _cuda(), missing, speed, recorded_machines())

    @cached_property
    def size_bytes(self) -> int:
        """Size of all libraries."""
        return sum(library.size_bytes for library in self.libraries)

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "machine": self.machine,
            "libraries": [vars(library) for library in self.libraries],
            "size_bytes": self.size_bytes,
            "cuda": self.cuda,
            "missing_extras": self.missing,
            "speed": self.speed.model_dump(),
            "recorded": [machine.model_dump() for machine in self.recorded],
        }


def installed_libraries() -> list[Library]:
    """Return the installed libraries that mor-bench and its installed extras need."""
    found: dict[str, Distribution] = {}
    waiting = [PACKAGE]
    while waiting:
        name = waiting.pop()
        try:
            library = distribution(name)
        except PackageNotFoundError:  # an extra or a platform that is not this one
            continue
        if name not in found:
            found[name] = library
            required = [line for line in library.requires or () if _counts(name, line)]
            waiting += [_normal(line) for line in required]
    return [Library(name, item.version, _size_bytes(item)) for name, item in found.items()]


def _counts(name: str, requirement: str) -> bool:
    """Return whether to follow a requirement: of extras, only those of mor-bench for users."""
    extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)", requirement)
    return extra is None or (name == PACKAGE and extra[1] in EXTRAS)


def _normal(requirement: str) -> str:
    """Return the normalised name of a requirement's library."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    return re.sub(r"[-_.]+", "-", found[0]).lower() if found else ""


def _size_bytes(library: Distribution) -> int:
    total = 0
    for file in library.files or ():
        try:
            total += file.locate().stat().st_size  # type: ignore[attr-defined]
        except OSError:
            continue
    return total


def _cuda() -> str | None:
    try:
        import torch
    except ImportError:
        return None
    return None if torch.version.cuda is None else str(torch.version.cuda)
