"""Scripts and data inside the page: vendored libraries, own scripts, JSON and their policy."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mor_bench.report.number_format import unbroken
from mor_bench.results.json_file import without_nan
from mor_bench.snapshots.store import make_own_folder, write_atomically

SCRIPTS = (
    "vendor/plotly-gl3d.min.js",
    "vendor/tabulator.min.js",
    "static/theme.js",
    "static/keyboard.js",
    "static/chart_parts.js",
    "static/frontier.js",
    "static/charts.js",
    "static/bodies.js",
    "static/tables.js",
    "static/page.js",
)
"""Scripts in the order in which they run; the README in `vendor` names versions and licences."""

STYLES = ("vendor/tabulator.min.css", "static/page.css")


@dataclass(frozen=True)
class Assets:
    """Style sheets and scripts of a page, as elements, and the policy that lets only them run."""

    styles: Markup
    scripts: Markup
    policy: str


def inlined() -> Assets:
    """Return all style sheets and scripts as text of the page."""
    # Inside a string, "<\/script" is the same text, and it does not end the element.
    texts = [re.sub(r"<(?=/script|!--)", r"\\x3c", _read(path), flags=re.I) for path in SCRIPTS]
    digests = (hashlib.sha256(text.encode()).digest() for text in texts)
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    sheets = "\n".join(map(_read, STYLES)).replace("</", r"<\/")
    return Assets(
        Markup(f"<style>\n{sheets}</style>"),
        Markup("\n".join(f"<script>{text}</script>" for text in texts)),
        _policy(allowed, ""),
    )


def beside(folder: Path) -> Assets:
    """Write all style sheets and scripts to a folder beside the pages, and refer to them."""
    make_own_folder(folder.parent)
    make_own_folder(folder)
    for path in (*STYLES, *SCRIPTS):
        write_atomically(folder / Path(path).name, _read(path).encode())
    hrefs = [f"{folder.name}/{Path(path).name}" for path in (*STYLES, *SCRIPTS)]
    sheets = (f'<link rel="stylesheet" href="{href}">' for href in hrefs[: len(STYLES)])
    scripts = (f'<script src="{href}"></script>' for href in hrefs[len(STYLES) :])
    # On a disk, `'self'` does not hold the files beside the page.
    own = "'self' file:"
    return Assets(Markup("\n".join(sheets)), Markup("\n".join(scripts)), _policy(own, own))


def _policy(scripts: str, styles: str) -> str:
    """Return the policy of a page: nothing else is loaded."""
    return (
        f"default-src 'none'; script-src {scripts}; img-src data: blob:; "
        f"style-src 'unsafe-inline' {styles}; base-uri 'none'; form-action 'none'"
    )


def embedded_json(content: Any) -> Markup:
    """Return JSON that cannot end its script element; NaN and infinity become null.

    Numbers stay beside their units, and intervals whole.
    """
    text = json.dumps(_nulls(content), separators=(",", ":"), allow_nan=False)
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)


def _nulls(value: Any) -> Any:
    if isinstance(value, float):
        return value if isinstance(without_nan(value), float) else None
    if isinstance(value, str):
        return unbroken(value)
    if isinstance(value, dict):
        return {_nulls(key): _nulls(item) for key, item in value.items()}
    return [_nulls(item) for item in value] if isinstance(value, list | tuple) else value


def _read(path: str) -> str:
    return files("mor_bench.report").joinpath(path).read_text(encoding="utf-8")
