"""A method that tries to reach sealed files in every way that evades Python's usual calls."""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import signal
import socket
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from tests.third_party import Zero

WAYS: dict[str, Callable[[Path], bytes]] = {}
"""Each reads the secret at a path, and returns its content."""


def way(function: Callable[[Path], bytes]) -> Callable[[Path], bytes]:
    WAYS[function.__name__] = function
    return function


def read(path: Path) -> bytes:
    return path.read_bytes()


@way
def with_a_folder_descriptor(path: Path) -> bytes:
    folder = os.open("/", os.O_RDONLY)
    for part in path.parts[1:-1]:
        folder = os.open(part, os.O_RDONLY, dir_fd=folder)
    return os.read(os.open(path.name, os.O_RDONLY, dir_fd=folder), 99)


@way
def with_an_opener(path: Path) -> bytes:
    os.chdir(path.parents[1])
    folder = os.open(path.parent.name, os.O_RDONLY)
    with open(path.name, "rb", opener=lambda name, _: os.open(name, 0, dir_fd=folder)) as file:
        return file.read()


@way
def in_a_joblib_worker(path: Path) -> bytes:
    from joblib import Parallel, delayed

    return bytes(Parallel(2)(delayed(read)(path) for _ in range(2))[0])


@way
def in_a_spawned_process(path: Path) -> bytes:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(read, (path,))


@way
def in_the_c_library(path: Path) -> bytes:
    content = ctypes.create_string_buffer(99)
    libc = ctypes.CDLL(None, use_errno=True)
    descriptor = libc.open(os.fsencode(path), 0)
    if descriptor < 0:
        raise OSError(ctypes.get_errno(), "libc")
    return content.raw[: libc.read(descriptor, content, 99)]


@way
def as_mapped_memory(path: Path) -> bytes:
    libc = ctypes.CDLL(None)
    descriptor = libc.open(os.fsencode(path), 0)
    if descriptor < 0:
        raise OSError("libc")
    return bytes(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))


@way
def as_a_tensor(path: Path) -> bytes:
    import torch

    return bytes(torch.from_file(str(path), size=10, dtype=torch.uint8).numpy())


@way
def in_a_raw_hdf5_link(path: Path) -> bytes:
    with h5py.File("link.h5", "w") as file:
        file["x"] = h5py.ExternalLink(str(path.with_suffix(".h5")), "secret")
    with h5py.File("link.h5", "r") as file:
        return bytes(file["x"][()])


@way
def in_a_virtual_dataset(path: Path) -> bytes:
    layout = h5py.VirtualLayout(shape=(10,), dtype=np.uint8)
    layout[:] = h5py.VirtualSource(str(path.with_suffix(".h5")), "secret", shape=(10,))
    with h5py.File("virtual.h5", "w") as file:
        file.create_virtual_dataset("x", layout)
    with h5py.File("virtual.h5", "r") as file:
        return bytes(file["x"][:]).strip(b"\0")  # zeros stand for what cannot be read


@way
def after_renaming_a_folder_above(path: Path) -> bytes:
    above = path.parents[2]
    os.rename(above, above.with_name("elsewhere"))
    return (above.with_name("elsewhere") / path.relative_to(above)).read_bytes()


@way
def through_a_hard_link(path: Path) -> bytes:
    folder = os.open(path.parent, os.O_RDONLY)
    os.link(path.name, "hard", src_dir_fd=folder)
    return Path("hard").read_bytes()


@way
def through_a_symbolic_link(path: Path) -> bytes:
    os.symlink(path.parents[2], "soft")
    return (Path("soft") / path.relative_to(path.parents[2])).read_bytes()


@way
def in_a_fork(path: Path) -> bytes:
    end, start = os.pipe()
    if os.fork() == 0:
        os.write(start, in_the_c_library(path))
        os._exit(0)
    os.close(start)
    return os.read(end, 99)


@way
def from_the_memory_of_the_parent(path: Path) -> bytes:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.open(f"/proc/{os.getppid()}/mem".encode(), 0) < 0:
        raise OSError(ctypes.get_errno(), "libc")
    return b"readable"


@way
def by_a_signal_to_the_parent(path: Path) -> bytes:
    os.kill(os.getppid(), signal.SIGCONT)
    return b"sent"


@way
def by_a_process_of_the_fork_server(path: Path) -> bytes:
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        try:
            end = socket.socket(fileno=os.dup(descriptor))
        except OSError:
            continue
        if end.type == socket.SOCK_SEQPACKET:
            return b"reached"
    raise OSError("no such socket")


class Intruder(Zero):
    """Tries one way during its fit, and warns of what it has read."""

    def __init__(self, way: str, secret: str, folder: str) -> None:
        self.way, self.secret, self.folder = way, secret, folder

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Intruder:
        os.chdir(self.folder)
        try:
            found = WAYS[self.way](Path(self.secret))
        except Exception as error:  # libraries raise all kinds of errors when refused
            warnings.warn(f"refused: {type(error).__name__}: {error}", stacklevel=2)
        else:
            warnings.warn(f"saw {found!r}" if found else "refused", stacklevel=2)
        super().fit(scene, snapshots)
        return self
