"""The site: every method has a card with sources that exist, and links are rewritten."""

from __future__ import annotations

import re
import sys

import pytest

from mor_bench.specs.suite_folder import list_suite
from tests.published.stored import ROOT

sys.path.append(str(ROOT / "docs" / "_ext"))

CARDS = ROOT / "docs" / "cards"


def test_every_method_has_a_card_and_every_card_a_method() -> None:
    assert {path.stem for path in CARDS.glob("*.md")} == set(list_suite("methods"))


def test_cards_have_an_equation_an_algorithm_and_a_cost() -> None:
    for path in CARDS.glob("*.md"):
        headings = re.findall(r"^## (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert headings[:3] == ["Equation", "Algorithm", "Cost"], path.name


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
