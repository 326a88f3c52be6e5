"""Check every link of the built site without a network.

    python -m tests.site_links docs/_build/html [--external]

A link inside the site must lead to a file, and its anchor to an element of this page. Nothing that
a page loads may come from elsewhere. Links to other sites are counted, and only their syntax is
checked; `--external` lists them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import SplitResult, unquote, urlsplit

LOADED = {"audio", "embed", "iframe", "img", "script", "source", "track", "video"}
"""Elements that load what they link to."""

LOADED_RELATIONS = {"icon", "modulepreload", "preload", "stylesheet"}
"""Relations of `link` elements that are loaded."""


@dataclass(frozen=True)
class Link:
    """A target as it is written, and whether the browser loads it by itself."""

    target: str
    loaded: bool


class PageParser(HTMLParser):
    """Collects the anchors and links of a page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.anchors: set[str] = set()
        self.links: list[Link] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.anchors |= {found[key] for key in ("id", "name") if key in found}
        relations = set(found.get("rel", "").split())
        loaded = tag in LOADED or (tag == "link" and bool(relations & LOADED_RELATIONS))
        self.links += [Link(found[key], loaded) for key in ("href", "src", "data") if key in found]


@dataclass
class Report:
    """What was checked, and every problem as a line."""

    pages: int = 0
    internal: int = 0
    external: set[str] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)


def parsed(page: Path) -> PageParser:
    """Parse a page."""
    parser = PageParser()
    parser.feed(page.read_text(encoding="utf-8"))
    return parser


def check(folder: Path) -> Report:
    """Check every page below a folder."""
    folder = folder.resolve()
    templates = folder / "_static"  # of the theme: no pages
    paths = [path for path in sorted(folder.rglob("*.html")) if templates not in path.parents]
    pages = {path: parsed(path) for path in paths}
    report = Report(pages=len(pages))
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link.target)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                report.external.add(link.target)
                problem = wrong_outside(link, parts)
            else:
                report.internal += 1
                problem = wrong_inside(folder, path, parts, pages)
            if problem:
                report.problems.append(f"{path.relative_to(folder)}: {link.target!r}: {problem}")
    return report


def wrong_outside(link: Link, parts: SplitResult) -> str | None:
    """Say what is wrong with a link to another site; its server is not asked."""
    if link.loaded:
        return "a page must not load from elsewhere"
    if parts.scheme == "mailto":
        return None if "@" in parts.path else "no address"
    if parts.scheme not in ("http", "https"):
        return f"the scheme {parts.scheme!r} is not allowed"
    host = parts.hostname or ""
    sound = "." in host or host == "localhost"
    return None if sound and " " not in link.target else "no valid address"


def wrong_inside(
    folder: Path, page: Path, parts: SplitResult, pages: dict[Path, PageParser]
) -> str | None:
    """Say what is wrong with a link inside the site."""
    target = page
    if parts.path:
        start = folder if parts.path.startswith("/") else page.parent
        target = (start / unquote(parts.path).lstrip("/")).resolve()
    if target.is_dir():
        target /= "index.html"
    if not target.is_relative_to(folder) or not target.is_file():
        return "no such file"
    anchor = unquote(parts.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return f"no element has the id {anchor!r}"
    return None


def lines(report: Report, listed: bool) -> Iterator[str]:
    """Yield the lines of the result."""
    yield from report.problems
    yield from sorted(report.external) if listed else ()
    yield (
        f"{report.pages} pages, {report.internal} links inside the site, "
        f"{len(report.external)} different links to other sites (syntax only), "
        f"{len(report.problems)} problems"
    )


def main(arguments: Sequence[str]) -> int:
    """Print the result; return 1 if there is a problem, or no page."""
    folders = [Path(argument) for argument in arguments if argument != "--external"]
    if len(folders) != 1 or not folders[0].is_dir():
        print("usage: python -m tests.site_links FOLDER [--external]", file=sys.stderr)
        return 2
    report = check(folders[0])
    print("\n".join(lines(report, "--external" in arguments)))
    return 1 if report.problems or not report.pages else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
