"""Nothing of a bad archive reaches the cache, and each gets one clear line."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.errors import MorBenchError, StoreError
from mor_bench.snapshots.archive_files import SUMS
from mor_bench.snapshots.archive_import import import_archive
from mor_bench.specs import load_generated_spec
from tests.archives import (
    S0,
    S1,
    S2,
    ZEROS,
    Damage,
    append_sum,
    change_manifest,
    change_shard,
    flip,
    forged,
    link,
    listed_again,
    own_dataset,
    packed,
    put,
    remove,
    replace_text,
    tiny_folder,
)
from tests.mutations import mutated_bytes

# Bad archives


def write_sparse(name: str, size: int) -> Damage:
    return lambda folder: os.truncate(folder / name, size)


def spoil(array: np.ndarray) -> np.ndarray:
    array[0] = np.nan
    return array


BAD: dict[str, tuple[Damage, str]] = {
    "flipped bit": (flip(S0), f"{S0}: damaged: its SHA-256 differs"),
    "flipped bit in the card": (flip("README.md"), "README.md: damaged"),
    "flipped bit in a checksum": (flip(SUMS, 3), "damaged|line 1 is not"),
    "truncated": (write_sparse(S1, 5000), f"{S1}: damaged"),
    "lost shard": (remove(S1), f"incomplete: {S1} is missing"),
    "lost shard, forged": (forged(remove(S1)), f"incomplete: `beam-tiny` needs {S1}"),
    "lost manifest, forged": (forged(remove("samples/manifest.json")), "incomplete"),
    "no checksums": (remove(SUMS), f"no archive of a dataset: {SUMS} is missing"),
    "no dataset": (forged(remove("beam-tiny.toml")), "must hold one dataset file; got 0"),
    "two datasets": (forged(put("b.toml", b"")), "must hold one dataset file; got 2"),
    "not listed": (put("samples/shard-00009.h5", b"x"), f"has no checksum in {SUMS}"),
    "too many": (forged(put("samples/shard-00009.h5", b"x")), "has no such shard"),
    "pickle": (put("samples/a.pkl", pickle.dumps(print)), "no file of an archive"),
    "pickle, forged": (forged(put("samples/a.pkl", pickle.dumps(print))), "no file of an archive"),
    "pickle as shard": (forged(put(S1, pickle.dumps(print))), f"{S1}: not a shard"),
    "hidden file": (put(".profile", b"x"), "no file of an archive"),
    "other folder": (put("more/README.md", b"x"), "no file of an archive"),
    "path out": (append_sum(f"{ZEROS}  ../../x"), r"line \d+ is not the checksum"),
    "absolute path": (append_sum(f"{ZEROS}  /etc/passwd"), r"line \d+ is not the checksum"),
    "escape": (append_sum(f"{ZEROS}  \x1b[31m"), r"line \d+ is not the checksum"),
    "listed twice": (append_sum(f"{ZEROS}  {S0}"), r"line \d+ is not the checksum"),
    "list of itself": (append_sum(f"{ZEROS}  {SUMS}"), r"line \d+ is not the checksum"),
    "huge card": (write_sparse("README.md", 2**21), "files of this kind have at most 1,048,576"),
    "huge list": (write_sparse(SUMS, 2**27), "files of this kind have at most 67,108,864"),
    "huge shard": (forged(write_sparse(S2, 2**21)), "its samples take at most"),
    "wrong order": (
        forged(lambda f: shutil.copy(f / S0, f / S1)),
        f"{S1}: holds the wrong samples",
    ),
    "other loads": (forged(change_shard(S0, vectors=lambda v: 2 * v)), "holds the wrong samples"),
    "NaN": (forged(change_shard(S0, displacements=spoil)), "holds the wrong samples"),
    "bad status": (forged(change_shard(S0, status=lambda s: s + 9)), "holds the wrong samples"),
    "short": (forged(change_shard(S0, patches=lambda p: p[:5])), "holds the wrong samples"),
    "time": (forged(put("samples/seconds-00000.txt", b"soon")), "must hold a number of seconds"),
    "version": (
        forged(change_manifest("samples/manifest.json", generator_version=2)),
        "samples of version 2; this version of mor-bench generates",
    ),
    "schema": (
        forged(change_manifest("samples/manifest.json", schema_version=99)),
        "archive/samples/manifest.json: schema version 99",
    ),
    "count": (
        forged(change_manifest("samples/manifest.json", n_samples=100)),
        "is about other samples",
    ),
    "other physics": (
        forged(replace_text("beam-tiny.toml", "young_pa = 500.0", "young_pa = 600.0")),
        "is about other samples",
    ),
    "invalid dataset": (
        forged(replace_text("beam-tiny.toml", "poisson = 0.4", "poisson = 0.9")),
        "archive/beam-tiny.toml",
    ),
    "unknown set": (forged(put("tests/mine/manifest.json", b"{}")), "there is no such test set"),
    "useless mesh": (forged(put("source-0123456789ab.vtu", b"x")), "names other files than"),
    "imported": (
        forged(put("beam-tiny.toml", b'[snapshots]\nfile = "../../x.npz"\n')),
        "archive/beam-tiny.toml|no such file",
    ),
}


def refused(archive: Path, cache: Path, message: str) -> None:
    """Check that an archive gives one clear line, and leaves nothing in the cache."""
    with pytest.raises(MorBenchError, match=message) as caught:
        import_archive(archive, cache)
    text = str(caught.value)
    assert "\n" not in text
    assert "\x1b" not in text
    assert "mor-bench-" not in text.replace(str(archive), "")  # no temporary folder
    assert not cache.exists()


@pytest.mark.parametrize("how", BAD)
def test_a_bad_archive_is_refused_and_leaves_nothing(
    how: str, archive_copy: Path, tmp_path: Path
) -> None:
    damage, message = BAD[how]
    damage(archive_copy)
    refused(archive_copy, tmp_path / "cache", message)


def test_a_file_outside_that_the_dataset_names_is_refused(
    archive_copy: Path, tmp_path: Path
) -> None:
    own_dataset(tmp_path / "outside")
    shutil.copy(tmp_path / "outside" / "own.toml", archive_copy / "beam-tiny.toml")
    outside = json.dumps(str(tmp_path / "outside" / "body.vtu"))
    replace_text("beam-tiny.toml", '"body.vtu"', outside)(archive_copy)
    listed_again(archive_copy)
    refused(archive_copy, tmp_path / "cache", "names other files than")


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
@pytest.mark.parametrize(("name", "is_folder"), [(S1, False), ("samples", True), (SUMS, False)])
def test_links_are_refused(name: str, is_folder: bool, archive_copy: Path, tmp_path: Path) -> None:
    link(name, tmp_path / "target", is_folder)(archive_copy)
    refused(archive_copy, tmp_path / "cache", "a link; an archive of a dataset holds none")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused_without_waiting(archive_copy: Path, tmp_path: Path) -> None:
    (archive_copy / S1).unlink()
    os.mkfifo(archive_copy / S1)
    refused(archive_copy, tmp_path / "cache", "no file of an archive")


def test_things_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", tmp_path / "cache", "no archive of a dataset")
    (tmp_path / "file.zip").write_bytes(b"PK\x03\x04 no archive")
    refused(tmp_path / "file.zip", tmp_path / "cache", "not a readable folder or ZIP file")
    with pytest.raises(FileNotFoundError):
        import_archive(tmp_path / "nothing", tmp_path / "cache")


def test_the_archive_of_another_dataset_is_refused(sound_archive: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="other physics than `beam-coarse`"):
        import_archive(sound_archive, tmp_path / "cache", load_generated_spec("beam-coarse"))
    assert not (tmp_path / "cache").exists()


# Bad ZIP files


def zipped(sound_archive: Path, **changes: Any) -> bytes:
    """Return the archive as a ZIP file in which the member of the second shard is changed."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(p for p in sound_archive.rglob("*") if p.is_file()):
            info = zipfile.ZipInfo(f"top/{path.relative_to(sound_archive).as_posix()}")
            if info.filename.endswith(S1):
                for name, value in changes.items():
                    setattr(info, name, value)
            archive.writestr(info, path.read_bytes())
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filename": "top/../../x"}, "no file of an archive"),
        ({"filename": "/etc/x"}, "no file of an archive"),
        ({"filename": f"top/{S0}"}, "occurs more than once"),
        ({"filename": "top/samples/\x1b[31m"}, "no file of an archive"),
        ({"external_attr": 0o120777 << 16}, "a link"),
        ({"compress_type": zipfile.ZIP_DEFLATED}, "compressed; unpack the ZIP file"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_bad_members_of_a_zip_file_are_refused(
    changes: dict[str, Any], message: str, sound_archive: Path, tmp_path: Path
) -> None:
    (tmp_path / "a.zip").write_bytes(zipped(sound_archive, **changes))
    refused(tmp_path / "a.zip", tmp_path / "cache", message)


def test_a_bomb_is_not_unpacked(sound_archive: Path, tmp_path: Path) -> None:
    content = bytearray(zipped(sound_archive))
    entry = content.rindex(
        b"PK\x01\x02", 0, content.index(b"top/samples/shard-00002.h5", len(content) - 3000)
    )
    for at in (20, 24):
        content[entry + at : entry + at + 4] = (2**31).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(content)
    refused(tmp_path / "a.zip", tmp_path / "cache", "so they overlap")


def test_an_archive_that_was_packed_again_is_read(sound_archive: Path, tmp_path: Path) -> None:
    again = packed(sound_archive, tmp_path / "again.zip")
    assert import_archive(again, tmp_path / "cache") == [tiny_folder(tmp_path / "cache")]


def test_the_finders_files_are_ignored_and_never_opened(
    sound_archive: Path, archive_copy: Path, tmp_path: Path
) -> None:
    for place in ("", "samples/"):
        put(f"{place}.DS_Store", b"x" * 9000)(archive_copy)
    cache = tmp_path / "cache"
    (folder,) = import_archive(archive_copy, cache)
    assert ".DS_Store" not in {path.name for path in folder.iterdir()}
    assert import_archive(packed(archive_copy, tmp_path / "a.zip"), cache) == [folder]
    (archive_copy / ".DS_Store").unlink()
    (archive_copy / ".DS_Store").symlink_to(sound_archive / SUMS)
    with pytest.raises(StoreError, match=r"\.DS_Store: a link"):
        import_archive(archive_copy, cache)


@pytest.mark.parametrize("n", [40, pytest.param(400, marks=pytest.mark.nightly)])
def test_mutated_archives_are_read_or_refused(n: int, sound_archive: Path, tmp_path: Path) -> None:
    folder, cache = tmp_path / "archive", tmp_path / "cache"
    shutil.copytree(sound_archive, folder)
    names = sorted(
        p.relative_to(sound_archive).as_posix() for p in sound_archive.rglob("*") if p.is_file()
    )
    n_refused = 0
    for seed in range(n):
        generator = np.random.default_rng(seed)
        name = names[generator.integers(len(names))]
        original = (sound_archive / name).read_bytes()
        content = mutated_bytes(original, generator)
        (folder / name).write_bytes(content)
        is_listed = bool(name != SUMS and seed % 2)
        if is_listed:
            listed_again(folder)
        try:
            import_archive(folder, cache)
        except MorBenchError as error:
            said = str(error)
        else:
            said = ""
            shutil.rmtree(cache)
        assert "\n" not in said, (seed, name)
        assert not cache.exists(), (seed, name)
        assert said or is_listed or name == SUMS or content == original, (seed, name)
        n_refused += bool(said)
        for changed in (name, SUMS):
            shutil.copyfile(sound_archive / changed, folder / changed)
    assert n_refused > n / 2
