"""Colour, marker and dash of each method, the same in every picture and on every page.

A family has a hue; its members differ by shade, marker and dash. The hues follow Okabe and Ito's
palette for colour-blind readers, with a violet, darkened where a line on white would be too faint.
The order of a family's members is permanent: append new methods at its end, so that published
styles stay as they are.
"""

from __future__ import annotations

import colorsys
import hashlib
from dataclasses import dataclass
from typing import Literal

OTHER = "other"
"""Family of the methods that are not part of the suite."""

WHITE, DARK = "#ffffff", "#161616"
"""Backgrounds that the colours are made for."""


@dataclass(frozen=True)
class MethodStyle:
    """Style of a method.

    Attributes
    ----------
    colour, dark_colour : str
        For marks on a light and on a dark background, such as ``#0072B2``.
    symbol : str
        Name of the marker in plotly.
    marker : str
        The same marker in matplotlib.
    dash : str
        Name of the line's dash in plotly.
    line : str
        The same dash in matplotlib.
    family : str
        Family that gives the hue, such as ``projection``.
    """

    colour: str
    dark_colour: str
    symbol: str
    marker: str
    dash: str
    line: Line
    family: str


Line = Literal["-", "--", ":", "-."]
"""Dash of a line in matplotlib."""

LINES: tuple[tuple[Line, str], ...] = (
    ("-", "solid"),
    ("--", "dash"),
    (":", "dot"),
    ("-.", "dashdot"),
)
"""Dashes of lines in matplotlib and plotly, in the order in which they are given."""

_Shades = tuple[tuple[str, str], ...]
"""Colours for light and dark backgrounds; the first is the family's own."""

_MARKERS = (
    ("o", "circle"),
    ("s", "square"),
    ("^", "triangle-up"),
    ("D", "diamond"),
    ("v", "triangle-down"),
    ("P", "cross"),
    ("X", "x"),
    ("p", "pentagon"),
    ("<", "triangle-left"),
    (">", "triangle-right"),
)
"""Markers of the suite's methods in matplotlib and plotly."""

_OTHER_SHADE = {"pca-regression": 1}
"""Shades of methods that a default run compares with another one of the same shade."""

_OTHER_MARKERS = (("*", "star"), ("h", "hexagon2"), ("8", "octagon"), ("d", "diamond-tall"))
"""Markers of all other methods."""

_FAMILIES: dict[str, tuple[_Shades, tuple[str, ...]]] = {
    "finite elements": (
        (("#222222", "#f2f2f2"), ("#636363", "#c9c9c9"), ("#858585", "#a3a3a3")),
        (
            "fem",
            "linear-fem",
            "fem-coarse",
            "fem-warm",
            "hybrid",
            "fem-pardiso",
            "fem-jacobi-pcg",
            "explicit-dynamics",
        ),
    ),
    "projection": (
        (("#005B94", "#56B4E9"), ("#0080C7", "#BFE3F8"), ("#00385C", "#2B86C4")),
        (
            "pod",
            "local-pod",
            "pod-tensor",
            "modal-derivatives",
            "quadratic-manifold",
            "quadratic-manifold-pod",
            "pod-ann",
            "latent-galerkin",
            "latent-lspg",
        ),
    ),
    "hyper-reduction": (
        (("#D55E00", "#FF9248"), ("#973F00", "#FFD3B5"), ("#EA5B2B", "#DC5A00")),
        ("hpod", "ecm", "deim"),
    ),
    "regression on modes": (
        (("#009E73", "#2FCB9F"), ("#006548", "#B5F2DF"), ("#2E8C6C", "#0E9169")),
        (
            "pca-regression-linear",
            "pca-ridge",
            "pca-gaussian-process",
            "pca-kernel-ridge",
            "pca-random-forest",
            "pca-extra-trees",
            "pca-regression",
            "pca-polynomial-force",
            "gappy-pod",
        ),
    ),
    "polynomials and separated functions": (
        (("#8C6D31", "#E5B252"), ("#5E4716", "#F8E6C4"), ("#A5802F", "#A67C24")),
        (
            "sparse-polynomial",
            "pgd-snapshots",
            "sparse-polynomial-derivative",
            "sparse-polynomial-force",
            "pgd-snapshots-force",
            "pgd-weak-form",
        ),
    ),
    "neural networks": (
        (("#C4609A", "#E39AC4"), ("#86305F", "#F9DDEE"), ("#A8417E", "#C85A98")),
        (
            "umesh-small",
            "umesh-linear",
            "pod-nn",
            "umesh",
            "autoencoder",
            "pod-nn-derivative",
            "pod-nn-force",
            "pod-nn-ensemble",
        ),
    ),
    "neural operators and graphs": (
        (("#6C45C9", "#AE97F2"), ("#432295", "#DDD4FB"), ("#8E6FDB", "#8F70E8")),
        ("deeponet", "fno", "mesh-graph-net", "pod-deeponet", "graph-u-net", "transolver"),
    ),
}
"""Shades and members of each family."""


def families() -> dict[str, tuple[str, ...]]:
    """Return the suite's methods by family, in reading order."""
    return {family: members for family, (_, members) in _FAMILIES.items()}


def style_of(method: str) -> MethodStyle:
    """Return the style of a method; a method outside the suite gets one from its name's digest."""
    return _SUITE.get(method) or _other_style(method)


def contrast(colour: str, background: str = WHITE) -> float:
    """Return the contrast ratio of two colours as WCAG defines it, from 1 to 21."""
    low, high = sorted((_luminance(colour), _luminance(background)))
    return (high + 0.05) / (low + 0.05)


def readable(colour: str, background: str = WHITE, least: float = 4.5) -> str:
    """Darken a colour, or lighten it on a dark background, until small text has enough contrast."""
    towards = 0.0 if _luminance(background) > 0.18 else 1.0
    red, green, blue = channels(colour)
    for step in range(101):
        part = step / 100
        mixed = ((1 - part) * c + part * towards for c in (red, green, blue))
        if contrast(found := _hex(*mixed), background) >= least:
            break
    return found


def channels(colour: str) -> tuple[float, float, float]:
    """Return red, green and blue of a colour such as ``#0072B2``, from 0 to 1."""
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def _luminance(colour: str) -> float:
    linear = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels(colour))
    return sum(w * c for w, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def _hex(red: float, green: float, blue: float) -> str:
    return "#" + "".join(f"{round(255 * c):02X}" for c in (red, green, blue))


def _other_style(method: str) -> MethodStyle:
    digest = hashlib.sha256(method.encode()).digest()
    hue = int.from_bytes(digest[:2], "big") / 65536
    marker, symbol = _OTHER_MARKERS[digest[2] % len(_OTHER_MARKERS)]
    line, dash = LINES[digest[3] % len(LINES)]
    red, green, blue = colorsys.hls_to_rgb(hue, 0.5, 0.65)
    colour = _hex(red, green, blue)
    light, dark = readable(colour, WHITE, 3.5), readable(colour, DARK, 5.0)
    return MethodStyle(light, dark, symbol, marker, dash, line, OTHER)


def _suite() -> dict[str, MethodStyle]:
    """Give every member of a family a shade, a dash, and a marker that differs in the family."""
    styles = {}
    for first, (family, (shades, members)) in enumerate(_FAMILIES.items()):
        for i, method in enumerate(members):
            marker, symbol = _MARKERS[(first + i) % len(_MARKERS)]
            line, dash = LINES[i % len(LINES)]
            colour, dark = shades[_OTHER_SHADE.get(method, i) % len(shades)]
            styles[method] = MethodStyle(colour, dark, symbol, marker, dash, line, family)
    return styles


_SUITE = _suite()
