"""The page that leads to a method names the winners and networks of the stored runs."""

from __future__ import annotations

import json
import re
from typing import Any

from mor_bench.analysis.told import class_text, given_by
from mor_bench.report.entries import verdict_of
from mor_bench.report.suite_overview import overview
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from tests.published.run_tables import best_of_class
from tests.published.stored import REPORTS, ROOT, run_of

PAGE = (ROOT / "docs" / "which-method.md").read_text(encoding="utf-8")
ROW = re.compile(
    r"^\| `([\w-]+)` \| \[?`([\w/-]+)`.* \| (`.*`~?|none qualifies) \| ([^|]+) \| (\d+ of \d+) \|$",
    re.MULTILINE,
)


def stored_verdicts() -> dict[tuple[str, str], list[str]]:
    """Return the winner and the methods not distinguished from it, by dataset and run."""
    found = {}
    for file in sorted(REPORTS.rglob("comparison.json")):
        run = file.parent.relative_to(REPORTS).as_posix()
        if run.startswith("runs/"):  # a run of the reader's own
            continue
        for verdict in json.loads(file.read_text(encoding="utf-8"))["verdicts"]:
            found[verdict["dataset"], run] = methods_of(verdict)
    return found


def methods_of(verdict: dict[str, Any]) -> list[str]:
    labels = [label for label in (verdict["choice"], *verdict["undecided"]) if label]
    return list(dict.fromkeys(label.partition(" ")[0] for label in labels))


def test_the_page_names_the_winner_of_every_stored_run() -> None:
    named = {
        (scene, run): re.findall(r"`([\w-]+)`", cell) for scene, run, cell, *_ in ROW.findall(PAGE)
    }
    assert named == stored_verdicts()


def test_the_page_tells_which_verdicts_rest_on_unstable_timings() -> None:
    for scene, run, cell, given, count in ROW.findall(PAGE):
        stored = run_of(f"reports/{run}")
        rows = {row.label: row for row in stored.rows if row.dataset == scene and row.ok}
        stable = {label: row.latency_ms.stable for label, row in rows.items() if row.latency_ms}
        assert count == f"{sum(map(bool, stable.values()))} of {len(stable)}", run
        choice = verdict_of(stored.analysis or {}, scene)["choice"]
        unstable = choice is not None and not stable[choice]
        assert ("`~" in cell) == unstable, run
        told = "–" if choice is None else class_text(rows[choice], given_by(stored, scene))
        assert given == told, run


def test_the_page_is_right_about_observed_displacements() -> None:
    runs = {run: run_of(f"reports/{run}") for run in {run for _, run in stored_verdicts()}}
    observed = [
        (run, name)
        for run, found in runs.items()
        for name, spec in found.datasets.items()
        if spec.get("observed")
    ]
    assert len(observed) == 1, "the page names one stored run"
    run = runs[observed[0][0]]
    assert run.analysis
    (verdict,) = run.analysis["verdicts"]
    assert verdict["choice"].startswith("gappy-pod")
    (choice,) = (row for row in run.rows if row.label == verdict["choice"])
    assert choice.error
    assert choice.error.rel_l2_median > run.datasets[observed[0][1]]["needs"]["error"]
    modes = [row for row in run.rows if row.method == "gappy-pod"]
    errors = [row.error.rel_l2_median for row in modes if row.error]
    latencies = [row.latency_ms.median for row in modes if row.latency_ms]
    assert errors == sorted(errors, reverse=True)
    assert latencies == sorted(latencies)
    (network,) = (row for row in run.rows if row.method == "umesh" and row.error)
    assert network.error
    assert network.error.rel_l2_median > 10 * errors[-1]


def test_the_page_names_the_most_accurate_network() -> None:
    networks = {m.name for m in overview()["methods"] if m.family == "neural networks"}
    best: dict[str, Row] = {}
    for run in sorted({run for _, run in stored_verdicts()}):
        for row in Comparison.read(REPORTS / run).rows:
            if row.method in networks and row.error and not row.dataset.endswith("-observed"):
                other = best.get(row.dataset, row)
                assert other.error
                if row.error.rel_l2_median <= other.error.rel_l2_median:
                    best[row.dataset] = row
    link = r"\[`([\w-]+)`\]\([^)]*\) is the most accurate"
    (elsewhere,) = re.findall(link + " one on the other scenes", PAGE)
    named = dict.fromkeys(best, elsewhere)
    on_some = link + r" network in the stored runs on ([\w, -]+), on two cores"
    for method, scenes in re.findall(on_some, PAGE):
        named |= dict.fromkeys(scenes.split(", "), method)
    assert {name: row.method for name, row in best.items()} == named


def test_the_page_names_the_best_of_those_told_the_equations() -> None:
    verdicts = json.loads((REPORTS / "reduced-order/beam-coarse/comparison.json").read_text())
    (best,) = (
        re.fullmatch(r"Best when told equations: ([\w-]+) .*", line)
        for line in verdicts["verdicts"][0]["beside"]
        if line.startswith("Best when told equations: ")
    )
    assert best
    named = re.search(r"\[`([\w-]+)`\]\([^)]*\) is the best that is told the equations", PAGE)
    assert named
    assert named[1] == best[1]


def test_the_page_names_the_fastest_without_snapshots() -> None:
    table = best_of_class("reports/reduced-order/beam-coarse")
    (row,) = (line for line in table.splitlines() if line.startswith("| equations, no snapshots |"))
    named = re.search(r"- \*\*No\*\*: \[`([\w-]+)`\]", PAGE)
    assert named
    assert f"| `{named[1]}` |" in row


def test_the_first_page_counts_the_questions() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    counted = {7: "Seven", 8: "Eight", 9: "Nine"}[PAGE.count("\n::::{dropdown}")]
    assert f"{counted} questions lead to a method" in index
