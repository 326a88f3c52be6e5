"""The report page in Chromium: offline, accessible, and its charts and tables react."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import numpy as np
import pytest

from mor_bench.analysis.analyse import analyse
from mor_bench.report.method_styles import DARK, WHITE, contrast
from mor_bench.report.number_format import joined_units, number, percent
from mor_bench.report.page import render
from tests.browser.chromium import Visit, pixels_of, serious_findings, visit
from tests.hostile_runs import hostile_run
from tests.synthetic import synthetic_comparison

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ("tests.browser.rich_page",)
pytestmark = pytest.mark.slow

MOST_BYTES = 6_000_000


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_works_offline_and_is_accessible(
    browser: Browser, path: Path, width: int, scheme: str
) -> None:
    assert path.stat().st_size < MOST_BYTES
    with visit(browser, path, width, color_scheme=scheme) as found:
        found.all_charts()
        assert found.page.evaluate(
            "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
        )
        found.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert not serious_findings(found)
        assert not found.requests
        assert not found.errors


def test_the_pages_of_datasets_and_methods_are_linked(browser: Browser, tmp_path: Path) -> None:
    made = synthetic_comparison(tmp_path, per_region=4)
    other = synthetic_comparison(tmp_path, "beam-tiny", per_region=4)
    made.rows += other.rows
    made.datasets |= other.datasets
    made.write()
    path = render(made, analyse(made, n_resamples=50))[-1]
    own = sum(file.stat().st_size for file in (tmp_path / "pages").rglob("*"))
    assert own < 3 * MOST_BYTES
    with visit(browser, path) as found:
        page = found.page
        page.get_by_role("link", name="A page per dataset and method").click()
        assert not serious_findings(found)
        page.get_by_role("link", name="pca-regression-linear", exact=True).click()
        found.all_charts()
        assert page.locator("h1").inner_text() == "Method pca-regression-linear"
        methods = {row["method"] for section in found.data() for row in section["rows"]}
        assert methods == {"fem", "pca-regression-linear"}  # the front
        assert (
            page.locator(".card .verdict").first.inner_text() == "pca-regression-linear · k20 wins"
        )
        assert not serious_findings(found)
        page.get_by_role("link", name="beam-tiny", exact=True).click()
        found.all_charts()
        assert page.locator("h1").inner_text() == "Dataset beam-tiny"
        (section,) = found.data()
        assert {row["label"] for row in section["rows"]} == {row.label for row in other.rows}
        page.get_by_role("link", name="Everything on one page").click()
        assert page.url == path.as_uri()
        assert not found.errors
        folder = (tmp_path / "pages").as_uri()
        assert all(request.startswith(folder) for request in found.requests)


def test_light_and_dark_differ(browser: Browser, path: Path) -> None:
    seen = {}
    for scheme in ("light", "dark"):
        with visit(browser, path, color_scheme=scheme) as found:
            pixels = pixels_of(found.page.locator(".first"))
            seen[scheme] = pixels.mean()
    assert seen["light"] > 200
    assert seen["dark"] < 80


def test_an_injected_script_does_not_run(open_page: Visit) -> None:
    injected = """() => {
        const script = document.createElement("script");
        script.textContent = "window.injected = true";
        document.body.append(script);
        return window.injected === undefined;
    }"""
    assert open_page.page.evaluate(injected)
    assert any("Content Security Policy" in error for error in open_page.errors)


def test_hover_texts_equal_the_results(open_page: Visit, path: Path) -> None:
    rows = json.loads((path.parent / "results.json").read_text())["rows"]
    label = open_page.data()[0]["winner"]
    row = next(row for row in rows if row["label"] == label)
    place = open_page.page.evaluate(
        """([latency, error]) => {
            const plot = document.querySelector(".frontier .plot");
            const { xaxis, yaxis } = plot._fullLayout;
            const box = plot.getBoundingClientRect();
            return [box.x + xaxis._offset + xaxis.d2p(latency),
                    box.y + yaxis._offset + yaxis.d2p(error)];
        }""",
        [row["latency_ms"]["median"], 100 * row["error"]["rel_l2_median"]],
    )
    open_page.page.mouse.move(place[0] - 2, place[1] - 2)
    open_page.page.mouse.move(*place)
    shown = open_page.page.locator(".frontier .hoverlayer .hovertext tspan.line")
    shown.first.wait_for(timeout=60_000)
    lines = shown.all_text_contents()
    assert lines[0].startswith(row["method"])
    error, latency = row["error"]["rel_l2_median"], row["latency_ms"]["median"]
    assert lines[1].startswith(joined_units(f"error {percent(error)} % ["))
    assert lines[2].startswith(joined_units(f"latency {number(latency)} ms ["))
    for key, value in row["parameters"].items():
        assert f"{key} = {value}" in lines


def test_the_dashed_line_joins_what_nothing_beats(open_page: Visit) -> None:
    """A full-order reference beats others, too."""
    front = open_page.page.evaluate(
        """() => Array.from(document.querySelector(".frontier .plot")._fullData
            .find((t) => t.name === "Pareto front").x)"""
    )
    rows = [r for r in open_page.data()[0]["rows"] if r["error"]["median"] is not None]
    figures = [(r["latency"]["median"], r["error"]["median"]) for r in rows]
    best = [
        (time, error)
        for time, error in figures
        if error < 100 and not any(t < time and e <= error for t, e in figures)
    ]
    assert front == pytest.approx(sorted(time for time, _ in best))
    assert any(r["reference"] and r["latency"]["median"] in front for r in rows)


def test_direct_labels_do_not_overlap_and_have_enough_contrast(open_page: Visit) -> None:
    boxes = open_page.page.evaluate(
        """() => [...document.querySelectorAll(".frontier .annotation-text")]
            .filter((e) => e.textContent.includes("%"))
            .map((e) => e.getBoundingClientRect()).map((b) => [b.x, b.y, b.right, b.bottom])"""
    )
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
    for style in open_page.data()[0]["styles"].values():
        assert contrast(style["text"], WHITE) >= 4.5
        assert contrast(style["dark_text"], DARK) >= 4.5


def test_the_legend_hides_and_isolates_a_trace(open_page: Visit) -> None:
    visible = """() => document.querySelector(".frontier .plot")._fullData
        .filter((t) => t.visible === true).map((t) => t.name)"""
    before = open_page.page.evaluate(visible)
    entry = open_page.page.locator(".frontier .legend .traces", has_text="umesh")
    entry.locator(".legendtoggle").click()
    open_page.page.wait_for_timeout(600)
    assert set(before) - set(open_page.page.evaluate(visible)) == {"umesh †"}
    entry.locator(".legendtoggle").click()
    open_page.page.wait_for_timeout(600)
    entry.locator(".legendtoggle").dblclick()
    open_page.page.wait_for_timeout(600)
    assert open_page.page.evaluate(visible) == ["umesh †"]


def test_the_chart_switches_to_other_figures(open_page: Visit) -> None:
    figure = open_page.page.locator(".frontier")
    first = figure.locator("select").nth(0)
    points = """(method) => {
        const all = document.querySelector(".frontier .plot")._fullData;
        const trace = all.find((t) => t.name === method);
        return [Array.from(trace.x), Array.from(trace.y)];
    }"""
    pod = [row for row in open_page.data()[0]["rows"] if row["method"] == "pod"]
    first.select_option("max")
    figure.locator("select").nth(1).select_option("p95")
    x, y = open_page.page.evaluate(points, "pod")
    assert x == pytest.approx([row["latency"]["p95"] for row in pod])
    assert y == pytest.approx([min(row["error"]["max"], 200) for row in pod])
    figure.locator("select").nth(1).select_option("work")
    assert open_page.page.evaluate(points, "pod")[0] == [row["work"] for row in pod]


def test_findings_follow_what_is_chosen(open_page: Visit) -> None:
    data = open_page.data()[0]
    figure = open_page.page.locator(".frontier")
    finding = figure.locator(".finding")
    verdict = finding.inner_text()
    figure.locator("select").nth(0).select_option("max")
    rows = [row for row in data["rows"] if row["latency"]["median"]]
    errors = [1e9 if row["error"]["max"] is None else row["error"]["max"] for row in rows]
    able = [row for row, e in zip(rows, errors, strict=True) if e <= data["needs"]["error"]]
    best = min(able, key=lambda row: float(row["latency"]["median"]), default=None)
    said = f"{best['name']} is the fastest" if best else "No configuration shown has an error"
    assert finding.inner_text().startswith(said)
    assert finding.inner_text() in (figure.locator(".plot").get_attribute("aria-label") or "")
    figure.locator("select").nth(0).select_option("median")
    assert finding.inner_text() == verdict
    open_page.page.locator(".filter summary").click()
    equations = open_page.page.get_by_label("equations", exact=True)
    equations.uncheck()
    assert "of those shown" in finding.inner_text()
    equations.check()
    assert finding.inner_text() == verdict
    figure = open_page.page.locator(".deformations")
    figure.scroll_into_view_if_needed()
    line = data["deformations"][-1]
    name = next(row["name"] for row in data["rows"] if row["label"] == line["label"])
    figure.locator("select").nth(0).select_option(line["label"])
    assert figure.locator(".finding").inner_text().startswith(f"{name}: the median error e is ")
    figure.locator("select").nth(1).select_option("%")
    said = f"{name}: the median relative L2 error is {percent(line['median_share'][0] / 100)} %"
    assert joined_units(said) in joined_units(figure.locator(".finding").inner_text())


def test_a_heading_sorts_by_mouse_and_by_keyboard(open_page: Visit) -> None:
    values = [row["error"]["median"] for row in open_page.data()[0]["rows"]]
    heading = open_page.page.locator('.grid .tabulator-col[tabulator-field="error_value"]')
    heading.click()
    rising = first_figures(open_page)
    assert rising == [percent(value / 100) for value in sorted(values)]
    assert heading.get_attribute("aria-sort") == "ascending"
    heading.focus()
    open_page.page.keyboard.press("Enter")
    assert first_figures(open_page) == rising[::-1]


def first_figures(found: Visit) -> list[str]:
    """Return the first figure of each row of the table of configurations, from top to bottom."""
    cells = found.page.locator('.grid .tabulator-cell[tabulator-field="error_value"]')
    shown = [(cell.bounding_box() or {"y": 0.0})["y"] for cell in cells.all()]
    texts = cells.evaluate_all(
        "all => all.map((cell) => cell.querySelector('span').firstChild.data)"
    )
    return [text for _, text in sorted(zip(shown, texts, strict=True), key=lambda pair: pair[0])]


def test_filters_reach_table_and_chart(open_page: Visit) -> None:
    page = open_page.page
    rows = page.locator(".grid .tabulator-row")
    n = rows.count()
    page.get_by_label("find").fill("hpod")
    assert 0 < rows.count() < n
    page.get_by_label("find").fill("")
    page.get_by_label("only those that qualify").check()
    qualified = [row for row in open_page.data()[0]["rows"] if row["qualified"]]
    assert rows.count() == len(qualified)


def test_a_name_opens_all_figures_of_its_configuration(open_page: Visit) -> None:
    page = open_page.page
    button = page.locator(".grid button", has_text="umesh").first
    button.focus()
    page.keyboard.press("Enter")
    dialog = page.locator("dialog[open]")
    text = dialog.inner_text()
    (row,) = (row for row in open_page.data()[0]["rows"] if row["label"] == "umesh")
    for _, figures in row["details"]:
        for name, value in figures:
            assert name in text
            assert value in text
    page.keyboard.press("Escape")
    assert not dialog.count()


def test_the_bodies_are_drawn_and_turn_together(open_page: Visit) -> None:
    open_page.all_charts()
    figure = open_page.page.locator(".chart.bodies")
    figure.scroll_into_view_if_needed()
    views = figure.locator(".pair > div > div")
    open_page.page.wait_for_timeout(1500)
    before = [pixels_of(views.nth(i).locator("canvas").first) for i in range(2)]
    for pixels in before:
        colours = np.unique(pixels.reshape(-1, 3), axis=0)
        assert len(colours) > 50
    box = views.nth(0).locator("canvas").first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    open_page.page.mouse.move(x, y)
    open_page.page.mouse.down()
    open_page.page.mouse.move(x + 80, y + 30, steps=6)
    open_page.page.mouse.up()
    open_page.page.wait_for_timeout(1500)
    for i, old in enumerate(before):
        new = pixels_of(views.nth(i).locator("canvas").first)
        assert (np.abs(new.astype(int) - old).max(axis=2) > 20).mean() > 0.005


def test_a_phone_shows_the_first_number_of_every_table(browser: Browser, path: Path) -> None:
    with visit(browser, path, 390) as found:
        found.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        ends = found.page.evaluate(
            r"""() => [...document.querySelectorAll("main table, .grid .tabulator-table")]
                .filter((table) => table.getBoundingClientRect().height > 0)
                .map((table) => {
                    const cells = table.querySelectorAll("tbody td, .tabulator-cell");
                    const first = [...cells].find((cell) => /^[\s+?<-]*\d/.test(cell.textContent));
                    if (!first) return null;
                    const range = document.createRange();
                    range.selectNodeContents(first);
                    return range.getBoundingClientRect().right;
                })"""
        )
    known = [end for end in ends if end is not None]
    assert len(known) >= 12
    assert max(known) <= 390


def test_the_printed_page_holds_the_last_column(
    browser: Browser, path: Path, tmp_path: Path
) -> None:
    pypdf = pytest.importorskip("pypdf")
    with visit(browser, path) as found:
        found.page.pdf(path=tmp_path / "page.pdf", prefer_css_page_size=True)
        groups = {row["group"] for row in found.data()[0]["rows"]}
        label = found.data()[0]["rows"][-1]["name"]
    places: list[tuple[str, float]] = []

    def note(text: str, cm: list[float], tm: list[float], *_: Any) -> None:
        if text.strip():
            places.append((text, cm[0] * tm[4] + cm[2] * tm[5] + cm[4]))

    pages = pypdf.PdfReader(tmp_path / "page.pdf").pages
    texts = [page.extract_text(visitor_text=note) for page in pages]
    text = " ".join(normalize("NFKC", " ".join(texts)).split())  # ligatures
    for word in ("qualifies", "Time at error", "target is “not reached”", label, *groups):
        assert word in text
    width = float(pages[0].mediabox.width)
    assert width == pytest.approx(595, abs=2)
    assert max(x for _, x in places) < width - 10


def test_hostile_names_stay_text(browser: Browser, tmp_path: Path) -> None:
    made = hostile_run(tmp_path / "run")
    page = render(made, analyse(made, n_resamples=50))[-1]
    with visit(browser, page) as found:
        found.all_charts()
        found.page.locator(".grid button").first.click()
        assert "<img src=x onerror" in found.page.locator("dialog[open]").inner_text()
        for element in ("main img:not(.paper)", "main svg:not(.main-svg) a", "svg[onload]"):
            assert not found.page.locator(element).count()
        holding = "[...document.scripts].filter(s => s.text.includes('alert(1)')).map(s => s.id)"
        assert found.page.evaluate(holding) == ["data"]
        assert not found.errors
        assert not found.requests
