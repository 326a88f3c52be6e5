"""What methods are told: groups of tables, the filter of the page, `--told`."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from mor_bench.analysis.told import given_by, told_at_most
from mor_bench.report.console_tables import print_tables
from mor_bench.report.entries import by_group, entries_of
from mor_bench.report.text_table import TextTable, with_information
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs import load_dataset_spec
from tests.commands import invoke
from tests.report_runs import add_row, page_of, tiny
from tests.synthetic import a_row


def scored(
    method: str, told: str, error: float, latency_ms: float, snapshots: bool = True, **fields: Any
) -> Row:
    return a_row(
        method,
        told=told,
        snapshots=snapshots,
        error={"rel_l2_median": error, "rel_l2_max": error, "mean_dof_m": error},
        n_test=1,
        latency_ms={"median": latency_ms},
        offline_s={"data": 1.0, "fit": 1.0},
        **fields,
    )


@pytest.fixture
def made(tmp_path: Path) -> Comparison:
    """Methods of all classes, one of them worse than answering zero, and a failed row."""
    spec = load_dataset_spec("beam-tiny").model_dump(mode="json")
    rows = [
        scored("fem", "equations", 0.0, 2.0, False, reference=True),
        scored("pod", "equations", 0.008, 1.0),
        scored("linear", "linear-response", 0.009, 0.5, False),
        scored("pca", "input", 0.03, 0.1),
        scored("wild", "input", 3.0, 0.01),
        a_row("pca", {"k": 3}, status="failed", told="input", n_failed=None),
    ]
    comparison = Comparison(tmp_path, {}, rows, datasets={"beam-tiny": spec})
    comparison.write()
    for row in rows[:-1]:
        assert row.error is not None
        comparison.put(row, {"relative_l2": np.array([row.error.rel_l2_median])})
    return comparison


def test_rows_are_grouped_by_what_their_methods_are_told(made: Comparison) -> None:
    entries = entries_of(made, "beam-tiny")
    assert {name: [e.label for e in mine] for name, mine in by_group(entries).items()} == {
        "force only, snapshots": ["pca", "wild", "pca [k=3]"],
        "force and linear response, no snapshots": ["linear"],
        "equations, snapshots": ["pod"],
        "equations, no snapshots, reference": ["fem"],
    }
    assert [entry.pareto_mark for entry in entries] == ["ref", "*", "*", "*", "", ""]
    observed = load_dataset_spec("liver-hex-observed").model_dump(mode="json")["observed"]
    made.datasets["beam-tiny"] = {**made.datasets["beam-tiny"], "observed": observed}
    assert entries_of(made, "beam-tiny")[3].group == "observed displacements only, snapshots"


def test_the_page_filters_rows_without_a_script(made: Comparison) -> None:
    page = page_of(made)
    assert 'tr[data-told="input"] { display: none; }' in page
    markup = page.split("<script", 1)[0]
    assert markup.count('type="checkbox"') == 3
    table = markup.split("<caption>Configurations of")[1].split("</table>")[0]
    assert table.count('data-told="input"') == 3
    assert "checked> force only</label>" in page
    made.datasets["beam-tiny"]["observed"] = {"region": "x-max"}
    page = page_of(made)
    assert "checked> observed displacements only</label>" in page


def test_the_console_names_each_group_before_its_rows(made: Comparison) -> None:
    stream = io.StringIO()
    print_tables(made, Console(file=stream, width=120))
    lines = [
        line.removeprefix("  ").split("  ")[0].strip() for line in stream.getvalue().splitlines()
    ]
    assert lines.index("– equations, snapshots –") + 1 == lines.index("* pod")


def test_told_keeps_methods_that_are_told_no_more(made: Comparison) -> None:
    for told, n in (("input", 3), ("linear-response", 4), ("equations", 6), (None, 6)):
        assert len(told_at_most(made, told).rows) == n  # type: ignore[arg-type]
    shown = invoke("report", str(made.out), "--told", "input")
    assert shown.exit_code == 0, shown.stderr
    assert "wild" in shown.stdout
    assert "linear" not in shown.stdout.replace("linear response", "")
    assert not (made.out / "comparison.json").exists()
    for told, winner in (("linear-response", "linear"), ("equations", "linear")):
        options = ["--run", str(made.out), "--told", told, "--json"]
        found = invoke("pick", "beam-tiny", *options)
        assert json.loads(found.stdout)["choice"]["label"] == winner
    none = invoke("pick", "beam-tiny", "--told", "input", *options[:2])
    assert none.exit_code == 1


def test_tables_of_configurations_and_methods_state_the_class(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {"n_modes": 5}, 0.01, 1.0, told="equations", snapshots=True)
    add_row(made, "old", {}, 0.01, 1.0)
    entries = entries_of(made, "beam-tiny")
    by_label = TextTable("t", "n", ["configuration", "x"], [["pod [n_modes=5]", "1"], ["?", "2"]])
    found = with_information(by_label, entries)
    assert found.headings == ["configuration", "told", "x"]
    assert found.rows == [["pod [n_modes=5]", "equations, snapshots", "1"], ["?", "–", "2"]]
    by_method = TextTable("t", "n", ["method", "x"], [["pod", "1"], ["old", "2"]])
    assert [row[1] for row in with_information(by_method, entries).rows] == [
        "equations, snapshots",
        "–",
    ]
    other = TextTable("t", "n", ["load", "x"], [["pod", "1"]])
    assert with_information(other, entries) == other


@pytest.mark.parametrize(
    ("dataset", "given"),
    [
        ("beam-tiny", "force"),
        ("soft-arm", "force"),
        ("liver-hex-observed", "observed displacements"),
        ("liver-grasped", "prescribed displacements"),
        ("liver-pressed", "displacement of the instrument"),
    ],
)
def test_the_input_is_named_by_what_the_dataset_gives(
    dataset: str, given: str, tmp_path: Path
) -> None:
    spec = load_dataset_spec(dataset).model_dump(mode="json")
    comparison = Comparison(tmp_path, {}, [], datasets={dataset: spec})
    assert given_by(comparison, dataset) == given
