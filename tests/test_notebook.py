"""Comparisons and datasets in a notebook: HTML without markup of others, and pictures on axes."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import mor_bench
from mor_bench.analysis.analyse import analyse
from mor_bench.errors import InvalidInputError
from mor_bench.report.notebook import Comparison
from mor_bench.snapshots.dataset import Dataset
from tests.synthetic import a_row, synthetic_comparison

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    found = synthetic_comparison(tmp_path_factory.mktemp("run"), per_region=4)
    found.analysis = analyse(found, n_resamples=100)
    return Comparison.of(found)


@pytest.fixture
def ax() -> Axes:
    figure = Figure()
    FigureCanvasAgg(figure)
    return figure.subplots()


class Tags(HTMLParser):
    """All tags of a text, and the texts of the cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_a_comparison_shows_verdict_and_rows_as_html(made: Comparison) -> None:
    made.rows[0] = made.rows[0].with_parts(method=HOSTILE)
    try:
        shown = Tags(vars(Comparison)["_repr_html_"](made))
    finally:
        made.rows[0] = made.rows[0].with_parts(method="fem")
    assert set(shown.tags) <= {"h3", "p", "table", "caption", "thead", "tbody", "tr", "th", "td"}
    assert shown.tags.count("tr") == 1 + len(made.rows)
    assert any(HOSTILE in text for text in shown.texts)
    assert any(" wins: " in text or "No configuration" in text for text in shown.texts)
    assert "hpod · r3, ctol 0.005" in " ".join(shown.texts)


def test_a_dataset_shows_its_parts_as_html(tiny: Dataset) -> None:
    shown = Tags(vars(Dataset)["_repr_html_"](tiny))
    assert shown.tags.count("tr") == 4
    assert shown.texts[0].startswith("beam-tiny: 63 nodes, 24 cells, 189 degrees of freedom")
    assert [f"{len(part):,}" for part in (tiny.train, tiny.validation, tiny.test)] == [
        shown.texts[shown.texts.index(name) + 1] for name in ("train", "validation", "test")
    ]


def test_the_frontier_is_drawn_at_the_measured_places(made: Comparison, ax: Axes) -> None:
    assert made.plot_frontier(ax) is ax
    row = next(row for row in made.rows if row.method == "umesh")
    assert row.error is not None
    assert row.latency_ms is not None
    line = next(line for line in ax.lines if line.get_label() == "umesh")
    assert np.array(line.get_xydata())[0] == pytest.approx(
        [row.latency_ms.median, 100 * row.error.rel_l2_median]
    )
    assert "Pareto front" in [line.get_label() for line in ax.lines]
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    ax.figure.canvas.draw()


def test_all_pictures_return_axes_with_lines(made: Comparison, ax: Axes) -> None:
    for draw in (
        made.plot_error_distribution,
        made.plot_learning_curves,
        made.plot_singular_values,
    ):
        ax.clear()
        assert draw(ax) is ax
        assert ax.lines
        assert all(np.isfinite(line.get_xydata()).all() for line in ax.lines)
        ax.figure.canvas.draw()


def test_new_axes_are_made_if_none_are_given(made: Comparison) -> None:
    from matplotlib import pyplot

    pyplot.switch_backend("Agg")
    drawn = made.plot_frontier(error="mean_dof_m", latency="p95")
    assert drawn.get_ylabel().endswith("(m)")
    assert "Pareto front" not in [line.get_label() for line in drawn.lines]
    pyplot.close("all")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"error": "rel_l2_medain"},
            "unknown metric 'rel_l2_medain'; did you mean 'rel_l2_median'",
        ),
        ({"latency": "medain"}, "unknown metric 'medain'; did you mean 'median'"),
        ({"dataset": "beam-coars"}, "did you mean 'beam-coarse'"),
    ],
)
def test_an_unknown_name_gets_the_nearest_one(
    made: Comparison, ax: Axes, options: dict[str, str], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        made.plot_frontier(ax, **options)


def test_the_public_comparison_draws(tmp_path: Path, made: Comparison) -> None:
    assert mor_bench.Comparison is Comparison
    assert isinstance(mor_bench.Comparison.read(made.out), Comparison)
    two = Comparison(tmp_path, {}, [a_row("pod"), a_row("pod", dataset="other")])
    with pytest.raises(InvalidInputError, match="`dataset` is needed"):
        two.plot_frontier()
