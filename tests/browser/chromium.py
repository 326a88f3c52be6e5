"""A headless Chromium for tests, and what a page did in it."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

ARGUMENTS = [
    "--no-sandbox",  # containers run tests as root
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start the system's Chromium; skip the test where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("there is no chromium: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@dataclass
class Visit:
    """An open page, the requests that left it, and its errors and dialogs."""

    page: Page
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def all_charts(self) -> None:
        """Scroll until every chart is drawn."""
        charts = self.page.locator(".chart")
        for i in range(charts.count()):
            charts.nth(i).scroll_into_view_if_needed()
            drawn = charts.nth(i).locator('[data-drawn="yes"]')
            drawn.first.wait_for(state="attached", timeout=120_000)
        self.page.evaluate("window.scrollTo(0, 0)")
        self.page.wait_for_timeout(300)

    def data(self) -> list[dict[str, Any]]:
        """Return the data inside the page."""
        found: list[dict[str, Any]] = self.page.evaluate(
            "JSON.parse(document.getElementById('data').textContent)"
        )
        return found


@contextmanager
def visit(browser: Browser, path: Path, width: int = 1400, **options: Any) -> Iterator[Visit]:
    """Open a page without a network; `options` are those of a browser context."""
    viewport: Any = {"width": width, "height": 900}
    context = browser.new_context(viewport=viewport, offline=True, **options)
    context.set_default_timeout(120_000)
    page = context.new_page()
    found = Visit(page)
    page.on("request", lambda request: _note(found.requests, request.url, path))
    page.on("console", lambda m: found.errors.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    page.on("dialog", lambda dialog: found.errors.append(f"dialog: {dialog.message}"))
    page.goto(path.as_uri())
    page.locator(".chart").first.scroll_into_view_if_needed()  # a chart is drawn when it is near
    page.locator('.chart [data-drawn="yes"]').first.wait_for(state="attached", timeout=60_000)
    page.evaluate("window.scrollTo(0, 0)")
    yield found
    context.close()


def pixels_of(element: Locator) -> Any:
    """Return the pixels of an element as it is shown."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("RGB"))


def serious_findings(found: Visit) -> list[tuple[str, str, str]]:
    """Return what axe finds that hinders readers."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    return [
        (item["id"], node["html"][:200], node.get("failureSummary", "")[:300])
        for item in axe.Axe().run(found.page, options={"preload": False}).response["violations"]
        if item["impact"] in ("serious", "critical")
        for node in item["nodes"]
    ]


def _note(requests: list[str], url: str, path: Path) -> None:
    if url != path.as_uri() and not url.startswith(("data:", "blob:")):
        requests.append(url)
