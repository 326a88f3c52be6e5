"""The store and the generation: nothing lost, nothing doubled, nothing damaged unnoticed, whatever is killed, full or lost."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    DamagedFileWarning,
    InvalidInputError,
    MissingDependencyError,
    NewerSchemaError,
    StoreError,
    WorkerError,
)
from mor_bench.snapshots import generate as generate_module
from mor_bench.snapshots import manifest as manifest_module
from mor_bench.snapshots import store
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.executors import Pool, cluster_pool, worker_pool
from mor_bench.snapshots.generate import dataset_folder, generate, generation_seconds, shard_path
from mor_bench.snapshots.manifest import read_manifest
from mor_bench.snapshots.solve import pack
from mor_bench.snapshots.store import (
    HEADER_BYTES,
    parse_shard,
    read_shard,
    remove_leftovers,
    shard_bytes,
    write_shard,
)
from mor_bench.specs import DatasetSpec, load_generated_spec
from tests.generator_process import Generators

ROOT = Path(__file__).parents[1]

SMALL = 10
"""Samples per shard in the tests that need many shards."""

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL and fork")


def tiny_spec(samples_per_patch: int = 10, young_pa: float = 500.0, seed: int = 0) -> DatasetSpec:
    """beam-tiny with 21 times as many samples."""
    spec = load_generated_spec("beam-tiny").model_dump()
    changed = {"samples_per_patch": samples_per_patch, "seed": seed}
    return DatasetSpec.model_validate(
        {
            **spec,
            "material": {**spec["material"], "young_pa": young_pa},
            "loads": {**spec["loads"], **changed},
        }
    )


LONG = tiny_spec(75)


def files(folder: Path) -> dict[str, bytes]:
    """All that must be the same however often generation was disturbed: not the timings, nor what is not committed."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.glob("[!.]*"))
        if not path.name.startswith("seconds-")
    }


def shards(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files(folder).items() if name.startswith("shard-")}


def leftovers(folder: Path) -> list[Path]:
    return list(folder.glob("*.tmp")) + list(folder.glob(".*.tmp"))


@pytest.fixture(scope="module")
def content(cache: Path, tiny: Dataset) -> bytes:
    """A shard of ten samples."""
    return (dataset_folder(load_generated_spec("beam-tiny"), cache) / "shard-00002.h5").read_bytes()


# One shard


def test_a_shard_comes_back_as_it_was(content: bytes) -> None:
    assert shard_bytes(parse_shard(content, "it")) == content
    shard = parse_shard(content, "it")
    assert (shard.start, shard.patches.shape, shard.displacements.shape) == (
        200,
        (10, 1),
        (10, 162),
    )


def test_any_flipped_bit_is_noticed(content: bytes) -> None:
    rng = np.random.default_rng(0)
    every = [(place, bit) for place in range(HEADER_BYTES) for bit in range(8)]
    for place, bit in [
        *every,
        *zip(rng.integers(0, len(content), 1000), rng.integers(0, 8, 1000), strict=True),
    ]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(bit)
        with pytest.raises(StoreError, match=r"^it: "):
            parse_shard(bytes(flipped), "it")


def test_a_file_truncated_anywhere_says_so(content: bytes) -> None:
    for length in [
        *range(0, HEADER_BYTES, 7),
        *np.linspace(HEADER_BYTES, len(content) - 1, 100).astype(int),
    ]:
        with pytest.raises(
            StoreError, match="truncated" if length >= HEADER_BYTES else "header|not a shard"
        ):
            parse_shard(content[:length], "it")
    with pytest.raises(StoreError, match="length is not that"):
        parse_shard(content + b"\0", "it")


def test_no_other_digit_of_the_length_is_accepted(content: bytes) -> None:
    start = content.index(b'"bytes": ') + 9
    for place in range(start, content.index(b",", start)):
        for byte in range(256):
            if byte != content[place]:
                with pytest.raises(StoreError):
                    parse_shard(content[:place] + bytes([byte]) + content[place + 1 :], "it")


def foreign_hdf5(userblock: int = 0) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=userblock) as file:
        file["patches"] = np.zeros(3)
    return buffer.getvalue()


def with_other_fields() -> bytes:
    """A foreign HDF5 file under a header as we write it."""
    body = foreign_hdf5(HEADER_BYTES)[HEADER_BYTES:]
    return store.header_line(store.SCHEMA_VERSION, len(body), hashlib.sha256(body).hexdigest()) + body


def of_schema(content: bytes, version: int) -> bytes:
    old, new = (b'"schema_version": %d' % number for number in (store.SCHEMA_VERSION, version))
    assert old in content
    return content.replace(old, new)


DAMAGE: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "truncated": (lambda content: content[:-9], "truncated"),
    "foreign": (lambda content: b"PK" + content, "not a shard"),
    "foreign HDF5": (lambda content: foreign_hdf5(), "not a shard"),
    "other fields": (lambda content: with_other_fields(), "not that of a shard"),
    "empty": (lambda content: b"", "not a shard"),
    "older": (
        lambda content: of_schema(content, 1),
        "schema version 1.*generate the dataset again",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_files_say_what_they_are_and_are_made_again(
    tmp_path: Path, cache: Path, tiny: Dataset, name: str
) -> None:
    spec = load_generated_spec("beam-tiny")
    folder = dataset_folder(spec, tmp_path)
    shutil.copytree(dataset_folder(spec, cache), folder)
    before = files(folder)
    damage, message = DAMAGE[name]
    path = folder / "shard-00001.h5"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StoreError, match=message):
        read_shard(path)
    untouched = (folder / "shard-00000.h5").stat().st_mtime_ns
    generate(spec, workers=1, cache=tmp_path)
    assert files(folder) == before
    assert (folder / "shard-00000.h5").stat().st_mtime_ns == untouched


@pytest.mark.parametrize(
    "other",
    ["number", "seed", "material", "start", "forces", "fewer", "unknowns", "not solved", "dataset"],
)
def test_a_sound_shard_that_does_not_belong_there_is_made_again(tmp_path: Path, other: str) -> None:
    spec = tiny_spec()
    folder = generate(spec, limit=200, workers=1, cache=tmp_path)
    before = files(folder)
    path = folder / "shard-00001.h5"
    shard = read_shard(path)
    if other in ("seed", "material"):
        changed = tiny_spec(seed=1) if other == "seed" else tiny_spec(young_pa=600.0)
        shutil.copy(
            generate(changed, limit=200, workers=1, cache=tmp_path / "other") / path.name, path
        )
    elif other == "number":
        shutil.copy(folder / "shard-00000.h5", path)
    elif other == "fewer":
        write_shard(path, shard.first(99))
    else:
        changes: dict[str, dict[str, Any]] = {
            "start": {"start": 0},
            "forces": {"vectors": shard.vectors * (1 + 1e-6)},
            "unknowns": {"displacements": shard.displacements[:, :-1]},
            "not solved": {"displacements": np.full_like(shard.displacements, np.nan)},
            "dataset": {"dataset": "another"},
        }
        write_shard(path, replace(shard, **changes[other]))
    assert files(folder) != before
    generate(spec, limit=200, workers=1, cache=tmp_path)
    assert files(folder) == before


def test_round_off_of_another_processor_is_not_damage(tmp_path: Path) -> None:
    spec = tiny_spec()
    path = generate(spec, limit=100, workers=1, cache=tmp_path) / "shard-00000.h5"
    shard = read_shard(path)
    write_shard(path, replace(shard, vectors=np.nextafter(shard.vectors, 9.0)))
    before = path.read_bytes()
    generate(spec, limit=100, workers=1, cache=tmp_path)
    assert path.read_bytes() == before


# Generation


def test_worker_count_changes_no_bit(tmp_path: Path, cache: Path, tiny: Dataset) -> None:
    spec = load_generated_spec("beam-tiny")
    parallel = generate(spec, workers=2, cache=tmp_path)
    assert files(parallel) == files(dataset_folder(spec, cache))
    assert len(shards(parallel)) == 3
    assert generation_seconds(spec, tmp_path, 210) is not None


def test_a_limit_is_a_prefix_and_progress_counts_what_is_wanted(
    tmp_path: Path, cache: Path, tiny: Dataset
) -> None:
    spec = load_generated_spec("beam-tiny")
    told: list[tuple[int, int]] = []
    first = generate(
        spec, limit=120, workers=1, cache=tmp_path, progress=lambda *counts: told.append(counts)
    )
    assert list(shards(first)) == ["shard-00000.h5", "shard-00001.h5"]
    assert told == [(0, 120), (100, 120), (120, 120)]
    told.clear()
    again = generate(spec, workers=1, cache=tmp_path, progress=lambda *counts: told.append(counts))
    assert told == [(200, 210), (210, 210)]
    assert shards(again) == shards(dataset_folder(spec, cache))


def test_no_more_is_in_memory_than_the_window() -> None:
    drawn = finished = widest = 0

    def tasks() -> Iterator[int]:
        nonlocal drawn, widest
        for number in range(200):
            drawn += 1
            widest = max(widest, drawn - finished)
            yield number

    seen = []
    with ThreadPoolExecutor(3) as executor:
        for result in Pool(executor, lambda: 4).in_any_order(lambda number: number**2, tasks()):
            finished += 1
            seen.append(result)
    assert sorted(seen) == [number**2 for number in range(200)]
    assert widest <= 4


def test_a_task_is_modest_and_repeats_nothing_that_can_be_worked_out() -> None:
    scene = mor_bench.load_scene("beam-fine")
    assert np.isfinite(scene.patch_normals).all()
    packed = pack(scene)
    assert len(packed) < 1e6
    there, weights = pickle.loads(packed)
    for item in (there, there.mesh):
        assert set(vars(item)) == {field.name for field in fields(item)}
    np.testing.assert_array_equal(weights.toarray(), scene.patch_weights.toarray())


@needs_signals
def test_a_killed_worker_of_the_pool_is_named_with_its_likely_cause() -> None:
    with (
        pytest.raises(WorkerError, match=r"killed.*memory.*fewer workers than 2.*kept"),
        worker_pool(2) as pool,
    ):
        list(pool.in_any_order(signal.raise_signal, [signal.SIGKILL]))


# The manifest


def test_the_manifest_alone_is_enough_to_generate_the_same_again(
    tmp_path: Path, cache: Path, tiny: Dataset
) -> None:
    original = dataset_folder(load_generated_spec("beam-tiny"), cache)
    manifest = read_manifest(original)
    assert (manifest.n_samples, manifest.shard_size) == (210, 100)
    assert set(manifest.environments[0]) == {
        "mor-bench",
        "python",
        "numpy",
        "scipy",
        "numba",
        "h5py",
        "platform",
        "machine",
    }
    again = generate(manifest.spec, workers=1, cache=tmp_path)
    assert again.name == original.name
    assert files(again) == files(original)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-20], "not a manifest"),
        (lambda content: b"", "not a manifest"),
        (lambda content: b"[1]", "not a manifest"),
        (lambda content: content.replace(b"500.0", b"600.0"), "checksum"),
        (lambda content: of_schema(content, 1), "schema version 1.*generate the dataset again"),
        (
            lambda content: content.replace(manifest_module.FORMAT.encode(), b"another"),
            "not the manifest of a dataset",
        ),
    ],
    ids=["truncated", "empty", "foreign", "changed", "older", "other format"],
)
def test_a_damaged_manifest_says_so_and_is_mended(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    spec = tiny_spec()
    folder = generate(spec, limit=100, workers=1, cache=tmp_path)
    path, before = folder / "manifest.json", files(folder)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StoreError, match=message):
        read_manifest(folder)
    (folder / "shard-00000.h5").unlink()
    generate(spec, limit=100, workers=1, cache=tmp_path)
    assert files(folder) == before


def test_every_environment_that_solved_is_in_the_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = tiny_spec()
    folder = generate(spec, limit=100, workers=1, cache=tmp_path)
    here = read_manifest(folder).environments
    monkeypatch.setattr(manifest_module, "this_environment", lambda: {"machine": "another"})
    generate(spec, limit=100, workers=1, cache=tmp_path)
    assert read_manifest(folder).environments == here
    generate(spec, limit=200, workers=1, cache=tmp_path)
    assert read_manifest(folder).environments == (*here, {"machine": "another"})


# Full disks


class FullDisk:
    """Stands in for `open`: files on a disk that takes no more than some bytes in all."""

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


@contextmanager
def tmpfs(folder: Path) -> Iterator[Path]:
    """A file system of 16 kB in memory."""
    folder.mkdir()
    if not sys.platform.startswith("linux") or shutil.which("mount") is None:
        pytest.skip("needs Linux and mount")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"needs the right to mount a small file system: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def fill_until_done(
    spec: DatasetSpec, cache: Path, undisturbed: dict[str, bytes], make_room: Callable[[], None]
) -> int:
    """Generate again and again, with more room each time; how often the disk was full."""
    folder = dataset_folder(spec, cache)
    for failures in range(200):
        make_room()
        message = None
        try:
            generate(spec, workers=1, cache=cache)
        except StoreError as error:
            message = str(error)
        assert not leftovers(folder)
        if message is None:
            assert files(folder) == undisturbed
            return failures
        assert message.startswith(
            f"{folder}: cannot be written: No space left on device. Finished shards are kept"
        )
        assert undisturbed.items() >= files(folder).items()
    raise AssertionError("the disk is still full")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of 42 small shards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate_module, "SHARD_SIZE", SMALL)
        return files(
            generate(tiny_spec(20), workers=1, cache=tmp_path_factory.mktemp("undisturbed"))
        )


def test_a_disk_that_is_full_ten_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, bytes]
) -> None:
    monkeypatch.setattr(generate_module, "SHARD_SIZE", SMALL)
    rng, size_kb = np.random.default_rng(0), 16

    def make_room() -> None:
        nonlocal size_kb
        size_kb += 4 * int(rng.integers(1, 20))
        subprocess.run(
            ["mount", "-o", f"remount,size={size_kb}k", str(tmp_path / "disk")], check=True
        )

    with tmpfs(tmp_path / "disk") as disk:
        assert fill_until_done(tiny_spec(20), disk, undisturbed, make_room) >= 10


def test_writes_that_fail_at_any_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, bytes]
) -> None:
    monkeypatch.setattr(generate_module, "SHARD_SIZE", SMALL)
    rng = np.random.default_rng(0)

    def make_room() -> None:
        monkeypatch.setattr(store, "open", FullDisk(int(rng.integers(0, 80_000))), raising=False)

    assert fill_until_done(tiny_spec(20), tmp_path, undisturbed, make_room) >= 10


def test_a_failed_write_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    shard = parse_shard(content, "it")
    write_shard(tmp_path / "shard.h5", shard)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path / "shard.h5", replace(shard, start=0))
    assert [path.name for path in tmp_path.iterdir()] == ["shard.h5"]
    assert (tmp_path / "shard.h5").read_bytes() == content


# Killed and competing processes


@needs_signals
def test_leftovers_of_the_dead_are_removed_and_files_of_the_living_are_not(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host, living = store.host_name(), os.getppid()
    names = {
        f".a.h5.{host}.{dead.pid}.00.tmp": False,
        f".b.h5.{host}.{living}.00.tmp": True,
        f".c.h5.elsewhere.{dead.pid}.00.tmp": True,
        f".d.h5.{host}.{living}.01.tmp": False,
        ".of-someone-else.tmp": True,
        "shard-00000.h5": True,
    }
    for name in names:
        (tmp_path / name).touch()
    an_hour_ago = time.time() - store.STALE_AFTER_S - 1
    os.utime(tmp_path / f".d.h5.{host}.{living}.01.tmp", (an_hour_ago, an_hour_ago))
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        name for name, stays in names.items() if stays
    }


@pytest.fixture(scope="module")
def generators() -> Iterator[Generators]:
    with Generators(LONG.model_dump_json(), SMALL) as processes:
        yield processes


@pytest.fixture(scope="module")
def long_undisturbed(
    tmp_path_factory: pytest.TempPathFactory, generators: Generators
) -> dict[str, bytes]:
    """The files of 157 small shards."""
    cache = tmp_path_factory.mktemp("long")
    assert generators.wait(generators.start(cache)) == 0
    return files(dataset_folder(LONG, cache))


@needs_signals
def test_killed_fifty_times_and_resumed_is_bit_identical(
    tmp_path: Path, generators: Generators, long_undisturbed: dict[str, bytes]
) -> None:
    """Every tenth time with a pool of workers, whose start takes longer. Beyond its end a dataset is begun anew."""
    rng = np.random.default_rng(int(time.time()))
    kills = in_a_write = partial = attempt = 0
    while kills < 50:
        cache = tmp_path / str(attempt)
        folder = dataset_folder(LONG, cache)
        pool = kills % 10 == 9
        process = generators.start(cache, workers=2 if pool else 1)
        time.sleep(rng.uniform(1.0, 2.5) if pool else rng.uniform(0.0, 0.7))
        os.kill(process, signal.SIGKILL)
        status = generators.wait(process)
        there = files(folder)
        assert long_undisturbed.items() >= there.items()
        if status == 0:
            assert there == long_undisturbed
            attempt += 1
        else:
            assert status == -signal.SIGKILL
            kills += 1
            in_a_write += bool(leftovers(folder))
            partial += 0 < len(shards(folder)) < 158
    assert in_a_write >= 10
    assert partial >= 25
    assert generators.wait(generators.start(cache)) == 0
    assert files(folder) == long_undisturbed
    assert not leftovers(folder)


@needs_signals
def test_generators_at_once_on_one_dataset(
    tmp_path: Path, generators: Generators, long_undisturbed: dict[str, bytes]
) -> None:
    folder = dataset_folder(LONG, tmp_path)
    first, second, killed = (generators.start(tmp_path) for _ in range(3))
    time.sleep(1.5)
    os.kill(killed, signal.SIGKILL)
    late = generators.start(tmp_path)  # tidies up while others write
    assert generators.wait(killed) == -signal.SIGKILL
    assert [generators.wait(process) for process in (first, second, late)] == [0, 0, 0]
    assert files(folder) == long_undisturbed
    assert generators.wait(generators.start(tmp_path)) == 0
    assert not leftovers(folder)


# Clusters


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "`workers` must be an integer >= 1; got 0"),
        (
            {"workers": 2, "cluster": "tcp://127.0.0.1:8786"},
            "`workers` and `cluster` exclude each other",
        ),
        ({"cluster": "127.0.0.1:8786"}, r"tcp://host:port; got '127.0.0.1:8786'"),
        ({"cluster": "tcp://127.0.0.1"}, "tcp://host:port"),
        ({"cluster": "http://127.0.0.1:8786"}, "tcp://host:port"),
    ],
)
def test_where_to_solve_is_checked_before_anything_is_done(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    for function in (generate, mor_bench.load_dataset):
        with pytest.raises(InvalidInputError, match=message):
            function(tiny_spec(), cache=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_without_the_extra_a_cluster_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'mor-bench\[cluster\]'"):
        generate(tiny_spec(), cache=tmp_path, cluster="tcp://127.0.0.1:1")


class Cluster:
    """A Dask scheduler and workers over TCP, in processes of their own, with no folder of ours."""

    def __init__(self, folder: Path, workers: tuple[str, ...]) -> None:
        pytest.importorskip("distributed", reason="needs pip install 'mor-bench[cluster]'")
        folder.mkdir()
        file = folder / "scheduler.json"
        self._folder, self.processes = folder, {}
        self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)
        )
        limit = time.time() + 60
        while not file.exists() or not file.stat().st_size:
            assert time.time() < limit, "the scheduler does not start"
            time.sleep(0.05)
        self.address: str = json.loads(file.read_text())["address"]
        for name in workers:
            self._start("worker", self.address, "--no-nanny", "--nthreads", "1", "--name", name)

    processes: dict[str, subprocess.Popen[bytes]]

    def _start(self, kind: str, *options: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
        with open(self._folder / f"{kind}-{len(self.processes)}.log", "wb") as log:
            self.processes[options[-1] if kind == "worker" else kind] = subprocess.Popen(
                command, cwd=self._folder, env=environment, stdout=log, stderr=log
            )

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of 42 shards, solved in this process."""
    return files(generate(tiny_spec(200), workers=1, cache=tmp_path_factory.mktemp("many")))


@needs_signals
def test_a_cluster_that_loses_a_worker_half_way(tmp_path: Path, many: dict[str, bytes]) -> None:
    with Cluster(tmp_path / "cluster", ("first", "second")) as cluster:
        from distributed import Client

        with Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            names = {
                address: worker["name"]
                for address, worker in client.scheduler_info()["workers"].items()
            }
            killed: list[str] = []

            def kill_one_at_work(done: int, total: int) -> None:
                if (
                    done >= total // 2 and not killed
                ):  # what is in flight may be done when it is looked for: then after the next shard
                    busy = [
                        names[address] for address, tasks in client.processing().items() if tasks
                    ]
                    for name in busy[:1] or ["first"] * (done >= total - 2):
                        cluster.processes[name].kill()
                        killed.append(name)

            folder = generate(
                tiny_spec(200), cache=tmp_path, progress=kill_one_at_work, cluster=cluster.address
            )
            assert len(client.nthreads()) == 1
        assert cluster.processes[killed[0]].wait() == -signal.SIGKILL
    assert files(folder) == many


@needs_signals
@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("scheduler", r"connection to the Dask scheduler .* was lost\. Finished shards are kept"),
        ("only", r"died one after the other.* memory\?"),
    ],
)
def test_a_cluster_that_loses_what_it_cannot_do_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, many: dict[str, bytes], lost: str, message: str
) -> None:
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    with Cluster(tmp_path / "cluster", ("only",)) as cluster:

        def kill(done: int, total: int) -> None:
            if done >= total // 2:
                cluster.processes[lost].kill()

        with pytest.raises(WorkerError, match=message):
            generate(tiny_spec(200), cache=tmp_path, progress=kill, cluster=cluster.address)
    folder = dataset_folder(tiny_spec(200), tmp_path)
    assert many.items() >= files(folder).items()
    assert len(shards(folder)) >= 21
    generate(tiny_spec(200), workers=1, cache=tmp_path)
    assert files(folder) == many


def test_a_cluster_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mor_bench.snapshots.executors.CONNECT_S", 2)
    with (
        Cluster(tmp_path / "cluster", ()) as cluster,
        pytest.raises(WorkerError, match=r"has no workers; start some with: dask worker tcp"),
    ):
        generate(tiny_spec(), cache=tmp_path, cluster=cluster.address)
    with pytest.raises(
        WorkerError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:\d+ within 2 s"
    ):
        generate(tiny_spec(), cache=tmp_path, cluster=cluster.address)


def test_newer_files_are_kept_and_damaged_ones_named(tmp_path: Path, content: bytes) -> None:
    spec = load_generated_spec("beam-tiny")
    folder = generate(spec, workers=1, cache=tmp_path)
    path = shard_path(folder, 1)
    sound = path.read_bytes()
    newer = of_schema(sound, 9)
    path.write_bytes(newer)
    with pytest.raises(NewerSchemaError, match=r"schema version 9; .* update mor-bench"):
        generate(spec, workers=1, cache=tmp_path)
    assert path.read_bytes() == newer
    path.write_bytes(sound)
    manifest = folder / "manifest.json"
    before = manifest.read_bytes()
    manifest.write_bytes(of_schema(before, 9))
    with pytest.raises(NewerSchemaError, match="schema version 9"):
        generate(spec, workers=1, cache=tmp_path)
    assert manifest.read_bytes() == of_schema(before, 9)
    manifest.write_bytes(before)
    for spoilt in (b"a note of mine", sound[:-1], shard_path(folder, 0).read_bytes()):
        path.write_bytes(spoilt)
        with pytest.warns(DamagedFileWarning, match=r"shard-00001\.h5: .* generated again"):
            generate(spec, workers=1, cache=tmp_path)
        assert path.read_bytes() == sound


def test_a_folder_in_the_place_of_a_shard_is_an_error_of_the_store(tmp_path: Path) -> None:
    spec = load_generated_spec("beam-tiny")
    path = shard_path(dataset_folder(spec, tmp_path), 0)
    path.mkdir(parents=True)
    with pytest.raises(StoreError, match="cannot be read"):
        read_shard(path)
    with pytest.warns(DamagedFileWarning), pytest.raises(StoreError, match="cannot be written"):
        generate(spec, workers=1, cache=tmp_path)


def test_a_peer_that_stays_silent_is_given_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_dataset_of_a_users_file_is_made_again_from_its_folder_alone(tmp_path: Path) -> None:
    mesh = mor_bench.load_scene("beam-tiny").mesh
    body = tmp_path / "body.vtu"
    meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)]).write(body)
    content = {
        **load_generated_spec("beam-tiny").model_dump(mode="json"),
        "geometry": {"shape": "file", "file": str(body)},
    }
    spec = DatasetSpec.model_validate(content)
    folder = generate(spec, 100, workers=1, cache=tmp_path / "one")
    body.unlink()
    kept = read_manifest(folder).spec
    assert kept.digest() == spec.digest()
    again = generate(kept, 100, workers=1, cache=tmp_path / "two")
    assert shard_path(again, 0).read_bytes() == shard_path(folder, 0).read_bytes()
