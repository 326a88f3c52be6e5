"""The store loses and repeats nothing, and notices all damage."""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
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
from mor_bench.snapshots import manifest as manifest_module
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.executors import Pool, worker_pool
from mor_bench.snapshots.generate import dataset_folder, generate, generation_seconds, shard_path
from mor_bench.snapshots.manifest import read_manifest
from mor_bench.snapshots.solve import pack
from mor_bench.snapshots.store import (
    HEADER_BYTES,
    SCHEMA_VERSION,
    header_line,
    parse_shard,
    read_shard,
    shard_bytes,
    write_shard,
)
from mor_bench.specs import DatasetSpec, load_generated_spec
from tests.generator_process import files, shards

SPEC = load_generated_spec("beam-tiny")


@pytest.fixture(scope="module")
def original(cache: Path, tiny: Dataset) -> Path:
    """The folder of beam-tiny; tests must not change it."""
    return dataset_folder(SPEC, cache)


@pytest.fixture
def folder(tmp_path: Path, original: Path) -> Path:
    """A copy of the folder of beam-tiny, with the cache folder `tmp_path`."""
    return Path(shutil.copytree(original, dataset_folder(SPEC, tmp_path)))


@pytest.fixture(scope="module")
def content(original: Path) -> bytes:
    """A shard of ten samples."""
    return shard_path(original, 2).read_bytes()


# One shard


def test_a_shard_comes_back_as_it_was(content: bytes) -> None:
    shard = parse_shard(content, "it")
    assert shard_bytes(shard) == content
    assert (shard.start, shard.patches.shape, shard.displacements.shape) == (
        200,
        (10, 1),
        (10, 162),
    )


def test_any_flipped_bit_is_noticed(content: bytes) -> None:
    rng = np.random.default_rng(0)
    flips = [(place, bit) for place in range(HEADER_BYTES) for bit in range(8)]
    flips += zip(rng.integers(0, len(content), 1000), rng.integers(0, 8, 1000), strict=True)
    for place, bit in flips:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(bit)
        with pytest.raises(StoreError, match=r"^it: "):
            parse_shard(bytes(flipped), "it")


def test_a_truncated_file_is_reported_as_such(content: bytes) -> None:
    lengths = np.linspace(HEADER_BYTES, len(content) - 1, 100).astype(int)
    for length in [*range(0, HEADER_BYTES, 7), *lengths]:
        message = "truncated" if length >= HEADER_BYTES else "header|not a shard"
        with pytest.raises(StoreError, match=message):
            parse_shard(content[:length], "it")
    with pytest.raises(StoreError, match="its length differs from the length in its header"):
        parse_shard(content + b"\0", "it")


def test_a_changed_digit_of_the_length_is_refused(content: bytes) -> None:
    start = content.index(b'"bytes": ') + 9
    for place in range(start, content.index(b",", start)):
        for byte in {*range(256)} - {content[place]}:
            with pytest.raises(StoreError):
                parse_shard(content[:place] + bytes([byte]) + content[place + 1 :], "it")


def foreign_hdf5(userblock: int = 0) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=userblock) as file:
        file["patches"] = np.zeros(3)
    return buffer.getvalue()


def with_other_fields() -> bytes:
    """Return a foreign HDF5 file under a header of ours."""
    body = foreign_hdf5(HEADER_BYTES)[HEADER_BYTES:]
    return header_line(SCHEMA_VERSION, len(body), hashlib.sha256(body).hexdigest()) + body


def of_schema(content: bytes, version: int) -> bytes:
    old, new = (b'"schema_version": %d' % number for number in (SCHEMA_VERSION, version))
    assert old in content
    return content.replace(old, new)


DAMAGE: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "truncated": (lambda content: content[:-9], "truncated"),
    "foreign": (lambda content: b"PK" + content, "not a shard"),
    "foreign HDF5": (lambda content: foreign_hdf5(), "not a shard"),
    "other fields": (lambda content: with_other_fields(), "not a readable shard"),
    "empty": (lambda content: b"", "not a shard"),
    "older": (lambda content: of_schema(content, 1), "version 1.*generate the dataset again"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_only_a_damaged_shard_is_generated_again(tmp_path: Path, folder: Path, name: str) -> None:
    before, (damage, message) = files(folder), DAMAGE[name]
    path, other = shard_path(folder, 2), shard_path(folder, 0)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StoreError, match=message):
        read_shard(path)
    untouched = other.stat().st_mtime_ns
    with pytest.warns(DamagedFileWarning, match=r"shard-00002\.h5: .* generated again"):
        generate(SPEC, workers=1, cache=tmp_path)
    assert files(folder) == before
    assert other.stat().st_mtime_ns == untouched


CHANGES: dict[str, Callable[[Any], dict[str, Any]]] = {
    "start": lambda shard: {"start": 0},
    "forces": lambda shard: {"vectors": shard.vectors * (1 + 1e-6)},
    "unknowns": lambda shard: {"displacements": shard.displacements[:, :-1]},
    "not solved": lambda shard: {"displacements": np.full_like(shard.displacements, np.nan)},
    "dataset": lambda shard: {"dataset": "another"},
}


@pytest.mark.parametrize("other", ["number", "fewer", *CHANGES])
def test_a_sound_shard_of_other_samples_is_generated_again(
    tmp_path: Path, folder: Path, other: str
) -> None:
    before, path = files(folder), shard_path(folder, 2)
    shard = read_shard(path)
    if other == "number":
        shutil.copy(shard_path(folder, 0), path)
    else:
        changes = CHANGES[other](shard) if other in CHANGES else {}
        write_shard(path, replace(shard.first(9) if other == "fewer" else shard, **changes))
    assert files(folder) != before
    with pytest.warns(DamagedFileWarning, match="holds the wrong samples"):
        generate(SPEC, workers=1, cache=tmp_path)
    assert files(folder) == before


def test_round_off_of_another_processor_is_not_damage(tmp_path: Path, folder: Path) -> None:
    path = shard_path(folder, 2)
    shard = read_shard(path)
    write_shard(path, replace(shard, vectors=np.nextafter(shard.vectors, 9.0)))
    before = path.read_bytes()
    generate(SPEC, workers=1, cache=tmp_path)
    assert path.read_bytes() == before


def test_newer_files_are_kept_and_refused(tmp_path: Path, folder: Path) -> None:
    for path in (shard_path(folder, 1), folder / "manifest.json"):
        sound = path.read_bytes()
        path.write_bytes(of_schema(sound, 9))
        with pytest.raises(NewerSchemaError, match=r"schema version 9; .* update mor-bench"):
            generate(SPEC, workers=1, cache=tmp_path)
        assert path.read_bytes() == of_schema(sound, 9)
        path.write_bytes(sound)


def test_a_folder_with_the_name_of_a_shard_raises_an_error_of_the_store(tmp_path: Path) -> None:
    path = shard_path(dataset_folder(SPEC, tmp_path), 0)
    path.mkdir(parents=True)
    with pytest.raises(StoreError, match="cannot be read"):
        read_shard(path)
    with pytest.warns(DamagedFileWarning), pytest.raises(StoreError, match="cannot be written"):
        generate(SPEC, 10, workers=1, cache=tmp_path)


# Generation


@pytest.mark.slow
def test_the_number_of_workers_changes_no_bit(tmp_path: Path, original: Path) -> None:
    parallel = generate(SPEC, workers=2, cache=tmp_path)
    assert files(parallel) == files(original)
    assert len(shards(parallel)) == 3
    assert generation_seconds(SPEC, tmp_path, 210) is not None


def test_a_limit_takes_the_first_samples_and_progress_counts_them(
    tmp_path: Path, original: Path
) -> None:
    counts: list[tuple[int, int]] = []
    options: dict[str, Any] = {"workers": 1, "cache": tmp_path}
    first = generate(SPEC, 120, **options, progress=lambda *count: counts.append(count))
    assert list(shards(first)) == ["shard-00000.h5", "shard-00001.h5"]
    assert counts == [(0, 120), (100, 120), (120, 120)]
    again = generate(SPEC, **options, progress=lambda *count: counts.append(count))
    assert counts[3:] == [(200, 210), (210, 210)]
    assert shards(again) == shards(original)


def test_the_window_limits_the_tasks_in_memory() -> None:
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


def test_a_task_is_small_and_holds_no_derived_data() -> None:
    scene = mor_bench.load_scene("beam-coarse")
    assert np.isfinite(scene.patch_normals).all()
    packed = pack(scene)
    assert len(packed) < 1e5
    there, weights = pickle.loads(packed)
    for item in (there, there.mesh):
        assert set(vars(item)) == {field.name for field in fields(item)}
    np.testing.assert_array_equal(weights.toarray(), scene.patch_weights.toarray())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_killed_worker_of_the_pool_is_reported_with_its_likely_cause() -> None:
    message = r"killed.*memory.*fewer workers than 2.*kept"
    with pytest.raises(WorkerError, match=message), worker_pool(2) as pool:
        list(pool.in_any_order(signal.raise_signal, [signal.SIGKILL]))


def test_an_interrupt_before_the_pools_thread_starts_keeps_its_type(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unstarted(**_: bool) -> None:
        raise RuntimeError("cannot join thread before it is started")

    def stopped() -> None:
        with worker_pool(1) as pool:
            monkeypatch.setattr(pool.executor, "shutdown", unstarted)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()


ADDRESS = "tcp://127.0.0.1:8786"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "`workers` must be an integer >= 1; got 0"),
        ({"workers": 2, "cluster": ADDRESS}, "`workers` and `cluster` cannot be used together"),
        ({"cluster": "127.0.0.1:8786"}, r"tcp://host:port; got '127.0.0.1:8786'"),
        ({"cluster": "tcp://127.0.0.1"}, "tcp://host:port"),
        ({"cluster": "http://127.0.0.1:8786"}, "tcp://host:port"),
    ],
)
def test_generation_options_are_checked_before_any_work(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    for function in (generate, mor_bench.load_dataset):
        with pytest.raises(InvalidInputError, match=message):
            function(SPEC, cache=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_without_the_extra_a_cluster_gives_the_package_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'mor-bench\[cluster\]'"):
        generate(SPEC, cache=tmp_path, cluster=ADDRESS)


# The manifest


def test_the_manifest_alone_is_enough_to_generate_the_same_again(
    tmp_path: Path, original: Path
) -> None:
    manifest = read_manifest(original)
    assert (manifest.n_samples, manifest.shard_size) == (210, 100)
    versions = {"mor-bench", "python", "numpy", "scipy", "numba", "h5py"}
    assert set(manifest.environments[0]) == versions | {"platform", "machine"}
    again = generate(manifest.spec, workers=1, cache=tmp_path)
    assert again.name == original.name
    assert files(again) == files(original)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-20], "not valid JSON"),
        (lambda content: b"", "not valid JSON"),
        (lambda content: b"[1]", "not a manifest"),
        (lambda content: content.replace(b"500.0", b"600.0"), "checksum"),
        (lambda content: of_schema(content, 1), "version 1.*generate the dataset again"),
        (lambda content: content.replace(b"mor-bench dataset", b"x"), "not the manifest of"),
    ],
    ids=["truncated", "empty", "foreign", "changed", "older", "other format"],
)
def test_a_damaged_manifest_is_reported_and_rewritten(
    tmp_path: Path, folder: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path, before = folder / "manifest.json", files(folder)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StoreError, match=message):
        read_manifest(folder)
    shard_path(folder, 2).unlink()
    generate(SPEC, workers=1, cache=tmp_path)
    assert files(folder) == before


def test_every_environment_that_solved_is_in_the_manifest(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = read_manifest(folder).environments
    monkeypatch.setattr(manifest_module, "this_environment", lambda: {"machine": "another"})
    generate(SPEC, workers=1, cache=tmp_path)
    assert read_manifest(folder).environments == here
    shard_path(folder, 2).unlink()
    generate(SPEC, workers=1, cache=tmp_path)
    assert read_manifest(folder).environments == (*here, {"machine": "another"})


def test_a_dataset_of_a_users_mesh_file_can_be_generated_from_its_folder_alone(
    tmp_path: Path,
) -> None:
    mesh, body = mor_bench.load_scene("beam-tiny").mesh, tmp_path / "body.vtu"
    meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)]).write(body)
    geometry = {"shape": "file", "file": str(body)}
    spec = DatasetSpec.model_validate({**SPEC.model_dump(mode="json"), "geometry": geometry})
    folder = generate(spec, 10, workers=1, cache=tmp_path / "one")
    body.unlink()
    kept = read_manifest(folder).spec
    assert kept.digest() == spec.digest()
    again = generate(kept, 10, workers=1, cache=tmp_path / "two")
    assert shard_path(again, 0).read_bytes() == shard_path(folder, 0).read_bytes()
