"""Methods keep one style everywhere, which colour-blind readers and faint screens can tell."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.report.method_styles import (
    DARK,
    LINES,
    OTHER,
    WHITE,
    MethodStyle,
    channels,
    contrast,
    families,
    readable,
    style_of,
)
from mor_bench.specs import list_suite

METHODS = list_suite("methods")

FOREIGN = ("my-method", "a", "b", "Ω", "pod2")

PINNED = MethodStyle("#C17829", "#D2822D", "octagon", "8", "dot", ":", OTHER)
"""The style of `my-method`: published pictures keep it."""

LEAST_LIGHT, LEAST_DARK = 8.0, 13.5
"""Least distance in CIE L*a*b* of two shades of a family; those on white are published."""

LEAST_LIGHTNESS = 12.0
"""Least difference of L* of two shades of a family on a dark background."""

# Machado, Oliveira, Fernandes 2009: full colour blindness, in linear RGB.
BLIND = {
    "none": np.eye(3),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def seen(colour: str, blindness: str) -> NDArray[np.float64]:
    """CIE L*a*b* of a colour as a colour-blind reader sees it."""
    c = np.array(channels(colour))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    t = XYZ @ np.clip(BLIND[blindness] @ linear, 0, 1) / np.array([0.9505, 1.0, 1.089])
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_every_method_of_the_suite_has_a_family() -> None:
    assert sorted(name for members in families().values() for name in members) == sorted(METHODS)


def test_no_two_methods_look_the_same() -> None:
    styles = [style_of(method) for method in METHODS]
    for look in ("colour", "dark_colour"):
        for mark in ("marker", "symbol"):
            assert len({(getattr(s, look), getattr(s, mark)) for s in styles}) == len(styles)
    assert len({(s.family, s.colour, s.dash) for s in styles}) == len(styles)
    assert len({(s.dash, s.line) for s in styles}) == len({s.dash for s in styles}) == len(LINES)
    pairs = {(s.marker, s.symbol) for s in styles}
    assert len(pairs) == len({s.marker for s in styles}) == len({s.symbol for s in styles})


@pytest.mark.parametrize("method", [*METHODS, *FOREIGN])
def test_marks_stand_out_from_both_backgrounds(method: str) -> None:
    style = style_of(method)
    assert contrast(style.colour, WHITE) >= 3
    assert contrast(style.dark_colour, DARK) >= 4.5
    assert contrast(readable(style.colour), WHITE) >= 4.5


def test_contrast_is_that_of_the_guidelines() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777") == pytest.approx(4.48, abs=0.005)
    assert readable("#005B94") == "#005B94"


@pytest.mark.parametrize("blindness", BLIND)
def test_families_differ_for_colour_blind_readers(blindness: str) -> None:
    own = {family: style_of(members[0]) for family, members in families().items()}
    for a, b in combinations(own.values(), 2):
        distance = np.linalg.norm(seen(a.colour, blindness) - seen(b.colour, blindness))
        assert distance > 14, (a.family, b.family)


@pytest.mark.parametrize("look", ["colour", "dark_colour"])
def test_no_shade_of_a_family_looks_like_one_of_another(look: str) -> None:
    shades = {(f, getattr(style_of(m), look)) for f, members in families().items() for m in members}
    for (family, a), (other, b) in combinations(shades, 2):
        assert family == other or np.linalg.norm(seen(a, "none") - seen(b, "none")) > 10, (a, b)


@pytest.mark.parametrize("family", families())
def test_shades_of_a_family_differ_on_both_backgrounds(family: str) -> None:
    styles = [style_of(method) for method in families()[family]]
    for look, least in (("colour", LEAST_LIGHT), ("dark_colour", LEAST_DARK)):
        for a, b in combinations(dict.fromkeys(getattr(style, look) for style in styles), 2):
            assert np.linalg.norm(seen(a, "none") - seen(b, "none")) > least, (a, b)
    for a, b in combinations(dict.fromkeys(style.dark_colour for style in styles), 2):
        lightness = [seen(colour, "none")[0] for colour in (a, b)]
        assert abs(lightness[0] - lightness[1]) > LEAST_LIGHTNESS, (a, b)
    for a, b in combinations(styles, 2):
        assert a.symbol != b.symbol


def test_the_style_of_a_foreign_method_is_stable_and_its_own() -> None:
    assert style_of("my-method") == PINNED
    assert len({style_of(method) for method in FOREIGN}) == len(FOREIGN)
    suite = {style_of(method).marker for method in METHODS}
    for method in FOREIGN:
        assert style_of(method).family == OTHER
        assert style_of(method).marker not in suite
