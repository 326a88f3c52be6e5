"""The built site in Chromium: offline, accessible, searchable, and no page wider than a phone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.browser.chromium import Visit, chromium, serious_findings
from tests.published.stored import ROOT

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

SITE = ROOT / "docs" / "_build" / "html"
PAGES = ("index", "start", "which-method", "methods/hpod", "theory", "api", "gallery/index")
PHONE, DESKTOP = 390, 1400

OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
FOLDED = "document.querySelectorAll('.bd-article details').forEach(d => d.open = true)"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if not (SITE / "index.html").is_file():
        pytest.skip("the site is not built: sphinx-build -W docs docs/_build/html")
    with chromium() as started:
        yield started


@contextmanager
def site(browser: Browser, width: int, scheme: str = "light") -> Iterator[Visit]:
    """Open a browser without a network; note errors, and requests for anything but the site."""
    viewport: Any = {"width": width, "height": 900}
    options: Any = {"color_scheme": scheme, "reduced_motion": "reduce"}
    context = browser.new_context(viewport=viewport, offline=True, **options)
    page = context.new_page()
    found = Visit(page)
    page.on("request", lambda request: _note(found.requests, request.url))
    page.on("requestfailed", lambda request: found.errors.append(f"not loaded: {request.url}"))
    page.on("console", lambda m: found.errors.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    yield found
    context.close()


def _note(requests: list[str], url: str) -> None:
    if not url.startswith((SITE.as_uri() + "/", "data:", "blob:")):
        requests.append(url)


def go(found: Visit, page: str) -> None:
    """Open a page of the site, and wait until its formulas are drawn."""
    found.page.goto((SITE / f"{page}.html").as_uri())
    found.page.wait_for_load_state("load")
    found.page.evaluate("window.MathJax?.startup?.promise")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_pages_work_offline_and_are_accessible(browser: Browser, width: int, scheme: str) -> None:
    with site(browser, width, scheme) as found:
        for page in PAGES:
            go(found, page)
            theme = found.page.evaluate("document.documentElement.dataset.theme")
            assert theme == scheme
            assert found.page.evaluate(OVERFLOW) <= 0, page
            found.page.evaluate(FOLDED)
            assert not serious_findings(found), page
        assert not found.requests
        assert not found.errors


def test_no_page_is_wider_than_a_phone(browser: Browser) -> None:
    paths = [path for path in SITE.rglob("*.html") if not {"_static", "_modules"} & {*path.parts}]
    names = sorted(path.relative_to(SITE).with_suffix("").as_posix() for path in paths)
    assert len(names) > 60
    wide = {}
    with site(browser, PHONE) as found:
        for name in names:
            go(found, name)
            if (pixels := found.page.evaluate(OVERFLOW)) > 0:
                wide[name] = pixels
        assert not found.requests
    assert not wide


@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_the_search_works_without_a_network(browser: Browser, width: int) -> None:
    with site(browser, width) as found:
        go(found, "index")
        page = found.page
        page.locator("button.search-button__button:visible").first.click()
        page.locator("#pst-search-dialog input[type=search]").fill("singular")
        page.keyboard.press("Enter")
        page.wait_for_url("**/search.html?q=singular*")
        results = page.locator("#search-results ul.search li a")
        results.first.wait_for(timeout=30_000)
        assert results.count() >= 3
        results.first.click()
        page.wait_for_load_state("load")
        assert "search.html" not in page.url
        assert "singular" in page.locator("main").inner_text().lower()
        assert not found.requests
        assert not found.errors


def test_a_search_for_nonsense_finds_nothing(browser: Browser) -> None:
    with site(browser, DESKTOP) as found:
        found.page.goto((SITE / "search.html").as_uri() + "?q=qwxzqwxz")
        found.page.locator("#search-results .search-summary").wait_for(timeout=30_000)
        found.page.wait_for_timeout(500)
        assert found.page.locator("#search-results ul.search li").count() == 0


def test_start_can_be_downloaded_as_a_notebook(browser: Browser) -> None:
    with site(browser, DESKTOP) as found:
        go(found, "start")
        target = found.page.locator("a.download[href$='.ipynb']").get_attribute("href")
        assert target
        text = (SITE / target).resolve().read_text(encoding="utf-8")
        assert "mor_bench.load_dataset" in text
        assert Path(target).name == "start.ipynb"
