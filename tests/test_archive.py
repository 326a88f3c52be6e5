"""An archive of a dataset comes back bit by bit, and nothing of a bad one reaches the cache."""

from __future__ import annotations

import json
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.export.archive import write_archive
from mor_bench.export.archive_writer import ArchiveWriter
from mor_bench.export.toml_text import toml_text
from mor_bench.snapshots import generate as generate_module
from mor_bench.snapshots.archive_files import SUMS
from mor_bench.snapshots.archive_import import import_archive
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.generate import dataset_folder
from mor_bench.snapshots.manifest import read_manifest
from mor_bench.specs import list_suite, load_dataset_spec, load_generated_spec
from tests.archives import (
    BY,
    S0,
    S2,
    SPEC,
    flip,
    own_dataset,
    tiny_folder,
)
from tests.commands import invoke


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def never_solve(*_: object) -> None:
    raise AssertionError("a sample is solved")


# Round trips


@pytest.mark.parametrize("name", ["tiny", "tiny.zip", "tiny.ZIP"])
def test_the_samples_come_back_bit_by_bit_and_are_used(
    name: str, cache: Path, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_archive(SPEC, tmp_path / name, ["A. Author"], BY, cache=cache, workers=1)
    assert written.path == (tmp_path / name / SUMS if name == "tiny" else tmp_path / name)
    assert (tmp_path / name).is_dir() == (name == "tiny")
    other = tmp_path / "cache"
    (folder,) = import_archive(tmp_path / name, other)
    assert folder == tiny_folder(other)
    assert files(folder) == files(tiny_folder(cache))
    monkeypatch.setattr(generate_module, "solve_task", never_solve)
    again = mor_bench.load_dataset("beam-tiny", cache=other, workers=1)
    assert np.array_equal(again.test.displacements, tiny.test.displacements)
    assert np.array_equal(again.train.forces, tiny.train.forces)


def test_equal_datasets_give_equal_archives(cache: Path, tiny: Dataset, tmp_path: Path) -> None:
    written = [
        write_archive(SPEC, tmp_path / f"{n}" / "a.zip", ["A"], BY, cache=cache, workers=1)
        for n in range(2)
    ]
    first, second = (item.path.read_bytes() for item in written)
    assert first == second
    assert written[0].sums_sha256 == written[1].sums_sha256


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_sha256sum_accepts_the_list_and_notices_damage(archive_copy: Path) -> None:
    command = ["sha256sum", "--strict", "-c", SUMS]
    done = subprocess.run(command, cwd=archive_copy, capture_output=True, text=True, check=True)
    assert (
        len(done.stdout.splitlines())
        == len([p for p in archive_copy.rglob("*") if p.is_file()]) - 1
    )
    flip(S0)(archive_copy)
    assert (
        subprocess.run(command, cwd=archive_copy, capture_output=True, check=False).returncode == 1
    )


def test_an_own_mesh_travels_with_the_samples_and_no_path_does(tmp_path: Path) -> None:
    toml = own_dataset(tmp_path / "secret-place", 8)
    spec = load_generated_spec(toml)
    one, two, out = (tmp_path / name for name in ("one", "two", "out"))
    write_archive(spec, out, ["A"], BY, cache=one, workers=1)
    assert not [path for path in out.rglob("*.*") if b"secret-place" in path.read_bytes()]
    first = mor_bench.load_dataset(spec, cache=one, workers=1)
    shutil.rmtree(tmp_path / "secret-place")
    (folder,) = import_archive(out, two)
    assert folder.name == dataset_folder(spec, one).name
    (kept,) = folder.glob("source-*")
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["spec"]["geometry"]["file"]["path"] == str(kept)
    for place in (out / "own.toml", read_manifest(folder).spec):
        again = mor_bench.load_dataset(place, cache=two, workers=1)
        assert np.array_equal(again.train.displacements, first.train.displacements)
    assert "<b>" not in (out / "README.md").read_text(encoding="utf-8")
    shutil.rmtree(out)


@pytest.mark.slow
def test_named_test_sets_travel_too(cache: Path, tiny: Dataset, tmp_path: Path) -> None:
    out, other = tmp_path / "out.zip", tmp_path / "cache"
    write_archive(SPEC, out, ["A"], BY, tests=True, cache=cache, workers=1)
    folders = import_archive(out, other)
    assert len(folders) == 6
    for folder in folders:
        assert files(folder) == files(cache / "datasets" / folder.name)


@pytest.mark.parametrize("name", list_suite("datasets"))
def test_a_dataset_file_is_written_as_it_was(name: str) -> None:
    spec = load_dataset_spec(name)
    content = spec.model_dump(mode="json", exclude_unset=True)
    del content["name"]
    again = load_dataset_spec({**tomllib.loads(toml_text(content)), "name": name})
    assert again == spec
    assert again.model_fields_set == spec.model_fields_set


def test_odd_values_keep_their_form_in_toml() -> None:
    odd: dict[str, Any] = {
        "text": 'a "quoted" \\ line\nand \x7f ü',
        "an odd.key": [1, 2.5, 1e-300, True, []],
        "table": {"a": {"b": [{"c": "d"}]}, "e": {}},
        "tables": [{"x": -1}, {"x": 10**15}],
    }
    assert tomllib.loads(toml_text(odd)) == odd
    with pytest.raises(InvalidInputError, match="None has no form"):
        toml_text({"a": None})


def test_the_card_and_the_metadata_state_the_facts(sound_archive: Path) -> None:
    card = (sound_archive / "README.md").read_text(encoding="utf-8")
    for fact in ("| training | 140 |", "held out by region | 40 |", "1e-08", "ν 0.4", "A. Author"):
        assert fact in card
    metadata = json.loads((sound_archive / "metadata.json").read_text(encoding="utf-8"))
    lines = [
        line.split("  ") for line in (sound_archive / SUMS).read_text(encoding="utf-8").splitlines()
    ]
    sums = {name: digest for digest, name in lines}
    for item in metadata["distribution"]:
        assert item["sha256"] == sums[item["name"]]
        assert item["contentSize"] == f"{(sound_archive / item['name']).stat().st_size} B"
    assert {*sums} - {item["name"] for item in metadata["distribution"]} == {"metadata.json"}


def test_damaged_shards_in_the_cache_are_replaced(
    sound_archive: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(tiny_folder(cache), tiny_folder(tmp_path)))
    (folder / "shard-00001.h5").write_bytes(b"damaged")
    (folder / "shard-00002.h5").unlink()
    import_archive(sound_archive, tmp_path)
    assert files(folder) == files(tiny_folder(cache))


# Writing


def test_nothing_is_left_when_an_archive_cannot_be_written(
    cache: Path, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = ArchiveWriter.add

    def full(self: ArchiveWriter, name: str, content: bytes) -> None:
        if name == S2:
            raise OSError(28, "No space left on device")
        add(self, name, content)

    monkeypatch.setattr(ArchiveWriter, "add", full)
    for name in ("out", "out.zip"):
        with pytest.raises(StoreError, match="cannot be written: No space left"):
            write_archive(SPEC, tmp_path / name, ["A"], BY, cache=cache, workers=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["archive", "beam-tiny", "--out", "."], "exists and is not overwritten"),
        (["archive", "beam-tiny", "--out", "x", "--limit", "5"], "holds the whole dataset"),
        (["archive", "beam-tiny", "--out", "x", "--licence", "GPL"], "`licence` must be CC-BY-4.0"),
        (["archive", "beam-tiny", "--out", "x", "--licence", "e.txt"], "e.txt: a licence must be"),
        (["archive", "beam-tiny", "--out", "x", "--author", "a\nb"], "`author` must be a name"),
        (["archive", "own.toml", "--out", "x"], "`--author` must name the authors"),
        (["generate"], "DATASET or `--from-archive` must be given"),
        (["generate", "--from-archive", "x", "--tests"], "`--tests` and `--from-archive` cannot"),
        (["generate", "--from-archive", "x", "--limit", "5"], "`--limit` and `--from-archive`"),
        (["generate", "--from-archive", "nothing"], "nothing: No such file"),
    ],
)
def test_wrong_calls_get_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.move(own_dataset(tmp_path / "own").parent, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    Path("e.txt").write_text(" \n\n", encoding="utf-8")
    before = sorted(Path().iterdir())
    found = invoke(*arguments, *([] if arguments == ["generate"] else ["--cache", "cache"]))
    assert found.exit_code == 2
    assert message in found.output
    assert sorted(Path().iterdir()) == before


def test_the_commands_write_and_read(cache: Path, tiny: Dataset, tmp_path: Path) -> None:
    terms = "\n  # Open *Data* Commons\n\nTerms"
    (tmp_path / "terms.txt").write_text(terms, encoding="utf-8")
    out, other = tmp_path / "out", tmp_path / "cache"
    licence = ["--licence", str(tmp_path / "terms.txt")]
    options = ["--cache", str(cache), "--workers", "1", "--quiet", *licence]
    found = invoke("archive", "beam-tiny", "--out", str(out), *options)
    assert found.exit_code == 0, found.output
    assert found.stdout.strip() == str(out / SUMS)
    assert (out / "LICENSE.txt").read_text(encoding="utf-8") == terms
    card = (out / "README.md").read_text(encoding="utf-8")
    assert "Open Data Commons, see `LICENSE.txt`." in card
    assert "Dataset beam-tiny, made with mor-bench" in card
    assert "CITATION.cff" not in card
    metadata = json.loads((out / "metadata.json").read_text(encoding="utf-8"))
    known = {"@type": "CreativeWork", "name": "Open Data Commons", "url": "LICENSE.txt"}
    assert metadata["license"] == known
    found = invoke("generate", "beam-tiny", "--from-archive", str(out), "--cache", str(other))
    assert found.exit_code == 0, found.output
    assert found.stdout.strip() == str(tiny_folder(other))
