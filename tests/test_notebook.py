"""Comparisons and datasets in a notebook: HTML without markup of others, and pictures on axes."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

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


def test_new_axes_are_made_if_none_are_given(made: Comparison) -> None:
    from matplotlib import pyplot

    pyplot.switch_backend("Agg")
    drawn = made.plot_frontier()
    assert drawn.get_ylabel() == "median relative L2 error (%)"
    pyplot.close("all")


def test_what_cannot_be_drawn_is_refused_in_a_line(tmp_path: Path, made: Comparison) -> None:
    with pytest.raises(InvalidInputError, match="did you mean 'beam-coarse'"):
        made.plot_frontier(dataset="beam-coars")
    with pytest.raises(InvalidInputError, match="nothing of this kind to draw for beam-tiny"):
        Comparison(tmp_path, {}, [a_row("pod")]).plot_learning_curves()


def test_the_public_comparison_draws(tmp_path: Path, made: Comparison) -> None:
    assert mor_bench.Comparison is Comparison
    assert isinstance(mor_bench.Comparison.read(made.out), Comparison)
    two = Comparison(tmp_path, {}, [a_row("pod"), a_row("pod", dataset="other")])
    with pytest.raises(InvalidInputError, match="`dataset` is needed"):
        two.plot_frontier()
