"""Text from files stays text: in the report, in the terminal, and in names of files."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import shutil
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from rich.console import Console

from mor_bench.analysis.analyse import analyse
from mor_bench.errors import StoreError
from mor_bench.hard_cases.catalogue import CaseResult
from mor_bench.hard_cases.suite import StressResults
from mor_bench.report.console_tables import print_tables
from mor_bench.report.page import STRESS, render
from mor_bench.results.comparison import Comparison
from mor_bench.specs import list_suite
from tests.commands import invoke
from tests.hostile_runs import HOSTILE, hostile_run
from tests.small_runs import method_file, run_small

TAGS = {
    *("html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "h4", "p", "br", "small"),
    *("b", "div", "table", "thead", "tbody", "tr", "th", "td", "figure", "img", "figcaption", "dl"),
    *("dt", "dd", "a", "fieldset", "legend", "label", "input", "details", "summary", "code"),
    *("ul", "li", "pre", "header", "nav", "main", "section", "footer", "noscript", "caption"),
    *("button", "dialog", "form", "script", "span", "link"),
}
ATTRIBUTES = {
    *("charset", "name", "content", "http-equiv", "lang", "class", "colspan", "rowspan", "alt"),
    *("src", "href", "id", "type", "checked", "data-told", "value", "scope", "tabindex", "role"),
    *("aria-label", "aria-labelledby", "data-by", "data-chart", "data-index", "method", "rel"),
}


class Page(HTMLParser):
    """All tags and attributes of a page, its policy, and its scripts with their types."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.sources: set[str] = set()
        self.policy = ""
        self.scripts: list[tuple[str, str]] = []
        self.in_script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        self.sources |= {(value or "")[:10] for name, value in attrs if name in ("src", "href")}
        found = dict(attrs)
        self.in_script = tag == "script"
        if self.in_script:
            self.scripts.append((found.get("type") or "", ""))
        if found.get("http-equiv") == "Content-Security-Policy":
            self.policy = str(found["content"])

    def handle_data(self, data: str) -> None:
        if self.in_script:
            kind, text = self.scripts[-1]
            self.scripts[-1] = kind, text + data

    def handle_endtag(self, tag: str) -> None:
        self.in_script = False


@pytest.fixture
def run(tmp_path: Path) -> Comparison:
    return hostile_run(tmp_path / "outer" / "run")


def test_no_text_of_a_file_becomes_markup_or_leads_out_of_the_folder(
    run: Comparison, tmp_path: Path
) -> None:
    bad = HOSTILE
    tried = CaseResult(bad, bad, bad, bad, bad, "fall short", {}, 1.0)
    methods = dict.fromkeys(row.method for row in run.rows)
    rows = [replace(tried, method=method) for method in methods]
    StressResults(rows, "quick", {}).write(run.out / STRESS)
    pages = [path for path in render(run, pages=True) if path.suffix == ".html"]
    assert len(pages) == 2 + 1 + len(methods)
    for path in pages:
        text = path.read_text(encoding="utf-8")
        page = Page(text)
        assert page.tags <= TAGS
        assert page.attributes <= ATTRIBUTES
        assert all(not source.startswith(("http", "//", "java")) for source in page.sources)
        scripts = page.policy.partition("script-src ")[2].partition(";")[0]
        assert page.policy.startswith("default-src 'none'; ")
        assert scripts
        own = {source for source in scripts.split() if not source.startswith("'sha256-")}
        assert own <= {"'self'", "file:"}
        assert "&lt;script&gt;alert(1)" in text
        assert "{{ 7*7 }}" in text
    assert [path.name for path in tmp_path.iterdir()] == ["outer"]
    assert [path.name for path in (tmp_path / "outer").iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["figures", "pages"])
def test_a_report_is_not_written_through_a_link(name: str, run: Comparison, tmp_path: Path) -> None:
    (tmp_path / "victim").mkdir()
    (run.out / name).symlink_to(tmp_path / "victim")
    with pytest.raises(StoreError, match=f"{name}: is a link to another folder"):
        render(run, pages=True)
    assert not list((tmp_path / "victim").iterdir())


def test_only_the_packages_own_scripts_may_run(run: Comparison) -> None:
    page = Page(render(run)[-1].read_text(encoding="utf-8"))
    rules = dict(rule.strip().split(" ", 1) for rule in page.policy.split(";"))
    assert rules["default-src"] == "'none'"
    allowed = re.findall(r"'sha256-([^']+)'", rules["script-src"])
    assert rules["script-src"] == " ".join(f"'sha256-{digest}'" for digest in allowed)
    runs = [text for kind, text in page.scripts if kind != "application/json"]
    assert [sha256_of(text) for text in runs] == allowed
    (data,) = (text for kind, text in page.scripts if kind == "application/json")
    assert not {"<", ">", "&"} & set(data)
    assert HOSTILE in json.loads(data)[0]["rows"][0]["label"]


def sha256_of(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def test_the_terminal_gets_no_control_characters(run: Comparison) -> None:
    out = io.StringIO()
    print_tables(run, Console(file=out, width=200), analyse(run))
    assert "<script>" in out.getvalue()
    assert not {"\x1b", "\x07"} & set(out.getvalue())


def listed(suite: Path) -> str:
    """List a suite that must be refused; return the line on standard error."""
    done = invoke("list", "--suite", str(suite))
    assert (done.exit_code, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    return done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="names that Windows forbids")
@pytest.mark.parametrize("name", ["A<b>.toml", "x\x1b[31m.toml", "a\nb.toml", "...toml"])
def test_odd_file_names_of_a_suite_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    suite = tmp_path / "suite"
    (suite / "datasets").mkdir(parents=True)
    shutil.copyfile(list_suite("datasets")["beam-tiny"], suite / "datasets" / name)
    assert "`name`" in listed(suite)
    (suite / "methods").mkdir()
    (suite / "datasets" / name).rename(suite / "methods" / name)
    shutil.copyfile(list_suite("methods")["pod"], suite / "methods" / name)
    if not name.isprintable():
        assert "\x1b" not in listed(suite)


@pytest.mark.skipif(sys.platform == "win32", reason="has no /dev")
def test_a_suite_neither_waits_for_devices_nor_shows_other_files(tmp_path: Path) -> None:
    suite = tmp_path / "suite"
    (suite / "datasets").mkdir(parents=True)
    (suite / "datasets" / "a.toml").symlink_to("/dev/zero")
    assert "a device or pipe, not a file" in listed(suite)
    (suite / "datasets" / "a.toml").unlink()
    secret = tmp_path / "secret.msh"
    secret.write_text("the-secret 1 2 3\n")
    shipped = list_suite("datasets")["beam-tiny"].read_text(encoding="utf-8")
    shape = 'shape  = "box"\nsize_m = [2.0, 1.0, 1.0]\ncells  = [6, 2, 2]'
    assert shape in shipped
    text = shipped.replace(shape, 'shape = "file"\nfile = "../../secret.msh"')
    (suite / "datasets" / "b.toml").write_text(text, encoding="utf-8")
    done = invoke("check", str(suite / "datasets" / "b.toml"))
    assert done.exit_code == 2
    assert "secret.msh" in done.stderr
    assert "the-secret" not in done.output


@pytest.mark.slow
def test_a_method_with_markup_for_a_name_stays_in_its_folders(tmp_path: Path) -> None:
    folder, own = tmp_path / "suite" / "methods", tmp_path / "cache"
    folder.mkdir(parents=True)
    if sys.platform == "win32":
        pytest.skip("names that Windows forbids")
    method = method_file(folder, "<script>alert(1)<", "tests.third_party:Zero")
    found = run_small([method], tmp_path / "out", own)
    (row,) = found.rows
    assert row.ok, row.reason
    assert "<script>alert(1)" not in render(found)[-1].read_text(encoding="utf-8")
    assert {path.name for path in tmp_path.iterdir()} == {"suite", "out", "cache"}
    assert len(list((own / "fits").iterdir())) == 1
