"""The data inside the report page are those of the run."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html import unescape
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from mor_bench.analysis.analyse import analyse
from mor_bench.report.entries import entries_of, verdict_of
from mor_bench.report.number_format import joined_units, number, percent, unbroken
from mor_bench.report.page import write_page
from mor_bench.report.page_index import standings
from mor_bench.report.page_sections import View
from mor_bench.report.page_verdict import method_card
from mor_bench.report.page_worst import worst_cases
from mor_bench.report.short_names import short_names
from mor_bench.report.whole_cost import CostLine, Costs, costs_of
from mor_bench.results.comparison import Comparison
from tests.report_runs import N_TEST, add_row, data_of, markup_of, page_of, text_of, tiny
from tests.synthetic import MESH, changed


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """A sweep, and a row without some predictions."""
    made = tiny(tmp_path_factory.mktemp("run"))
    for rank, error, latency in ((5, 0.05, 1.0), (20, 0.008, 2.5), (25, 0.002, 4.0)):
        add_row(made, "pod", {"n_modes": rank}, error, latency)
    add_row(made, "partial", {}, 0.004, 5.0, n_failed=3)
    return made


@pytest.fixture(scope="module")
def page(comparison: Comparison) -> str:
    return page_of(comparison)


def test_the_data_of_the_charts_are_those_of_the_rows(comparison: Comparison, page: str) -> None:
    (data,) = data_of(page)
    for shown, row in zip(data["rows"], comparison.rows, strict=True):
        if row.error and np.isfinite(row.error.rel_l2_median):
            assert shown["error"]["median"] == 100 * row.error.rel_l2_median
            assert joined_units(f"error {percent(row.error.rel_l2_median)} %") in shown["hover"][1]
        if row.latency_ms:
            assert shown["latency"]["median"] == row.latency_ms.median
            slowest = comparison.samples(row)["latency_ms"].max()
            assert shown["latency"]["max"] == slowest
    assert data["winner"] == "pod [n_modes=20]"
    (line,) = (d for d in data["distributions"] if d["label"] == "partial")
    assert line["error"]["share"][-1] == pytest.approx(1 - 3 / N_TEST)
    (dots,) = (d for d in data["deformations"] if d["label"] == "partial")
    assert dots["n_missing"] == 3
    assert max(dots["x"]) == pytest.approx(200.0)
    assert data["singular"]["tail"][0] == pytest.approx(0.8, rel=1e-3)


def test_a_body_keeps_its_shape_and_its_error(comparison: Comparison, page: str) -> None:
    bodies = data_of(page)[0]["bodies"]
    sample = next(s for s in bodies["samples"] if s["label"] == "pod [n_modes=20]")
    assert sample["kind"] == "worst"
    row = comparison.row("beam-tiny", "pod [n_modes=20]")
    arrays = comparison.samples(row)
    nodes = np.unique(MESH.boundary_facets)
    for name, exact in (
        ("reference", arrays["worst_reference"][nodes]),
        ("error", (arrays["worst_prediction"] - arrays["worst_reference"])[nodes]),
    ):
        packed = np.frombuffer(base64.b64decode(sample[name]["data"]), "<i2").reshape(-1, 3)
        scale = np.abs(exact).max()
        np.testing.assert_allclose(packed * sample[name]["scale"], exact, atol=1e-4 * scale)
    facets = np.frombuffer(base64.b64decode(bodies["facets"]), "<i4").reshape(-1, 4)
    np.testing.assert_array_equal(nodes[facets], MESH.boundary_facets)


def test_pages_of_an_earlier_report_do_not_stay_old(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {}, 0.005, 1.0)
    write_page(made, analyse(made), pages=True)
    (old,) = (tmp_path / "pages").glob("*pod*.html")
    old.write_text("old")
    write_page(made, analyse(made))
    assert old.read_text() != "old"


def test_a_page_that_would_be_too_large_is_brief(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps verdicts, tables and frontiers, and links to the datasets' whole pages."""
    made = tiny(tmp_path, "one", "two")
    for name in ("one", "two"):
        add_row(made, "pod", {}, 0.005, 1.0, dataset=name)
    analysis = analyse(made)
    whole = page_of(made, analysis)
    monkeypatch.setattr("mor_bench.report.page.MOST_BYTES", len(whole.encode()) - 1)
    brief = page_of(made, analysis)
    assert "its own page" not in text_of(whole)
    assert text_of(brief).count("its own page") == 2
    own = re.findall(r'<a href="(pages/dataset-[^"]*)">its own page', brief)
    assert [(tmp_path / path).is_file() for path in own] == [True, True]
    for title in ("Distribution of errors", "Singular values"):
        assert title in text_of(whole)
        assert title not in text_of(brief)
        assert all(title in text_of((tmp_path / path).read_text()) for path in own)
    assert text_of(brief).count("Take pod") == text_of(whole).count("Take pod") > 1


def test_pages_show_the_test_error_of_what_validation_selects(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "lucky", {"k": 1}, 0.023, 1.0, validation={"rel_l2_median": 0.08})
    add_row(made, "lucky", {"k": 2}, 0.047, 1.0, validation={"rel_l2_median": 0.05})
    add_row(made, "old", {"k": 1}, 0.061, 1.0)
    add_row(made, "old", {"k": 2}, 0.033, 1.0)
    analysis = analyse(made, n_resamples=50)
    names = short_names(made.rows)
    view = View(made, analysis, [], {"beam-tiny": names}, 0)
    files = {"dataset": {"beam-tiny": ""}, "method": {"lucky": "", "old": ""}}
    lucky, old = (found[0].small for _, found in standings(view, files).methods)
    assert lucky == "test error 4.7 % (most accurate on the validation part)"
    assert old == "test error 3.3 % (smallest error, selected on the test set: optimistic)"
    entries = entries_of(made, "beam-tiny", analysis)
    shown = {label: str(name) for label, name in names.items()}
    found = method_card(verdict_of(analysis, "beam-tiny"), entries, shown, "lucky")
    (pick,) = found.rankings[0].picks
    assert (pick.name, pick.error) == ("lucky · k2", "4.7")
    assert pick.part == "most accurate on the validation part"


def test_the_finding_above_a_distribution_is_that_of_a_drawn_curve(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "fem", {}, 1e-9, 0.5, reference=True)
    add_row(made, "pod", {}, 0.02, 1.0)
    text = text_of(page_of(made))
    assert "pod: 95 % of the test loads" in text
    assert "fem: 95 % of the test loads" not in text


def test_the_details_and_the_card_say_what_a_method_is_told_and_built_for(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    made.methods["pod"] = {"title": "POD", "regime": {"says": "large meshes", "min_dofs": 10**6}}
    add_row(made, "pod", {}, 0.002, 1.0, told="equations", snapshots=True)
    page = page_of(made)
    (data,) = data_of(page)
    details = dict(dict(data["rows"][0]["details"])["Method"])
    assert details["built for"] == "large meshes"
    assert details["tested there"].startswith("no: 0 degrees of freedom; it needs")
    assert "pod †" in text_of(page)
    assert f"are built for: pod: {details['tested there'].removeprefix('no: ')}." in text_of(page)
    assert "told: equations, snapshots" in text_of(page)


def test_a_reference_with_a_loose_tolerance_has_errors_like_any_other(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "fem", {}, 0.001, 0.5, reference=True)
    add_row(made, "pod", {}, 0.02, 1.0)
    page = page_of(made)
    assert "fem: 95 % of the test loads" in text_of(page)
    (data,) = data_of(page)
    assert [line["label"] for line in data["deformations"]] == ["fem", "pod"]


def test_the_speed_up_over_a_full_order_model_that_is_too_slow_is_stated(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "fem", {}, 0.001, 40.0, reference=True)
    add_row(made, "pod", {"n_modes": 3}, 0.002, 1.0)
    add_row(made, "pod", {"n_modes": 2}, 0.9, 0.5)
    add_row(made, "linear-fem", {}, 0.8, 0.1)
    text = text_of(page_of(made))
    said = "The speed-up to quote is 40: over fem, the fastest full-order model that was tried"
    assert said in text
    assert "Faster, but do not qualify: linear-fem and pod · r2." in text


def test_the_page_says_how_to_use_the_winner_in_python(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {"n_modes": 3}, 0.002, 1.0)
    code = unescape(page_of(made))
    lines = [
        'data = mor_bench.load_dataset("beam-tiny")',
        'method = mor_bench.load_method("pod", n_modes=3)',
        "method.fit(data.scene, data.train)",
        "u = method.predict(data.test.forces[0])",
    ]
    assert "\n".join(lines) in code
    assert compile("\n".join(lines), "page", "exec")


def test_many_unstable_timings_become_one_line(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    for i in range(5):
        row = add_row(made, "pod", {"n_modes": i + 1}, 0.005, 1.0 + i)
        doubt = {"stable": False, "unstable_because": [f"processes differ by {10 + i} %"]}
        made.put(changed(row, latency_ms=doubt))
    page = page_of(made, analyse(made, n_resamples=50))
    outside = re.sub(r"<details>.*?</details>", "", markup_of(page), flags=re.DOTALL)
    text = text_of(outside)
    assert text.count("5 of 5 timings were not stable") == 1
    assert text.count("5 unstable timings") == 1
    assert "processes differ" not in text
    assert "--retime" in text
    assert "processes differ by 14 %" in text_of(page)


def test_the_vendored_scripts_are_those_of_their_packages() -> None:
    vendor = files("mor_bench.report") / "vendor"
    noted = re.findall(
        r"^\| `([^`]+)` .*`([0-9a-f]{64})` \|$", (vendor / "README.md").read_text(), re.M
    )
    assert {name for name, _ in noted} == {p.name for p in vendor.iterdir() if ".min." in p.name}
    for name, digest in noted:
        assert hashlib.sha256((vendor / name).read_bytes()).hexdigest() == digest


def test_the_worst_loads_are_told_apart() -> None:
    arrays = {
        "relative_l2": np.array([0.05, 0.002, 0.019]),
        "max_nodal_m": np.array([0.0004, 0.0003, 0.0114]),
        "amplitude_m": np.array([0.0076, 0.15, 0.46]),
    }
    middle, relative, absolute = worst_cases(arrays)
    assert middle == (
        "Medians of the test loads: relative L2 error 1.9 %, "
        "largest error at a node 0.4 mm, largest displacement 150 mm."
    )
    assert relative == (
        "Largest relative L2 error of all test loads: 5 % "
        "(a small load, test load 0, largest displacement 7.6 mm)."
    )
    assert absolute == (
        "Largest error in mm: 11.4 mm at a node (test load 2, 1.9 %, largest displacement 460 mm)."
    )
    bodies = "Largest mean error e, drawn under Deformed bodies: "
    for e, said in (
        ([1e-5, 1e-5, 1e-3], "the one with the largest error in mm."),
        ([1e-3, 1e-5, 1e-5], "the one with the largest relative error."),
        ([1e-5, 1e-3, 1e-5], "test load 1 (0.3 mm at a node, 0.2 %)."),
    ):
        assert worst_cases({**arrays, "mean_dof_m": np.array(e)})[3] == bodies + said
    assert worst_cases({"relative_l2": np.ones(3)}) == []
    assert worst_cases({**arrays, "relative_l2": np.array([1.0, np.inf, 0.1])}) == []


def test_each_worst_says_which_one_it_is(comparison: Comparison, page: str) -> None:
    (data,) = data_of(page)
    row = comparison.row("beam-tiny", data["winner"])
    arrays = comparison.samples(row)
    error = arrays["worst_prediction"] - arrays["worst_reference"]
    drawn = float(np.linalg.norm(error) / np.linalg.norm(arrays["worst_reference"]))
    nodal = 1e3 * np.linalg.norm(error, axis=1).max()
    assert row.error is not None
    largest = percent(row.error.rel_l2_max)
    assert percent(drawn) != largest
    text = text_of(page.replace("\N{NO-BREAK SPACE}", " "))
    assert f"largest: {largest} %" in text  # the card
    assert (
        f"pod · r20, the test load with its largest mean error e: {number(nodal)} mm at a node, "
        f"relative L2 error {percent(drawn)} % (largest of all test loads: {largest} %)." in text
    )
    sample = next(s for s in data["bodies"]["samples"] if s["label"] == data["winner"])
    assert sample["caption"] == unbroken(f"{number(nodal)} mm, {percent(drawn)} %")


def test_no_line_of_the_page_breaks_inside_a_figure(page: str) -> None:
    text = unescape(re.sub(r"<[^>]*>", " ", markup_of(page)))
    assert not re.search(r"\d (%|(ms|mm)\b)", text)
    assert not re.search(r"\d–\d", text)
    assert re.search("\\d\N{WORD JOINER}–\N{WORD JOINER}\\d", text)
    for shown in data_of(page)[0]["rows"]:
        assert not re.search(r"\d–\d", json.dumps(shown["cells"], ensure_ascii=False))


def test_the_bars_of_the_whole_cost_show_every_part(tmp_path: Path) -> None:
    def costs(*lines: CostLine) -> Costs:
        return Costs(1.0, "fem", [CostLine("fem", "fem", "fem", 0.0, 0.0, 1e-3, None), *lines])

    quick = CostLine("pca", "pca", "pca", 22.0, 3.0, 2e-5, 26_000)
    slow = CostLine("net", "net", "net", 22.0, 9000.0, 2e-5, 9_200_000)
    for found, expected in (
        (costs(quick, slow), 10_000),
        (costs(slow), 10_000_000),
        (costs(CostLine("never", "never", "never", 10.0, 0.0, 1e-2, None)), 1_000),
    ):
        assert found.queries == expected
        for line in found.lines[1:2]:
            share = (line.data + line.fit) / line.total(found.queries)
            assert 0.05 < share < 0.995
    assert costs(quick, slow).most_queries == 10**8
    assert " at 1 %, pca pays off first" in costs(quick).finding
    missed = replace(costs(quick), missed=0.5)
    assert " at 1 % (none reaches 0.5 %), pca pays off first" in missed.finding


@pytest.mark.parametrize(("need", "missed"), [(0.01, 1.0), (0.007, None), (0.03, None)])
def test_a_need_is_missed_only_if_methods_were_compared_at_it(
    tmp_path: Path, need: float, missed: float | None
) -> None:
    made = tiny(tmp_path)
    made.datasets["beam-tiny"]["needs"]["error"] = need
    add_row(made, "fem", {}, 0.001, 4.0, reference=True)
    add_row(made, "pod", {}, 0.02, 1.0)
    found = costs_of(made, "beam-tiny", analyse(made), entries_of(made, "beam-tiny"))
    assert found
    assert found.target == 3.0
    assert found.missed == missed


def test_the_appendix_says_how_to_measure_what_is_missing(page: str) -> None:
    text = text_of(page)
    command = r"mor-bench run beam-tiny --profile full"
    assert re.search(f"did not measure Learning curves, [^:]*: {command}", text)
    assert re.search(f"Errors beyond the training loads were not measured; {command}", text)


def test_the_runner_up_is_one_of_another_method_with_the_same_words(tmp_path: Path) -> None:
    def text(folder: str, *others: str) -> str:
        made = tiny(tmp_path / folder)
        for rank, latency in ((5, 1.0), (10, 1.2)):
            add_row(made, "pod", {"n_modes": rank}, 0.002, latency)
        for name in others:
            add_row(made, name, {}, 0.002, 2.0)
        return text_of(page_of(made, analyse(made, n_resamples=50)))

    alone, both = text("alone"), text("both", "hpod")
    assert "best other method hpod" not in alone
    # on the card, and in words
    assert alone.count("No other method that was tried qualifies.") >= 2
    assert both.count("best other method hpod") == 2  # by latency, by offline cost
    assert "Best other method: hpod, 2 ms at 0.2 %." in both
    assert "No other method that was tried qualifies." not in both
