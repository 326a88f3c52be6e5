"""The check of links finds a missing page, a missing anchor and what loads from elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.site_links import check, main

SOUND = """<html><head><link rel="stylesheet" href="style.css"></head><body id="top">
<a href="#top">up</a> <a href="sub/">sub</a> <a href="sub/index.html#caf%C3%A9">anchor</a>
<a href="https://example.org/x">other site</a> <img src="data:image/png;base64,AAAA">
</body></html>"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    (tmp_path / "style.css").write_text("")
    (tmp_path / "sub" / "index.html").write_text('<h1 id="café">x</h1>', encoding="utf-8")
    (tmp_path / "index.html").write_text(SOUND)
    return tmp_path


def test_sound_links_pass(site: Path) -> None:
    report = check(site)
    assert report.problems == []
    assert (report.pages, report.internal, report.external) == (2, 4, {"https://example.org/x"})
    assert main([str(site)]) == 0


@pytest.mark.parametrize(
    ("element", "problem"),
    [
        ('<a href="missing.html">', "no such file"),
        ('<a href="../outside.html">', "no such file"),
        ('<img src="missing.png">', "no such file"),
        ('<a href="#nowhere">', "no element has the id 'nowhere'"),
        ('<a href="sub/#nowhere">', "no element has the id 'nowhere'"),
        ('<script src="https://example.org/x.js">', "must not load from elsewhere"),
        ('<link rel="stylesheet" href="//example.org/x.css">', "must not load from elsewhere"),
        ('<a href="https://example">', "no valid address"),
        ('<a href="htp://example.org">', "scheme 'htp'"),
        ('<a href="mailto:nobody">', "no address"),
    ],
)
def test_a_broken_link_is_found(site: Path, element: str, problem: str) -> None:
    (site / "other.html").write_text(element)
    (site.parent / "outside.html").write_text("")
    (found,) = check(site).problems
    assert found.startswith("other.html: ")
    assert problem in found
    assert main([str(site)]) == 1


def test_a_folder_without_pages_fails(tmp_path: Path) -> None:
    assert main([str(tmp_path)]) == 1
    assert main([]) == 2
