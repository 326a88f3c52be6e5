"""Links between the Markdown files of the repository lead to files and headings that exist."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.published.stored import ROOT

FILES = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "reports/README.md"),
    *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").glob("*.md"))),
]
LINK = re.compile(r"\]\((?!https?:|mailto:)(?P<path>[^)#\s]*)(?:#(?P<anchor>[^)\s]+))?\)")
GENERATED = ("docs/methods/", "docs/gallery/", "docs/api/")
"""Folders that the site's build writes."""


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ +(.+)$", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(page: Path, root: Path = ROOT) -> Iterator[str]:
    """Yield the links of a page that lead nowhere."""
    text = page.read_text(encoding="utf-8")
    for match in LINK.finditer(re.sub(r"^```.*?^```|`[^`\n]+`", "", text, flags=re.M | re.S)):
        target = (page.parent / match["path"]).resolve() if match["path"] else page
        name = target.relative_to(root).as_posix() if target.is_relative_to(root) else ""
        if name.startswith(GENERATED):
            continue
        if not name or not target.exists():
            yield f"{match[0]}: no such file"
        elif match["anchor"] and match["anchor"] not in anchors(target.read_text("utf-8")):
            yield f"{match[0]}: no such heading"


@pytest.mark.parametrize("page", FILES)
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page: str) -> None:
    assert not list(broken(ROOT / page))


def test_broken_links_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A *b* (c)\n[x](#a-b-c) [y](gone.md) [z](page.md#gone) [o](https://a.b)\n")
    found = list(broken(page, tmp_path))
    assert found == ["](gone.md): no such file", "](page.md#gone): no such heading"]
