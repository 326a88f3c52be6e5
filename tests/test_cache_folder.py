"""The listing of the cache, and its cleaning."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import Result

from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.generate import dataset_folder
from tests.commands import invoke


def cache_command(*arguments: object) -> Result:
    return invoke("cache", *map(str, arguments))


@pytest.fixture
def filled(tiny: Dataset, cache: Path, tmp_path: Path) -> Path:
    """A cache with beam-tiny, two fits of one method and one of another."""
    folder = dataset_folder(tiny.scene.generated, cache)
    shutil.copytree(folder, tmp_path / "datasets" / folder.name)
    for name in ("pca-regression-0a1b", "pca-regression-2c3d", "pod-4e5f"):
        (tmp_path / "fits" / name).mkdir(parents=True)
        (tmp_path / "fits" / name / "model.safetensors").write_bytes(bytes(1000))
    return tmp_path


def test_the_cache_is_listed_with_sizes(filled: Path) -> None:
    found = json.loads(cache_command("--cache", filled, "--json").stdout)
    sizes = {(item["kind"], item["name"]): item["size_bytes"] for item in found["entries"]}
    data = sum(path.stat().st_size for path in (filled / "datasets").rglob("*.*") if path.is_file())
    assert sizes[("fit", "pca-regression")] == 2000
    assert sizes[("fit", "pod")] == 1000
    assert sizes[("dataset", "beam-tiny")] == data > 0
    assert found["size_bytes"] == sum(sizes.values())
    assert "pca-regression" in cache_command("--cache", filled).stdout
    assert cache_command("--cache", filled / "nothing").exit_code == 0


def test_only_named_entries_are_deleted_and_can_be_made_again(filled: Path) -> None:
    assert cache_command("pod", "--cache", filled).exit_code == 0
    assert (filled / "fits" / "pod-4e5f").exists()
    assert cache_command("pod", "beam-tiny", "--clean", "--cache", filled).exit_code == 0
    left = sorted(path.name for path in filled.glob("*/*"))
    assert left == ["pca-regression-0a1b", "pca-regression-2c3d"]
    assert len(load_dataset("beam-tiny", 30, cache=filled, workers=1).train) > 0
    refused = cache_command("pdo", "--clean", "--cache", filled)
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert "the cache has nothing of 'pdo'" in refused.stderr
