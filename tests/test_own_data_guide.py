"""The examples of docs/own-data.md work as they stand there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import pytest

import mor_bench
from mor_bench.analysis.selection import asked_of
from mor_bench.analysis.selection_text import run_command
from mor_bench.runs.file_check import check_file
from mor_bench.scene.snapshot_file import OPTIONAL, REQUIRED
from tests.small_runs import PLAIN, short_timing

GUIDE = (Path(__file__).parent.parent / "docs" / "own-data.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The working folder after the scripts and files of the guide."""
    scripts = re.findall(r"<!-- python -->\n```python\n(.*?)```", GUIDE, re.DOTALL)
    files = re.findall(r"<!-- toml: (\S+) -->\n```toml\n(.*?)```", GUIDE, re.DOTALL)
    assert len(scripts) == len(files) == 2
    with chdir(tmp_path_factory.mktemp("guide")):
        for script in scripts:
            exec(compile(script, "own-data.md", "exec"), {})
        for name, text in files:
            Path(name).write_text(text, encoding="utf-8")
        yield Path.cwd()


def test_the_datasets_of_the_guide_are_valid(folder: Path) -> None:
    counts = "96 cells, 195 nodes"
    body = f"dataset, {counts}, 65 load patches, 650 samples"
    assert check_file(folder / "body.toml") == body
    mine = f"dataset of imported snapshots, {counts}, 15 of them fixed, "
    assert check_file(folder / "mine.toml").startswith(mine)


@pytest.mark.slow
def test_the_imported_dataset_of_the_guide_can_be_compared(folder: Path) -> None:
    with short_timing():
        comparison = mor_bench.run(["mine.toml"], PLAIN, out="out", cache="cache")
    assert {row.status for row in comparison.rows} == {"skipped", "ok"}
    command = run_command(asked_of(comparison, "mine"))
    assert command.startswith("mor-bench run mine.toml -m linear-fem -m pca-regression ")


def test_the_guide_names_every_array_of_the_schema() -> None:
    assert re.findall(r"^\| `(\w+)` \| \(", GUIDE, re.MULTILINE) == [*REQUIRED, *OPTIONAL]
