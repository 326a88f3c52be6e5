"""The site: every method has a card with sources that exist, and links are rewritten."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from statistics import median

import pytest

from mor_bench.report.cards import method_card
from mor_bench.specs import load_method_spec
from mor_bench.specs.suite_folder import list_suite
from tests.published.stored import ROOT

sys.path.append(str(ROOT / "docs" / "_ext"))

CARDS = ROOT / "docs" / "cards"


def test_every_method_has_a_card_and_every_card_a_method() -> None:
    assert {path.stem for path in CARDS.glob("*.md")} == set(list_suite("methods"))


def test_cards_have_an_equation_an_algorithm_a_cost_and_a_source() -> None:
    for path in CARDS.glob("*.md"):
        headings = re.findall(r"^## (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        usual = [heading for heading in headings if heading != "Variants"]
        assert usual == ["Equation", "Algorithm", "Cost", "Source"], path.name


def test_every_method_page_says_where_the_method_fails(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import method_cards  # type: ignore[import-not-found]

    for name in list_suite("methods"):
        page = method_cards.card_page(name, tmp_path, draw=False)
        _, _, after = page.partition("\n## Where it fails\n")
        said = after.partition("\n## ")[0].strip()
        assert said.endswith("."), name
        assert said == " ".join(load_method_spec(name).limits.split())


def test_cards_link_to_the_works_that_they_cite(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import method_cards

    for name in list_suite("methods"):
        page = method_cards.card_page(name, tmp_path, draw=False)
        text = (CARDS / f"{name}.md").read_text(encoding="utf-8")
        works = {key: method_cards.bibliography()[key] for key in method_cards.cited(text)}
        known = [key for key, work in works.items() if {"doi", "url"} & set(work)]
        assert known, name
        for key in known:
            # A key in brackets would be a definition of a link, which Markdown does not show.
            assert re.search(rf"^- {key}: <https://\S+>$", page, re.MULTILINE), (name, key)


def test_stated_costs_of_fits_are_near_the_stored_ones() -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import method_cards

    wrong = {}
    for name in list_suite("methods"):
        rows = [row for _, row in method_cards.measured(name) if row.dataset == "beam-coarse"]
        spec = load_method_spec(name)
        usual = spec.parameters_of("quick").get("iterations")
        # A network that the suite ships was trained for longer than the profile trains.
        shares = [
            usual / row.trained_elsewhere.iterations if row.trained_elsewhere and usual else 1.0
            for row in rows
        ]
        stored = [
            share * row.offline_s.fit_core_s
            for share, row in zip(shares, rows, strict=True)
            if row.offline_s
        ]
        stated = spec.fit_seconds("quick")
        if stored and stated and not 1 / 3 <= stated / median(stored) <= 3:
            wrong[name] = (stated, median(stored))
    assert not wrong, "fit_s of the method file, and the median of the stored core-seconds"


def test_a_page_states_which_of_two_trainings_was_measured() -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import method_cards

    (cost,) = [
        line
        for line in method_cards.facts_of("umesh", method_card(load_method_spec("umesh")))
        if line.startswith("cost of a fit")
    ]
    assert "core-seconds on beam-coarse, measured in `quick-start` with the profile quick" in cost
    assert cost.strip().endswith("with the profile full and its 100,000 iterations")


def test_every_cited_work_is_in_the_bibliography_and_every_work_is_cited() -> None:
    bibliography = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
    known = set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))
    cited: set[str] = set()
    for path in [*CARDS.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for keys in re.findall(r"\{cite\}`([^`]+)`", path.read_text(encoding="utf-8")):
            cited |= {key.strip() for key in keys.split(",")}
    assert cited == known


@pytest.mark.parametrize(
    ("source", "elsewhere", "expected"),
    [
        ("[runs](../reports/README.md)", False, "[runs](evidence.md)"),
        (
            "[the list\nof runs](../reports/README.md#a)",
            False,
            "[the list\nof runs](evidence.md#a)",
        ),
        ("[Cost](full-order-model.md#cost)", False, "[Cost](full-order-model.md#cost)"),
        ("[page](docs/datasets.md)", True, "[page](datasets.md)"),
        ("[quick-start](quick-start)", True, "quick-start"),
        ("![picture](a.png)", True, "![picture](a.png)"),
    ],
)
def test_links_lead_to_pages_of_the_site(source: str, elsewhere: bool, expected: str) -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    from repository_links import rewritten  # type: ignore[import-not-found]

    assert rewritten(source, elsewhere=elsewhere) == expected


def test_a_downloaded_notebook_has_no_markup_of_the_site() -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    from repository_links import for_download

    text = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    assert "{nb-download}" in text
    code = {"cell_type": "code", "source": ["a = {'b': [c](d.md)}"]}
    cells = [{"cell_type": "markdown", "source": text.splitlines(keepends=True)}, code]
    cleaned = json.loads(for_download(json.dumps({"cells": cells, "nbformat": 4})))
    prose = "".join(cleaned["cells"][0]["source"])
    assert "download this page as a notebook: `start.ipynb`" in prose
    assert "needs an installed mor-bench" in prose
    assert not re.search(r"\{[\w-]+\}`|\]\([\w./-]+\.md", prose)
    assert cleaned["cells"][1] == code


def test_a_card_joins_configurations_of_one_kind_that_none_of_it_beats() -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import method_cards

    for name in ("deeponet", "quadratic-manifold-pod", "deim", "pod"):
        for stored in method_cards.stored_rows().values():
            rows = [row for row in stored if (row.method, row.dataset) == (name, "beam-coarse")]
            curves = method_cards.curves_of(rows)
            assert sum(map(len, curves.values())) == len(rows)
            for mine in curves.values():
                kinds = {tuple(v for v in row.swept.values() if isinstance(v, str)) for row in mine}
                assert len(kinds) == 1
                errors = [row.error.rel_l2_median for row in method_cards.front_of(mine)]
                assert errors == sorted(errors, reverse=True)
                assert errors[-1] == min(row.error.rel_l2_median for row in mine)
    assert len(method_cards.curves_of([r for _, r in method_cards.measured("deeponet")])) == 2
