"""The examples of docs/own-data.md are run as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import mor_bench
from mor_bench.runs.file_check import check_file

GUIDE = (Path(__file__).parent.parent / "docs" / "own-data.md").read_text(encoding="utf-8")


def test_the_guide_s_examples_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scripts = re.findall(r"<!-- python -->\n```python\n(.*?)```", GUIDE, re.DOTALL)
    files = re.findall(r"<!-- toml: (\S+) -->\n```toml\n(.*?)```", GUIDE, re.DOTALL)
    assert len(scripts) == len(files) == 2
    for script in scripts:
        exec(compile(script, "own-data.md", "exec"), {})
    for name, text in files:
        Path(name).write_text(text, encoding="utf-8")
    assert (
        check_file(Path("body.toml"))
        == "dataset, 96 cells, 195 nodes, 65 load patches, 650 samples"
    )
    assert check_file(Path("mine.toml")).startswith(
        "dataset of imported snapshots, 96 cells, 195 nodes, 15 of them fixed, "
    )
    comparison = mor_bench.run(["mine.toml"], ["pod", "pca-regression-force"], out="out")
    assert {row["status"] for row in comparison.rows} == {"skipped", "ok"}


def test_every_array_of_the_schema_is_in_the_guide() -> None:
    from mor_bench.scene.snapshot_file import OPTIONAL, REQUIRED

    assert re.findall(r"^\| `(\w+)` \| \(", GUIDE, re.MULTILINE) == [*REQUIRED, *OPTIONAL]
