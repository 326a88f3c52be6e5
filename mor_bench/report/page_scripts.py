"""Scripts and data inside the page: vendored libraries, own scripts, JSON and their policy."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from markupsafe import Markup

from mor_bench.results.json_file import without_nan

VENDORED = ("plotly-gl3d.min.js", "tabulator.min.js")
"""Libraries in `vendor`; its README names their versions, licences and digests."""

OWN = (
    "theme.js",
    "chart_parts.js",
    "frontier.js",
    "charts.js",
    "bodies.js",
    "tables.js",
    "page.js",
)
"""Scripts in `static`, in the order in which they run."""

STYLES = ("vendor/tabulator.min.css", "static/page.css")


@dataclass(frozen=True)
class Script:
    """A script and its digest, as the page's policy names it."""

    text: Markup
    digest: str


def scripts() -> list[Script]:
    """Read all scripts of the page, the libraries first."""
    paths = [*(f"vendor/{name}" for name in VENDORED), *(f"static/{name}" for name in OWN)]
    return [_script(_read(path)) for path in paths]


def styles() -> Markup:
    """Read the style sheets of the page."""
    # The sheets are files of this package.
    return Markup("\n".join(map(_read, STYLES)).replace("</", r"<\/"))


def policy(included: Iterable[Script]) -> str:
    """Return the page's policy: nothing is loaded, and only the given scripts run."""
    allowed = " ".join(f"'sha256-{script.digest}'" for script in included)
    return (
        f"default-src 'none'; script-src {allowed}; img-src data: blob:; "
        "style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    )


def embedded_json(content: Any) -> Markup:
    """Return JSON that cannot end its script element; NaN and infinity become null."""
    text = json.dumps(_nulls(content), separators=(",", ":"), allow_nan=False)
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)


def _nulls(value: Any) -> Any:
    if isinstance(value, float):
        return value if isinstance(without_nan(value), float) else None
    if isinstance(value, dict):
        return {key: _nulls(item) for key, item in value.items()}
    return [_nulls(item) for item in value] if isinstance(value, list | tuple) else value


def _script(text: str) -> Script:
    # Inside a string, "<\/script" is the same text, and it does not end the element.
    safe = re.sub(r"<(/script|!--)", lambda found: f"\\x3c{found[1]}", text, flags=re.IGNORECASE)
    digest = base64.b64encode(hashlib.sha256(safe.encode()).digest()).decode()
    return Script(Markup(safe), digest)


def _read(path: str) -> str:
    return files("mor_bench.report").joinpath(path).read_text(encoding="utf-8")
