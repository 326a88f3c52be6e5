"""Tables of where every published number comes from."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

from tests.published.claims import formatted
from tests.published.run_tables import markdown
from tests.published.stored import ROOT, content_of

_GENERATED = re.compile(r"<!-- from: (\S+) (\S+) ?([^\n]*?) -->")


def numbers(source: str) -> str:
    """Show each sentence with measured numbers, and the file and key of each number."""
    body = []
    for entry in content_of(source)["claim"]:
        text = " ".join(entry["text"].split())
        for value in entry["values"]:
            text = text.replace("{}", f"**{formatted(value)}**", 1)
        places = [f"`{value['file']}`: `{value['key']}`" for value in entry["values"]]
        body.append([entry["page"], text, "<br>".join(places)])
    return markdown(["page", "sentence", "file and key of each number, in order"], _cells(body))


def generated(source: str) -> str:
    """Show each generated table, its evidence, and what its function shows."""
    from tests.published.blocks import TABLES, pages  # which know this module

    body = []
    for path in pages():
        page = path.relative_to(ROOT).as_posix()
        for evidence, name, options in _GENERATED.findall(path.read_text(encoding="utf-8")):
            function = TABLES.get(name)
            if function is None or page == source:
                continue
            meaning = (inspect.getdoc(function) or "").partition("\n")[0]
            files = "<br>".join(f"`{file}`" for file in evidence.split(","))
            body.append([page, files, " ".join([f"`{name}`", options]), meaning])
    return markdown(["page", "evidence", "table and options", "shows"], _cells(body))


def stated(source: str) -> str:
    """Show the texts whose numbers come from no measurement, and why."""
    body = []
    for entry in content_of(source)["stated"]:
        why = f"test `{entry['by']}`" if "by" in entry else entry["why"]
        body += [[entry["page"], " ".join(text.split()), why] for text in entry["texts"]]
    return markdown(["page", "text", "reason"], _cells(body))


def _cells(body: list[list[str]]) -> Iterator[list[str]]:
    for row in body:
        yield [cell.replace("|", "\\|") for cell in row]


NUMBER_TABLES = {"numbers": numbers, "generated": generated, "stated": stated}
