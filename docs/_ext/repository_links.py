"""Links of pages to files of the repository outside the site's folder.

The pages are also read in the repository, so their links are relative to it. A file that has a page
here becomes a link to this page; any other file is named without a link.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

PAGES = {
    "../CONTRIBUTING.md": "contributing.md",
    "../reports/README.md": "evidence.md",
    "../reports/notes/experiments.md": "experiments.md",
    "../tests/verification/PLANTED_BUGS.md": "planted-bugs.md",
    "CONTRIBUTING.md": "contributing.md",
    "reports/README.md": "evidence.md",
    "notes/experiments.md": "experiments.md",
    "../docs": "index.md",
}

LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]+)\]\((?P<target>[^)\s]+)\)")
ROLE = re.compile(r"\{[\w:-]+\}`([^`]+)`")
PAGE_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|mailto:)[^)\s]+\.md(?:#[^)\s]*)?\)")


def rewritten(source: str, elsewhere: bool) -> str:
    """Return a page's source with links for the site.

    `elsewhere` tells that the page includes a file from outside the folder, whose own links are
    relative to another place.
    """

    def link(match: re.Match[str]) -> str:
        target, _, anchor = match["target"].partition("#")
        if target in PAGES:
            return f"[{match['text']}]({PAGES[target]}{'#' if anchor else ''}{anchor})"
        if target.startswith("docs/"):
            return f"[{match['text']}]({match['target'].removeprefix('docs/')})"
        outside = target.startswith("../") or elsewhere
        known = not target or target.startswith(("http", "mailto"))
        return match["text"] if outside and not known else match[0]

    return LINK.sub(link, source)


def for_download(notebook: str) -> str:
    """Return a notebook whose text needs no site around it.

    Roles of Sphinx become code, and links to pages of the site their text: a downloaded notebook
    does not know where the site is.
    """
    content = json.loads(notebook)
    for cell in content["cells"]:
        if cell["cell_type"] == "markdown":
            text = ROLE.sub(r"`\1`", "".join(cell["source"]))
            cell["source"] = PAGE_LINK.sub(r"\1", text).splitlines(keepends=True)
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _clean_downloads(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html":
        for path in (Path(app.outdir) / "_downloads").rglob("*.ipynb"):
            path.write_text(for_download(path.read_text(encoding="utf-8")), encoding="utf-8")


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    source[0] = rewritten(source[0], elsewhere=False)


def _included(
    app: Sphinx, path: Any, parent: str, source: list[str]
) -> None:  # of MyST's and docutils' include
    source[0] = rewritten(source[0], elsewhere=True)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _read)
    app.connect("include-read", _included)
    app.connect("build-finished", _clean_downloads)
    return {"parallel_read_safe": True}
