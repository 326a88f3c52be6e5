"""Numbers as short texts for tables, captions and sentences."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from typing import Any

DASH = "–"
"""Placeholder of a figure that was not measured."""

UNITS_OF_TIME = (
    ("h", 3600.0, 7200.0),
    ("min", 60.0, 120.0),
    ("s", 1.0, 0.9995),
    ("ms", 1e-3, 1e-4),
)
"""Units of time: name, size in seconds, and the least duration that is given in it, s."""

SHORT_NAMES = {
    "n_modes": "r",
    "tolerance": "tol",
    "cubature_tolerance": "ctol",
    "n_input_modes": "k",
    "n_output_modes": "m",
}
"""Names of swept parameters where space is short; others use the initials of their words."""


MEANINGS = {
    "n_modes": "number of modes",
    "tolerance": "relative residual at which iterations stop",
    "n_input_modes": "number of input modes",
    "n_output_modes": "number of output modes",
    "cubature_tolerance": "accepted error of the cubature",
    "n_latent": "number of latent coordinates",
    "n_force_modes": "number of modes of the internal force",
    "n_clusters": "number of clusters of snapshots",
    "n_terms": "number of separated terms",
    "max_terms": "largest number of terms",
    "position_degree": "polynomial degree in the position of the load",
    "static_correction": "linear answer to what the reduced model leaves of the load",
}
"""Meanings of the suite's swept parameters with short names."""

BEFORE_UNIT = re.compile(
    r"(?<=\d) (?=(?:%|[nµm]?s|min|h|[kmµ]?m[²³]?|[kM]?N|[kMG]?B|[kMG]?Pa"
    r"|core-(?:s|min|h)|core-seconds|times)(?![\w/-]))"
)
"""The space between a number and its unit."""


def joined_units(text: str) -> str:
    """Return a text in which no line breaks between a number and its unit."""
    return BEFORE_UNIT.sub("\N{NO-BREAK SPACE}", text)


_IN_INTERVAL = re.compile(r"(?<=[\d∞])–(?=[\d∞])")
"""The dash of an interval."""

_IN_UNIT = re.compile("(?<=\N{NO-BREAK SPACE}core)-(?=[a-z])")
"""The hyphen of a unit such as core-s."""


def unbroken(text: str) -> str:
    """As `joined_units`; on the page no line breaks inside an interval or a unit either."""
    joiner = "\N{WORD JOINER}"
    joined = _IN_INTERVAL.sub(f"{joiner}–{joiner}", joined_units(text))
    return _IN_UNIT.sub(f"-{joiner}", joined)


def number(value: float | None) -> str:
    """Format a number in at most seven characters; a dash if there is none."""
    if value is None:
        return DASH
    if not isfinite(value):
        return str(value)
    size = abs(value)
    if size == 0 or 1e-3 <= size < 99.95:
        return f"{value:.3g}"
    return f"{value:.0f}" if 1 <= size < 1e5 else f"{value:.1e}"


def whole(value: float | None) -> str:
    """Format a count with separators of thousands; a dash if there is none."""
    return DASH if value is None else f"{value:,.0f}"


def metres(value: float | None) -> str:
    """Format a length such as 6.4e-04; a dash if there is none."""
    if value is None:
        return DASH
    return f"{value:.1e}" if isfinite(value) else str(value)


def percent(value: float | None) -> str:
    """Format a fraction in percent, without the sign."""
    return number(None if value is None else 100 * value)


def seconds_text(seconds: float | None) -> str:
    """Format a duration in µs, ms, s, min or h with three digits; a dash if there is none."""
    if seconds is None:
        return DASH
    if not isfinite(seconds):
        return str(seconds)
    for unit, size, least in UNITS_OF_TIME:
        if seconds >= least:
            return f"{number(seconds / size)} {unit}"
    return f"{number(1e6 * seconds)} µs" if seconds else "0 s"


def milliseconds_text(value: float | None) -> str:
    """Format milliseconds as `seconds_text`."""
    return seconds_text(None if value is None else value / 1000)


def bytes_text(n_bytes: float | None) -> str:
    """Format a size in B, kB, MB or GB; a dash if there is none."""
    if n_bytes is None:
        return DASH
    for unit in ("B", "kB", "MB"):
        if n_bytes < 999.5:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def span(
    interval: tuple[float, float] | None, shown: Callable[[float | None], str] = number
) -> str:
    """Format an interval such as ``0.51–0.56``; a dash if there is none."""
    return DASH if interval is None else "–".join(map(shown, interval))


def short_name(key: str) -> str:
    """Short name of a swept parameter."""
    initials = "".join(word[0] for word in key.split("_") if word)
    return SHORT_NAMES.get(key, initials if "_" in key else key)


def short_swept(swept: Mapping[str, Any]) -> str:
    """Format swept values such as ``r=20, ctol=0.001``."""
    return ", ".join(f"{short_name(key)}={value}" for key, value in swept.items())


def explain_short_names(all_swept: Iterable[Mapping[str, Any]]) -> str:
    """Explain the short names in one line; empty if there are none."""
    keys = dict.fromkeys(key for swept in all_swept for key in swept)
    return ", ".join(
        f"{short_name(key)} = {key}" + (f" ({MEANINGS[key]})" if key in MEANINGS else "")
        for key in keys
        if short_name(key) != key
    )
