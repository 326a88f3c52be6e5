"""The rows and files of a run's results."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path

import pytest

from mor_bench.errors import StoreError
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row, label_of
from mor_bench.results.schema import SCHEMA_FILE, schema_text

ROW = {
    "dataset": "d",
    "split": "region",
    "method": "pod",
    "label": "pod [n_modes=5]",
    "parameters": {"n_modes": 5, "tolerance": 1e-8},
    "swept": {"n_modes": 5},
    "status": "ok",
    "n_train": 80,
    "n_test": 20,
    "error": {"mean_dof_m": inf, "rel_l2_median": 0.02},
    "sets": {"2x": {"n": 20, "rel_l2_max": inf}},
}


def comparison(out: Path) -> Comparison:
    made = Comparison(out, {"cores": 2}, datasets={"d": {"title": "D"}})
    made.put(Row.model_validate(ROW))
    return made


def test_the_committed_json_schema_matches_the_code() -> None:
    assert SCHEMA_FILE.read_text(encoding="utf-8") == schema_text()


def test_results_read_back_as_they_were_written(tmp_path: Path) -> None:
    written = comparison(tmp_path)
    read = Comparison.read(tmp_path)
    assert read == written
    assert read.rows[0].error is not None
    assert read.rows[0].error.mean_dof_m == inf
    before = (tmp_path / "results.json").read_bytes()
    read.write()
    assert (tmp_path / "results.json").read_bytes() == before


def test_a_row_may_lack_the_swept_parameters(tmp_path: Path) -> None:
    comparison(tmp_path)
    path = tmp_path / "results.json"
    content = json.loads(path.read_text())
    del content["rows"][0]["swept"]
    path.write_text(json.dumps(content))
    assert Comparison.read(tmp_path).rows[0].swept == {}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("datasets", {}, "`datasets` lacks 'd', which rows name"),
        ("datasets", {"d": {"needs": {"error": "small"}}}, r"`datasets.d`: .*needs.error"),
        ("datasets", {"d": True}, r"`datasets.d` must be a valid dictionary; got True"),
        ("methods", {"pod": {"regime": {"min_dofs": "many"}}}, r"`methods.pod`: .*min_dofs"),
        ("settings", {"limit": "few"}, r"`settings`: .*limit"),
        ("rows", {}, r"`rows` must be a valid list; got \{\}"),
        ("schema_version", "2" * 1000, r"schema version 2{50}…"),
    ],
)
def test_a_damaged_table_is_refused_with_its_name_and_the_key(
    tmp_path: Path, key: str, value: object, message: str
) -> None:
    comparison(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(StoreError, match=rf"results\.json: {message}") as caught:
        Comparison.read(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("status", "fine", r"`rows\[0\].status` must be 'ok', 'failed' or 'skipped'; got 'fine'"),
        ("n_train", "many", r"`rows\[0\].n_train` must be a valid integer"),
        ("error", {"rel_l2_median": "low"}, r"`rows\[0\].error.rel_l2_median` must be a valid"),
    ],
)
def test_a_damaged_file_is_refused_with_its_name_and_the_key(
    tmp_path: Path, key: str, value: object, message: str
) -> None:
    comparison(tmp_path)
    path = tmp_path / "results.json"
    content = json.loads(path.read_text())
    content["rows"][0][key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(StoreError, match=rf"results\.json: {message}"):
        Comparison.read(tmp_path)


def test_a_label_names_the_method_and_the_swept_parameters(tmp_path: Path) -> None:
    table = comparison(tmp_path).table
    assert table["error.rel_l2_median"][0] == 0.02
    assert json.loads(table["parameters"][0]) == ROW["parameters"]
    assert not [column for column in table.columns if column.startswith("swept")]


@pytest.mark.parametrize("value", ["a\nb", "\x1b[31m", "long" * 1000, ["\u202e"]])
def test_a_swept_text_cannot_spoil_the_label_of_a_row(value: object) -> None:
    row = Row.model_validate({**ROW, "label": label_of("mine", {"text": value})})
    assert row.label.isprintable()
    assert row.label.startswith("mine [text=")
