"""Fixtures: a browser, and the page of a run with everything that a run can measure."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mor_bench.analysis.analyse import analyse
from mor_bench.report.page import render
from tests.browser.chromium import Visit, chromium, visit
from tests.synthetic import synthetic_comparison

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run with everything that a run can measure."""
    made = synthetic_comparison(tmp_path_factory.mktemp("rich"), per_region=8)
    told = {"umesh": "input", "pca-regression-linear": "linear-response"}
    for row in list(made.rows):
        known = {"told": told.get(row.method, "equations")}
        made.put(row.with_parts(reference=row.method == "fem", **known))
    return render(made, analyse(made, n_resamples=200))[-1]


@pytest.fixture
def open_page(browser: Browser, path: Path) -> Iterator[Visit]:
    with visit(browser, path) as found:
        yield found
