"""What stays readable on a phone: names in the first chart, figures in one line, captions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mor_bench.report.number_format import number
from tests.browser.chromium import Visit, visit

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ("tests.browser.rich_page",)
pytestmark = pytest.mark.slow

BROKEN = r"""() => {
    const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    const figures = new RegExp("(?<![\\w./=+-])\\d[\\d.,]*(?:e[+-]\\d+)?" +
        "(?:\u2060?–\u2060?[\\d.]+)?(?:\\s(?:%|ms|mm|µs|m|s|N|Pa|core-s))?(?![\\w/-])", "g");
    while (walker.nextNode()) {
        const text = walker.currentNode;
        if (text.parentElement.closest("script, style, code, pre, svg")) continue;
        for (const match of text.data.matchAll(figures)) {
            const range = document.createRange();
            range.setStart(text, match.index);
            range.setEnd(text, match.index + match[0].length);
            const boxes = [...range.getClientRects()].filter((b) => b.width > 1);
            const tops = new Set(boxes.map((b) => Math.round(b.y)));
            if (tops.size > 1) found.push(match[0]);
        }
    }
    return found;
}"""
"""Figures whose number, unit or interval stands on two lines."""


def numbered(found: Visit) -> list[tuple[str, str]]:
    """Return number and text of each entry of the list below the first chart."""
    return [
        (str(i + 1), item.inner_text().replace("\N{NO-BREAK SPACE}", " "))
        for i, item in enumerate(found.page.locator(".frontier ol.numbers li").all())
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_list_names_the_numbers_of_the_first_chart(
    browser: Browser, path: Path, scheme: str
) -> None:
    with visit(browser, path, 390, color_scheme=scheme) as found:
        found.page.wait_for_timeout(500)
        data = found.data()[0]
        marked = [row for row in data["rows"] if row["front"] or row["label"] == data["winner"]]
        marked.sort(key=lambda row: row["latency"]["median"])
        entries = numbered(found)
        assert len(entries) == len(marked) > 2
        for (_, text), row in zip(entries, marked, strict=True):
            error, latency = row["error"]["median"], row["latency"]["median"]
            assert text.startswith(f"{row['name']}: {number(error)} %, {number(latency)} ms")
            assert text.endswith("(winner)") == (row["label"] == data["winner"])
        shown = found.page.locator(".frontier .annotation-text").all_text_contents()
        for i, _ in entries:
            assert any(text == i or text.startswith(f"{i}: ") for text in shown), (i, shown)
        size = found.page.locator(".frontier ol.numbers li").first.evaluate(
            "(e) => parseFloat(getComputedStyle(e).fontSize)"
        )
        assert size >= 13
    with visit(browser, path, 1400, color_scheme=scheme) as found:
        assert numbered(found) == []


def test_the_list_follows_what_the_chart_shows(browser: Browser, path: Path) -> None:
    with visit(browser, path, 390) as found:
        found.page.wait_for_timeout(500)
        found.page.locator(".frontier select").nth(0).select_option("max")
        found.page.locator(".frontier select").nth(1).select_option("work")
        found.page.wait_for_timeout(500)
        rows = {row["name"]: row for row in found.data()[0]["rows"]}
        for _, text in numbered(found):
            row = rows[text.partition(": ")[0]]
            shown = f"{number(row['error']['max'])} %, {number(row['work'])} multiply-adds"
            assert shown in text


@pytest.mark.parametrize("width", [390, 1400])
def test_no_figure_and_no_caption_of_a_body_breaks(
    browser: Browser, path: Path, width: int
) -> None:
    with visit(browser, path, width) as found:
        found.all_charts()
        found.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert found.page.evaluate(BROKEN) == []
        captions = found.page.locator(".chart.bodies .caption")
        assert captions.count() == 2
        for caption in captions.all():
            assert caption.inner_text().count(", ") >= 1
            box = caption.bounding_box()
            assert box is not None
            assert box["height"] < 30


def test_the_bars_of_the_cost_can_show_shares(open_page: Visit) -> None:
    open_page.all_charts()
    figure = open_page.page.locator(".chart.costs")
    figure.scroll_into_view_if_needed()
    costs = open_page.data()[0]["costs"]
    ends = """() => [...document.querySelectorAll(".chart.costs .pair > div > div")][1]
        ._fullData.map((t) => Array.from(t.x))"""
    output = figure.locator("output").inner_text()
    assert output == f"{costs['queries']:,}"
    seconds = open_page.page.evaluate(ends)
    totals = [
        line["data"] + line["fit"] + costs["queries"] * line["query"] for line in costs["lines"]
    ]
    assert seconds[-1][1::3] == pytest.approx(totals)
    figure.get_by_label("bars in").select_option("shares")
    open_page.page.wait_for_timeout(400)
    shares = open_page.page.evaluate(ends)
    assert shares[-1][1::3] == pytest.approx([100.0] * len(totals))
    data = [100 * line["data"] / total for line, total in zip(costs["lines"], totals, strict=True)]
    assert shares[0][1::3] == pytest.approx(data)
    assert max(data) > 5  # near the break-even, the training data can be seen
