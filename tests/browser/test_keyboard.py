"""Legends and 3D views by keyboard alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.browser.chromium import Visit, pixels_of

pytest_plugins = ("tests.browser.rich_page",)
pytestmark = pytest.mark.slow

VISIBLE = """() => document.querySelector(".frontier .plot")._fullData
    .filter((t) => t.visible === true).map((t) => t.name)"""

CAMERAS = """() => [...document.querySelectorAll(".chart.bodies .pair > div > div")]
    .map((view) => view._fullLayout.scene.camera.eye)"""

FIRST_ENTRY = """() => document.querySelector(".frontier .legendtoggle")
    .getAttribute("aria-label")"""

FOCUSED = "document.activeElement.getAttribute('aria-label') ?? ''"


def tab_to(found: Visit, beginning: str) -> str:
    """Press Tab until an element has the focus whose name begins so; return its name."""
    for _ in range(60):
        found.page.keyboard.press("Tab")
        name = str(found.page.evaluate(FOCUSED))
        if name.startswith(beginning):
            return name
    raise AssertionError(f"Tab does not reach {beginning!r}")


def arrow_to(found: Visit, beginning: str) -> str:
    """Press Tab until the legend has the focus, then an arrow until one of its entries has it."""
    tab_to(found, found.page.evaluate(FIRST_ENTRY))
    for _ in range(60):
        name = str(found.page.evaluate(FOCUSED))
        if name.startswith(beginning):
            return name
        found.page.keyboard.press("ArrowDown")
    raise AssertionError(f"no entry of the legend begins with {beginning!r}")


def test_the_legend_hides_and_isolates_by_keyboard(open_page: Visit) -> None:
    page, plot = open_page.page, open_page.page.locator(".frontier .plot")
    before = page.evaluate(VISIBLE)
    plain = pixels_of(plot)
    assert arrow_to(open_page, "umesh †:").endswith(
        "Enter hides or shows it, Shift+Enter shows it alone, arrow keys go to the others"
    )
    assert (np.abs(pixels_of(plot).astype(int) - plain).max(axis=2) > 60).sum() > 200  # a frame
    page.keyboard.press("Enter")
    page.wait_for_timeout(800)
    assert set(before) - set(page.evaluate(VISIBLE)) == {"umesh †"}
    assert page.evaluate(FOCUSED).startswith("umesh †:")
    assert page.evaluate("document.activeElement.getAttribute('aria-pressed')") == "false"
    page.keyboard.press("Space")
    page.wait_for_timeout(800)
    assert page.evaluate(VISIBLE) == before
    page.keyboard.press("Shift+Enter")
    page.wait_for_timeout(800)
    assert page.evaluate(VISIBLE) == ["umesh †"]
    page.keyboard.press("Shift+Enter")
    page.wait_for_timeout(800)
    assert page.evaluate(VISIBLE) == before
    page.keyboard.press("Tab")
    assert not page.evaluate(FOCUSED).startswith("umesh †:")


def test_every_legend_is_one_stop_whose_entries_arrows_reach(open_page: Visit) -> None:
    open_page.all_charts()
    page = open_page.page
    page.wait_for_timeout(500)
    legends = [
        legend.locator(".traces .legendtoggle")
        for legend in page.locator(".js-plotly-plot:has(.legend .traces)").all()
    ]
    assert sum(toggles.count() for toggles in legends) > 20
    for toggles in legends:
        n = toggles.count()
        assert {toggle.get_attribute("role") for toggle in toggles.all()} == {"button"}
        stops = [toggle.get_attribute("tabindex") for toggle in toggles.all()]
        assert stops == ["0"] + ["-1"] * (n - 1)
        names = [str(toggle.get_attribute("aria-label")) for toggle in toggles.all()]
        toggles.first.focus()
        for key, i in (("ArrowUp", n - 1), ("Home", 0), ("End", n - 1), ("ArrowRight", 0)):
            page.keyboard.press(key)
            assert page.evaluate(FOCUSED) == names[i]


def test_the_bodies_turn_zoom_and_deform_by_keyboard(open_page: Visit) -> None:
    open_page.all_charts()
    page, figure = open_page.page, open_page.page.locator(".chart.bodies")
    figure.scroll_into_view_if_needed()
    page.wait_for_timeout(1500)
    view = figure.locator(".pair > div > div").first
    figure.locator("input").first.focus()  # the slider stands before the views
    value = figure.locator("output").inner_text()
    page.keyboard.press("ArrowRight")
    assert figure.locator("output").inner_text() != value
    assert "arrow keys turn" in tab_to(open_page, "left view")
    page.wait_for_timeout(800)
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(outline) == "solid"
    pixels, before = pixels_of(view), page.evaluate(CAMERAS)
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(1500)
    turned = page.evaluate(CAMERAS)
    assert turned[0] == pytest.approx(turned[1])
    assert distance(turned[0]) == pytest.approx(distance(before[0]))
    assert turned[0]["z"] == pytest.approx(before[0]["z"])
    angles = [np.arctan2(eye["y"], eye["x"]) for eye in (before[0], turned[0])]
    assert angles[1] - angles[0] == pytest.approx(0.15)
    assert (np.abs(pixels_of(view).astype(int) - pixels).max(axis=2) > 20).mean() > 0.005
    page.keyboard.press("ArrowUp")
    page.keyboard.press("+")
    page.wait_for_timeout(1500)
    zoomed = page.evaluate(CAMERAS)
    assert distance(zoomed[1]) == pytest.approx(distance(turned[1]) / 1.15)
    assert zoomed[1]["z"] / distance(zoomed[1]) > turned[1]["z"] / distance(turned[1])
    page.keyboard.press("Home")
    page.wait_for_timeout(1500)
    for eye, old in zip(page.evaluate(CAMERAS), before, strict=True):
        assert eye == pytest.approx(old)
    assert "right view" in tab_to(open_page, "right view")


def distance(eye: dict[str, float]) -> float:
    """Return the distance of a camera."""
    return float(np.linalg.norm([eye[key] for key in "xyz"]))
