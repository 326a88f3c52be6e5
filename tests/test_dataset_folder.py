"""Folders with a data set card come back exactly, and damaged ones give one clear error."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

import mor_bench
from mor_bench.adapters.dataset_folder import export_dataset_folder, import_dataset_folder
from mor_bench.errors import InvalidInputError, SpecError, StoreError, UnsupportedSceneError
from mor_bench.snapshots.dataset import Dataset

TRAIN, TEST = (f"data/{name}-00000-of-00001.h5" for name in ("train", "test"))


@pytest.fixture(scope="module")
def exported(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hub") / "tiny"
    paths = export_dataset_folder(tiny, folder)
    names = [path.relative_to(folder).as_posix() for path in paths]
    assert names == ["README.md", "mesh.h5", TRAIN, TRAIN.replace("train", "validation"), TEST]
    return folder


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported, tmp_path / "copy"))


def test_a_dataset_comes_back_exactly_and_without_a_connection(
    exported: Path, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    back = mor_bench.load_dataset(import_dataset_folder(exported, tmp_path / "back.npz")[1])
    for name in ("train", "validation", "test"):
        before, after = getattr(tiny, name), getattr(back, name)
        for array in ("forces", "displacements", "regions"):
            np.testing.assert_array_equal(getattr(after, array), getattr(before, array))
    for array in ("points", "cells"):
        np.testing.assert_array_equal(
            getattr(back.scene.mesh, array), getattr(tiny.scene.mesh, array)
        )
    np.testing.assert_array_equal(back.scene.fixed_nodes, tiny.scene.fixed_nodes)
    assert back.scene.spec.title == tiny.scene.spec.title
    again = export_dataset_folder(back, tmp_path / "again")
    for path in again:
        first = exported / path.relative_to(tmp_path / "again")
        assert path.read_bytes() == first.read_bytes(), path.name


def test_a_folder_is_no_toml_and_the_message_names_the_way(
    exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(exported.parent)
    for source in (exported, exported.name, f"{exported.name}/"):
        with pytest.raises(SpecError, match=r"tiny: a folder; .*\.import_dataset_folder turns"):
            mor_bench.load_dataset(source)
    with pytest.raises(SpecError, match="unknown dataset 'tinny'"):
        mor_bench.load_dataset("tinny")
    (exported.parent / "beam-tiny").mkdir()
    assert mor_bench.load_scene("beam-tiny").name == "beam-tiny"


def test_the_class_of_a_dataset_has_a_public_name(tiny: Dataset) -> None:
    assert mor_bench.Dataset is Dataset
    assert isinstance(tiny, mor_bench.Dataset)
    assert "Dataset" in mor_bench.__all__


def test_the_card_is_yaml_that_names_the_files(exported: Path) -> None:
    text = (exported / "README.md").read_text(encoding="utf-8")
    block = yaml.safe_load(text.split("---\n")[1])
    (config,) = block["configs"]
    assert [entry["split"] for entry in config["data_files"]] == ["train", "validation", "test"]
    for entry in config["data_files"]:
        (path,) = exported.glob(entry["path"])
        with h5py.File(path) as file:  # a column per array, all with one row per sample
            assert len({array.shape[0] for array in file.values()}) == 1
    assert block["pretty_name"] == "Cantilever beam, 24 H8, for tests and first steps"


def test_the_library_datasets_reads_the_splits(
    exported: Path, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    # `datasets` alone would find this repository's folder of that name.
    library = pytest.importorskip("datasets.load", reason="needs the library datasets")
    splits = library.load_dataset(str(exported), cache_dir=str(tmp_path))
    assert set(splits) == {"train", "validation", "test"}
    for name, rows in splits.items():
        columns = rows.with_format("numpy", dtype=np.float64)[:]
        for column, found in columns.items():
            np.testing.assert_array_equal(found, getattr(getattr(tiny, name), column))


CARDS = {
    "a list of paths": "configs:\n- config_name: default\n  data_files:\n  - split: train\n"
    '    path:\n    - "data/a.h5"\n    - data/b.h5\n  - split: test\n    path: data/test-*\n',
    "no paths": "license: mit\n",
    "single quotes": "pretty_name: 'it''s'\nconfigs:\n- config_name: d\n  data_files:\n"
    "  - split: train\n    path: 'data/[ab].h5'\n  - split: test\n    path: 'data/test-*.h5'\n",
    "flow form": "configs: [{data_files: [{split: train, path: [data/a.h5, data/b.h5]}, "
    "{split: test, path: data/test-*.h5}]}]\n",
    "a mapping": "configs:\n- data_files:\n    train: data/[ab].h5\n    test: data/test-*.h5\n",
    "keys in order, other lists": "configs:\n- config_name: default\n  data_files:\n"
    "  - path: data/[ab].h5\n    split: train\n  - path: data/test-*.h5\n    split: test\n"
    "split: test\ntags:\n- data/validation-*.h5\n",
    "comments": "# about\nconfigs: # splits\n- data_files: # three\n  - split: train # 140\n"
    "    path: data/[ab].h5 # two\n  - split: test\n    # path: data/a.h5\n"
    "    path: data/test-*.h5\n",
}


@pytest.mark.parametrize("card", CARDS)
def test_other_cards_and_several_files_are_read(
    card: str, folder: Path, tiny: Dataset, tmp_path: Path
) -> None:
    names = ("train-00000-of-00002", "train-00001-of-00002") if card == "no paths" else ("a", "b")
    with h5py.File(folder / TRAIN) as whole:
        for name, rows in zip(names, (slice(0, 100), slice(100, None)), strict=True):
            with h5py.File(folder / "data" / f"{name}.h5", "w") as part:
                for column, values in whole.items():
                    part[column] = values[rows]
    (folder / TRAIN).unlink()
    (folder / "README.md").write_text(f"---\n{CARDS[card]}---\n# Text: - split: none\n")
    back = mor_bench.load_dataset(import_dataset_folder(folder, tmp_path / "back.npz")[1])
    n = len(tiny.validation) if card == "no paths" else 0
    np.testing.assert_array_equal(back.test.forces, tiny.test.forces)
    if n:
        np.testing.assert_array_equal(back.train.forces, tiny.train.forces)
    assert len(back.train) + len(back.validation) == len(tiny.train) + n
    assert back.scene.spec.title == ("it's" if card == "single quotes" else "copy")


def in_card(old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / "README.md").read_text(encoding="utf-8")
        assert old in text
        (folder / "README.md").write_text(text.replace(old, new), encoding="utf-8")

    return change


def in_file(name: str, array: str, values: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with h5py.File(folder / name, "a") as file:
            if array in file:
                del file[array]
            if values is not None:
                file[array] = values

    return change


def cut(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:3000])


def rename_validation(folder: Path) -> None:
    (folder / "README.md").write_text("---\nlicense: mit\n---\n")
    (folder / TEST.replace("test", "validation")).rename(folder / "data" / "valid.h5")


DAMAGES: list[tuple[Callable[[Path], object], str]] = [
    (lambda f: (f / "README.md").unlink(), "README.md: no such file; the folder needs it"),
    (lambda f: (f / "mesh.h5").unlink(), "mesh.h5: no such file; the folder needs it"),
    (lambda f: (f / TEST).unlink(), "no file of the split 'test' exists"),
    (lambda f: (f / "README.md").write_text("# Title"), "begins with a YAML block"),
    (lambda f: (f / "README.md").write_bytes(b"---\n\xff\n---\n"), "not a text in UTF-8"),
    (in_card("split: test", "split: holdout"), "train, validation, test, once; got 'holdout'"),
    (in_card("split: test", "split: train"), "once; got 'train'"),
    (in_card("data/test-*.h5", "../copy/data/test-*.h5"), "`path` must lie in the folder; got"),
    (in_card("data/test-*.h5", "/etc/*.h5"), "`path` must lie in the folder; got '/etc"),
    (in_card("data/test-*.h5", "https://x.org/a.h5"), "`path` must lie in the folder; got 'https"),
    (in_card("data/test-*.h5", "**x/a.h5"), "is no pattern of files|no file of the split"),
    (in_card('pretty_name: "', 'pretty_name: "\\q'), "README.md, line 2: not valid YAML: .*escape"),
    (
        in_card("configs:", "configs:\n  - config_name: other"),
        "it has 2 configurations; one is allowed",
    ),
    (in_card("configs:", "a: &a [b]\nb: *a\nconfigs:"), r"aliases \(`\*a`\) are not read"),
    (in_card("configs:", f"a: {'[' * 25}{']' * 25}\nconfigs:"), "more than 20 nested levels"),
    (in_card("configs:", "<<: {a: b}\nconfigs:"), "line 6: keys must be texts, each once and not"),
    (in_card("configs:", "configs: []\nconfigs:"), "each once and not `<<`; got 'configs'"),
    (in_card("configs:", "configs: x\nother:"), "`configs` must be a list of configurations"),
    (
        in_card("data_files:", "data_dir: x\n    data_files:"),
        "key `data_dir`, which is not read; al",
    ),
    (in_card("path:", "paths:"), "needs the keys split and path, and no others; got split, paths"),
    (in_card('path: "data/test-*.h5"', "path: []"), "paths of a split must be a text or a list"),
    (in_card("data/test-*.h5", "data/t*-*.h5"), "is in the splits 'train' and 'test'"),
    (in_card("data/test-*.h5", "README.*"), "README.md: not read, though the card names it; only"),
    (lambda f: (f / "README.md").write_text("---\n- a\n---\n"), "must be a mapping of keys"),
    (rename_validation, "valid.h5: in no split. Name the files in the card"),
    (cut("mesh.h5"), "mesh.h5: not a readable HDF5 file"),
    (cut(TEST), "test-00000-of-00001.h5: not a readable HDF5 file"),
    (in_file("mesh.h5", "cells", None), "mesh.h5: the array `cells` is missing"),
    (in_file("mesh.h5", "cells", np.zeros((2, 8), int)), "its samples are refused: .*node"),
    (
        in_file("mesh.h5", "points", np.zeros((5, 3))),
        r"`forces` must be real .* \(140, 5, 3\); got",
    ),
    (in_file(TEST, "forces", None), "the column `forces` is missing"),
    (in_file(TEST, "forces", ["a", "b"]), "`forces` must be an array of numbers"),
    (in_file(TEST, "colour", [1]), "unknown column `colour`; allowed: forces, displacements, reg"),
    (in_file(TEST, "displacements", np.zeros((40, 2))), r"`displacements` must be real numbers of"),
    (in_file(TEST, "regions", np.zeros(40)), "`regions` must be integers, one row per sample"),
    (in_file(TEST, "forces", np.full((40, 63, 3), np.nan)), "refused: .*`forces` must be finite"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_a_damaged_folder_gives_one_clear_error(
    damage: Callable[[Path], object], message: str, folder: Path, tmp_path: Path
) -> None:
    damage(folder)
    with pytest.raises(StoreError, match=message) as refused:
        import_dataset_folder(folder, tmp_path / "back.npz")
    assert "\n" not in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_nothing_is_overwritten_and_a_varying_body_is_refused(
    exported: Path, tiny: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(InvalidInputError, match=r"README.md exists and is not overwritten"):
        export_dataset_folder(tiny, exported)
    (tmp_path / "back.npz").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"back.npz exists and is not overwritten"):
        import_dataset_folder(exported, tmp_path / "back.npz")
    varying = replace(tiny, scene=mor_bench.load_scene("beam-stiffness"))
    with pytest.raises(UnsupportedSceneError, match="its body varies between samples"):
        export_dataset_folder(varying, tmp_path / "out")
    assert not (tmp_path / "out").exists()
