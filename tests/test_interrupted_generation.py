"""Generation on full disks, with killed or competing processes, and on clusters that lose parts."""

from __future__ import annotations

import errno
import io
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.errors import StoreError, WorkerError
from mor_bench.scratch import host_name, identity
from mor_bench.snapshots import generate as generate_module
from mor_bench.snapshots import store
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.executors import cluster_pool
from mor_bench.snapshots.generate import dataset_folder, generate, shard_path
from mor_bench.snapshots.store import read_shard, remove_leftovers, write_shard
from mor_bench.specs import DatasetSpec, load_generated_spec
from tests.dask_cluster import Cluster
from tests.generator_process import Generators, files, shards

SMALL = 10
"""Samples per shard in tests that need many shards."""

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL and fork")


def tiny_spec(samples_per_patch: int) -> DatasetSpec:
    """Return beam-tiny with 21 times as many samples."""
    spec = load_generated_spec("beam-tiny").model_dump()
    loads = {**spec["loads"], "samples_per_patch": samples_per_patch}
    return DatasetSpec.model_validate({**spec, "loads": loads})


LONG = tiny_spec(75)


def leftovers(folder: Path) -> list[Path]:
    return list(folder.glob("*.tmp")) + list(folder.glob(".*.tmp"))


# Full disks


class FullDisk:
    """Replaces `open`: files on a disk that takes a limited number of bytes in total."""

    def __init__(self, capacity: int) -> None:
        self.free = capacity

    def __call__(self, path: Path, mode: str) -> Any:
        disk, file = self, open(path, mode, buffering=0)  # noqa: SIM115, closed by `close`
        write = file.write

        class File(io.BytesIO):
            def write(self, content: Any) -> int:
                taken = min(disk.free, len(content))
                disk.free -= taken
                write(content[:taken])
                if taken < len(content):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return taken

            def fileno(self) -> int:
                return file.fileno()

            def close(self) -> None:
                file.close()

        return File()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of 42 small shards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate_module, "SHARD_SIZE", SMALL)
        cache = tmp_path_factory.mktemp("undisturbed")
        return files(generate(tiny_spec(20), workers=1, cache=cache))


@pytest.mark.slow
def test_generation_survives_a_write_that_fails_at_any_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, bytes]
) -> None:
    """Generate on a full disk, with different free space each time, until it succeeds."""
    monkeypatch.setattr(generate_module, "SHARD_SIZE", SMALL)
    rng, spec = np.random.default_rng(0), tiny_spec(20)
    folder = dataset_folder(spec, tmp_path)
    refusal = f"{folder}: cannot be written: No space left on device. Finished shards are kept"
    failures = 0
    while failures < 200:
        monkeypatch.setattr(store, "open", FullDisk(int(rng.integers(0, 80_000))), raising=False)
        try:
            generate(spec, workers=1, cache=tmp_path)
            break
        except StoreError as error:
            message = str(error)
        assert message.startswith(refusal)
        assert not leftovers(folder)
        assert undisturbed.items() >= files(folder).items()
        failures += 1
    assert not leftovers(folder)
    assert files(folder) == undisturbed
    assert failures >= 10


def test_a_failed_write_leaves_the_earlier_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: Path, tiny: Dataset
) -> None:
    shard = read_shard(shard_path(dataset_folder(load_generated_spec("beam-tiny"), cache), 2))
    path = tmp_path / "shard.h5"
    write_shard(path, shard)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(path, replace(shard, start=0))
    assert [path.name for path in tmp_path.iterdir()] == ["shard.h5"]
    assert path.read_bytes() == before


# Killed and competing processes


@needs_signals
def test_leftovers_of_dead_processes_are_removed_and_files_of_live_ones_are_kept(
    tmp_path: Path,
) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host, parent = host_name(), os.getppid()
    living, gone, another = identity(parent), f"{dead.pid}-1", f"{parent}-1"
    stale = f".d.h5.elsewhere.{gone}.01.tmp"
    kept = {
        f".b.h5.{host}.{living}.00.tmp",
        f".c.h5.elsewhere.{gone}.00.tmp",
        ".of-someone-else.tmp",
        "shard-00000.h5",
    }
    ended = [f".a.h5.{host}.{owner}.00.tmp" for owner in (gone, another)]
    for name in (*kept, *ended, stale):
        (tmp_path / name).touch()
    an_hour_ago = time.time() - store.STALE_AFTER_S - 1
    for name in (stale, f".b.h5.{host}.{living}.00.tmp"):  # the clock may have jumped
        os.utime(tmp_path / name, (an_hour_ago, an_hour_ago))
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == kept


@pytest.fixture(scope="module")
def generators() -> Iterator[Generators]:
    with Generators(LONG.model_dump_json(), SMALL) as processes:
        yield processes


@pytest.fixture(scope="module")
def long_undisturbed(
    tmp_path_factory: pytest.TempPathFactory, generators: Generators
) -> dict[str, bytes]:
    """The files of 158 small shards."""
    cache = tmp_path_factory.mktemp("long")
    assert generators.wait(generators.start(cache)) == 0
    return files(dataset_folder(LONG, cache))


@needs_signals
@pytest.mark.nightly
def test_a_generation_killed_fifty_times_and_resumed_is_bit_identical(
    tmp_path: Path, generators: Generators, long_undisturbed: dict[str, bytes]
) -> None:
    """Every tenth kill hits a pool of workers. A finished dataset is generated again.

    How many of 50 kills hit a write depends on the machine, so it goes on until 10 have hit one.
    """
    rng = np.random.default_rng(int(time.time()))
    kills = in_a_write = partial = attempt = 0
    while kills < 50 or in_a_write < 10 or partial < 25:
        assert kills < 500
        cache = tmp_path / str(attempt)
        folder = dataset_folder(LONG, cache)
        pool = kills % 10 == 9
        process = generators.start(cache, workers=2 if pool else 1)
        time.sleep(rng.uniform(1.0, 2.5) if pool else rng.uniform(0.0, 0.7))
        os.kill(process, signal.SIGKILL)
        status, there = generators.wait(process), files(folder)
        assert long_undisturbed.items() >= there.items()
        if status == 0:
            assert there == long_undisturbed
            attempt += 1
        else:
            assert status == -signal.SIGKILL
            kills += 1
            in_a_write += bool(leftovers(folder))
            partial += 0 < len(shards(folder)) < 158
    assert generators.wait(generators.start(cache)) == 0
    assert files(folder) == long_undisturbed
    assert not leftovers(folder)


@needs_signals
@pytest.mark.slow
def test_several_processes_may_generate_one_dataset(
    tmp_path: Path, generators: Generators, long_undisturbed: dict[str, bytes]
) -> None:
    folder = dataset_folder(LONG, tmp_path)
    first, second, killed = (generators.start(tmp_path) for _ in range(3))
    time.sleep(1.5)
    os.kill(killed, signal.SIGKILL)
    late = generators.start(tmp_path)  # removes leftovers while others write
    assert generators.wait(killed) == -signal.SIGKILL
    assert [generators.wait(process) for process in (first, second, late)] == [0, 0, 0]
    assert files(folder) == long_undisturbed
    assert generators.wait(generators.start(tmp_path)) == 0
    assert not leftovers(folder)


# Clusters


MANY = tiny_spec(100)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of 21 shards, solved in this process."""
    return files(generate(MANY, workers=1, cache=tmp_path_factory.mktemp("many")))


@needs_signals
@pytest.mark.slow
def test_a_cluster_may_lose_a_worker(tmp_path: Path, many: dict[str, bytes]) -> None:
    with Cluster(tmp_path / "cluster", ("first", "second")) as cluster:
        from distributed import Client

        with Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            workers = client.scheduler_info()["workers"].items()
            names = {address: worker["name"] for address, worker in workers}
            killed: list[str] = []

            def kill_one_at_work(done: int, total: int) -> None:
                # A running task may finish before it is found; then try after the next shard.
                if done >= total // 2 and not killed:
                    at_work = client.processing().items()
                    busy = [names[address] for address, tasks in at_work if tasks]
                    for name in busy[:1] or ["first"] * (done >= total - 2):
                        cluster.processes[name].kill()
                        killed.append(name)

            options: dict[str, Any] = {"cache": tmp_path, "cluster": cluster.address}
            folder = generate(MANY, progress=kill_one_at_work, **options)
            assert len(client.nthreads()) == 1
        assert cluster.processes[killed[0]].wait() == -signal.SIGKILL
    assert files(folder) == many


@needs_signals
@pytest.mark.slow
@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("scheduler", r"connection to the Dask scheduler .* was lost\. Finished shards are kept"),
        ("only", r"died one after the other.* memory\?"),
    ],
)
def test_a_cluster_without_scheduler_or_workers_keeps_finished_shards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, many: dict[str, bytes], lost: str, message: str
) -> None:
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    with Cluster(tmp_path / "cluster", ("only",)) as cluster:

        def kill(done: int, total: int) -> None:
            if done >= total // 2:
                cluster.processes[lost].kill()

        with pytest.raises(WorkerError, match=message):
            generate(MANY, cache=tmp_path, progress=kill, cluster=cluster.address)
    folder = dataset_folder(MANY, tmp_path)
    assert many.items() >= files(folder).items()
    assert len(shards(folder)) >= 10
    generate(MANY, workers=1, cache=tmp_path)
    assert files(folder) == many


@pytest.mark.slow
def test_a_cluster_without_workers_or_scheduler_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mor_bench.snapshots.executors.CONNECT_S", 2)
    no_workers = r"has no workers; start some with: dask worker tcp"
    with Cluster(tmp_path / "cluster", ()) as cluster, pytest.raises(WorkerError, match=no_workers):
        generate(MANY, cache=tmp_path, cluster=cluster.address)
    gone = r"no Dask scheduler answers at tcp://127\.0\.0\.1:\d+ within 2 s"
    with pytest.raises(WorkerError, match=gone):
        generate(MANY, cache=tmp_path, cluster=cluster.address)


@pytest.mark.slow
def test_a_silent_peer_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("mor_bench.snapshots.executors.CONNECT_S", 1)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        begun = time.perf_counter()
        with pytest.raises(WorkerError, match="no Dask scheduler answers"), cluster_pool(address):
            pass
        assert time.perf_counter() - begun < 30
