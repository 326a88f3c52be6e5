"""Archives of datasets for tests, and how to damage one and list its checksums again."""

from __future__ import annotations

import hashlib
import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from mor_bench.export.data_card import Licence
from mor_bench.scene.mesh import box_mesh
from mor_bench.snapshots.archive_files import SUMS
from mor_bench.snapshots.generate import dataset_folder
from mor_bench.snapshots.store import read_shard, write_shard
from mor_bench.specs import load_generated_spec

SPEC = load_generated_spec("beam-tiny")
BY = Licence.named("CC-BY-4.0")
ZEROS = "0" * 64
S0, S1, S2 = (f"samples/shard-0000{number}.h5" for number in range(3))

Damage = Callable[[Path], object]


def listed_again(folder: Path) -> None:
    """Write the checksums of all files, as a forger does."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != SUMS]
    sums = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    lines = (f"{sums[path]}  {path.relative_to(folder).as_posix()}\n" for path in paths)
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")


def forged(damage: Damage) -> Damage:
    """Return a damage after which the checksums fit."""

    def apply(folder: Path) -> None:
        damage(folder)
        listed_again(folder)

    return apply


def flip(name: str, at: int = -100) -> Damage:
    """Flip a bit of a file."""

    def apply(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        content[at] ^= 4
        (folder / name).write_bytes(content)

    return apply


def put(name: str, content: bytes) -> Damage:
    """Write a file, or another content into it."""

    def apply(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)

    return apply


def remove(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def replace_text(name: str, old: str, new: str) -> Damage:
    """Replace a text in a file, which must hold it."""

    def apply(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new), encoding="utf-8")

    return apply


def append_sum(line: str) -> Damage:
    """Add a line to the list of checksums."""

    def apply(folder: Path) -> None:
        with (folder / SUMS).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    return apply


def change_shard(name: str, **changes: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Change arrays of a shard; its own checksum fits."""

    def apply(folder: Path) -> None:
        shard = read_shard(folder / name)
        arrays: dict[str, Any] = {
            key: change(getattr(shard, key).copy()) for key, change in changes.items()
        }
        write_shard(folder / name, replace(shard, **arrays))

    return apply


def change_manifest(name: str, **changes: object) -> Damage:
    """Change a manifest; its own checksum fits."""

    def apply(folder: Path) -> None:
        content = {**json.loads((folder / name).read_text(encoding="utf-8")), **changes}
        del content["sha256"]
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        (folder / name).write_text(json.dumps({**content, "sha256": digest}), encoding="utf-8")

    return apply


def link(name: str, target: Path, is_folder: bool = False) -> Damage:
    """Replace a file or folder by a link to the same content elsewhere."""

    def apply(folder: Path) -> None:
        path = folder / name
        shutil.move(path, target)
        path.symlink_to(target, target_is_directory=is_folder)

    return apply


def packed(folder: Path, target: Path, method: int = zipfile.ZIP_STORED) -> Path:
    """Pack a folder as a ZIP file with other names."""
    with zipfile.ZipFile(target, "w", method) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, f"top/{path.relative_to(folder).as_posix()}")
    return target


def tiny_folder(cache: Path) -> Path:
    """Return the folder of beam-tiny in a cache."""
    return dataset_folder(load_generated_spec("beam-tiny"), cache)


def own_dataset(folder: Path, samples: int = 4) -> Path:
    """Write a dataset on a mesh of its own, with two tables of loads."""
    folder.mkdir()
    mesh = box_mesh((2.0, 1.0, 1.0), (3, 2, 2))
    held = (mesh.points[:, 0] == 0.0).astype(int)
    body = meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)], point_data={"held": held})
    body.write(folder / "body.vtu")
    table = f'magnitude_n = [0.0, 0.5]\npatch_area_m2 = 0.2\nsamples = {samples}\nkind = "force"\n'
    (folder / "own.toml").write_text(
        'title = "Own <b>body</b>"\n[geometry]\nshape = "file"\nfile = "body.vtu"\n'
        '[material]\nlaw = "saint-venant-kirchhoff"\nyoung_pa = 500.0\npoisson = 0.3\n'
        '[[supports]]\nregion = { point_set = "held" }\n'
        f'[[loads]]\nregion = "z-max"\n{table}[[loads]]\nregion = "x-max"\n{table}'
        '[split]\nby = "sample"\n',
        encoding="utf-8",
    )
    return folder / "own.toml"
