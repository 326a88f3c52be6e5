"""What the charts and the table of the page show, and whether it can be read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mor_bench.analysis.analyse import analyse
from mor_bench.report.number_format import number
from mor_bench.report.page import render
from tests.browser.chromium import Visit, visit
from tests.synthetic import changed, synthetic_comparison

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ("tests.browser.rich_page",)
pytestmark = pytest.mark.slow

Box = tuple[float, float, float, float]


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run with many values beyond the axis at almost the same latency."""
    made = synthetic_comparison(tmp_path_factory.mktemp("crowded"), "beam-tiny", per_region=4)
    for i, row in enumerate(list(made.rows)):
        work: dict[str, Any] = {"cost": {"multiply_adds": 4e3 * 2.1**i}}
        if row.method == "fem":
            errors = dict.fromkeys(("rel_l2_median", "rel_l2_p95", "rel_l2_max"), 1e-9)
            work |= {"error": errors, "latency_ms": {"median": 0.5 + 0.01 * i}}
        elif row.method in ("pod", "hpod"):
            work["error"] = {"rel_l2_p95": 30.0 + i, "rel_l2_max": 500.0 + i}
        made.put(changed(row, **work))
    return render(made, analyse(made, n_resamples=50))[-1]


@pytest.fixture
def crowded_page(browser: Browser, crowded: Path) -> Iterator[Visit]:
    with visit(browser, crowded) as found:
        yield found


def choose(found: Visit, error: str, time: str) -> None:
    """Choose what the first chart shows."""
    found.page.locator(".frontier select").nth(0).select_option(error)
    found.page.locator(".frontier select").nth(1).select_option(time)
    found.page.wait_for_timeout(300)


def boxes_of(found: Visit, selector: str) -> list[Box]:
    """Return left, top, right and bottom of elements with a text."""
    return [
        (box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"])
        for element in found.page.locator(selector).all()
        if element.text_content() and (box := element.bounding_box())
    ]


def overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def test_both_bodies_have_one_scale_for_all_axes(open_page: Visit) -> None:
    open_page.all_charts()
    scenes = open_page.page.evaluate(
        """() => [...document.querySelectorAll(".chart.bodies .pair > div > div")]
            .map(({ _fullLayout: { scene } }) => ["x", "y", "z"].map((key) => {
                const [low, high] = scene[`${key}axis`].range;
                return scene.aspectratio[key] / (high - low);
            }))"""
    )
    assert len(scenes) == 2
    assert scenes[0] == pytest.approx([scenes[0][0]] * 3)
    assert scenes[1] == pytest.approx(scenes[0])


def test_hovering_shows_what_is_plotted(crowded_page: Visit) -> None:
    choose(crowded_page, "max", "work")
    texts = crowded_page.page.evaluate(
        """() => Object.fromEntries(document.querySelector(".frontier .plot")._fullData
            .filter((t) => t.hovertext).map((t) => [t.name, t.hovertext]))"""
    )
    row = next(r for r in crowded_page.data()[0]["rows"] if r["method"] == "umesh")
    name, error, work, *rest = texts["umesh †"][0].split("<br>")
    assert name == row["name"]
    assert error == f"error, maximum: {row['error']['max']:.3g} %"
    assert work.startswith("work: ")
    assert f"{float(work.split()[1]):.1e}" == f"{row['work']:.1e}"
    assert f"median {row['hover'][1]}" in rest
    assert f"median {row['hover'][2]}" in rest
    choose(crowded_page, "median", "p95")
    lines = crowded_page.page.evaluate(
        """() => document.querySelector(".frontier .plot")._fullData
            .find((t) => t.name === "umesh †").hovertext[0]"""
    ).split("<br>")
    assert lines[1] == row["hover"][1]
    assert lines[2].startswith("latency, 95th percentile: ")


@pytest.mark.parametrize("width", [390, 1000, 1400])
def test_no_label_of_a_chart_covers_another(browser: Browser, crowded: Path, width: int) -> None:
    with visit(browser, crowded, width) as found:
        for error, time in product(("median", "p95", "max"), ("median", "work")):
            choose(found, error, time)
            labels = boxes_of(found, ".frontier .annotation-text")
            labels += boxes_of(found, ".frontier .textpoint text")
            ticks = boxes_of(found, ".frontier .xtick text")
            assert len(labels) > 2
            assert len(ticks) >= 2
            for texts in (labels, ticks):
                assert not [pair for pair in combinations(texts, 2) if overlap(*pair)]


def test_hidden_methods_have_no_labels(crowded_page: Visit) -> None:
    page = crowded_page.page
    shown = ".frontier .annotation-text"
    assert sum("fem · tol" in text for text in page.locator(shown).all_text_contents()) >= 2
    entry = page.locator(".frontier .legend .traces").filter(
        has=page.locator("text", has_text="fem").filter(has_not_text="linear")
    )
    entry.first.locator(".legendtoggle").click()
    page.wait_for_timeout(800)
    assert not [t for t in page.locator(shown).all_text_contents() if t.startswith("fem")]
    choose(crowded_page, "p95", "median")
    hidden = """() => document.querySelector(".frontier .plot")._fullData
        .filter((t) => t.visible === "legendonly").map((t) => t.name)"""
    assert page.evaluate(hidden) == ["fem"]  # another choice keeps it hidden


def test_long_axes_of_counts_have_short_numbers(crowded_page: Visit) -> None:
    choose(crowded_page, "median", "work")
    ticks = crowded_page.page.locator(".frontier .xtick text").all_text_contents()
    assert {"10k", "1M"} <= set(ticks)
    crowded_page.all_charts()
    ticks = crowded_page.page.locator(".costs .xtick text").all_text_contents()
    assert {"1", "10k"} <= set(ticks)


def test_numbers_in_charts_have_the_form_of_the_tables(open_page: Visit) -> None:
    values = [None, 0, 1.23456, 99.94, 99.96, 5957.3, 1e5, 0.00023149, 0.000999, -12.345, 1e-12]
    shown = open_page.page.evaluate("(all) => all.map(Report.short)", values)
    assert shown == [number(value) for value in values]


@pytest.mark.parametrize("field", ["name", "answer"])
def test_texts_with_numbers_sort_by_the_numbers(open_page: Visit, field: str) -> None:
    heading = open_page.page.locator(f'.grid .tabulator-col[tabulator-field="{field}"]')
    heading.click()
    cells = open_page.page.locator(f'.grid .tabulator-cell[tabulator-field="{field}"]')
    tops = [(cell.bounding_box() or {"y": 0.0})["y"] for cell in cells.all()]
    texts = [text for _, text in sorted(zip(tops, cells.all_text_contents(), strict=True))]
    if field == "name":
        pod = [text for text in texts if text.startswith("pod · ")]
        assert pod == ["pod · r3", "pod · r10", "pod · r40", "pod · r80"]
        fem = [text for text in texts if text.startswith("fem · ")]
        assert fem == ["fem · tol 1e-08", "fem · tol 0.01", "fem · tol 0.1"]
    else:
        found = (re.search(r"error, 95\s% bound\s(\S+)", text) for text in texts)
        numbers = [float(match[1]) for match in found if match]
        assert len(numbers) > 5
        assert numbers == sorted(numbers)


def test_a_search_without_a_hit_says_so(open_page: Visit) -> None:
    page = open_page.page
    status = page.locator(".dataset [role=status]")
    assert status.inner_text() == ""
    page.get_by_label("find").fill("no such method")
    assert status.inner_text().startswith("No configuration matches")
    page.get_by_label("find").fill("")
    assert status.inner_text() == ""


def test_the_first_screen_holds_the_verdict_and_its_doubts(open_page: Visit) -> None:
    for selector in (".verdict", ".pick dl", ".mesh", ".stability", ".card pre", ".frontier .plot"):
        box = open_page.page.locator(f".first {selector}").first.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= 900, selector
    hidden = "(e) => e.scrollHeight - e.clientHeight"
    assert open_page.page.locator(".card pre").first.evaluate(hidden) <= 2


def test_no_figure_breaks_in_print(open_page: Visit) -> None:
    open_page.page.emulate_media(media="print")
    open_page.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    broken = open_page.page.evaluate(
        r"""() => [...document.querySelectorAll("main td")].flatMap((cell) => {
            const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
            const found = [];
            while (walker.nextNode()) {
                const text = walker.currentNode, words = /\d[\d.,eE+–-]*/g;
                for (const match of text.data.matchAll(words)) {
                    const range = document.createRange();
                    range.setStart(text, match.index);
                    range.setEnd(text, match.index + match[0].length);
                    const tops = new Set([...range.getClientRects()].map((b) => Math.round(b.y)));
                    if (tops.size > 1) found.push(match[0]);
                }
            }
            return found;
        })"""
    )
    assert broken == []
