"""How much of a long measurement is done."""

from __future__ import annotations

import pytest

from mor_bench.measure.course import Course


def test_parts_take_as_long_as_those_of_their_kind_before() -> None:
    seconds, said = [0.0], list[tuple[int, int]]()
    parts = {"open": (2, 4.0), "turn a": (4, 1.0), "turn b": (4, 1.0)}
    course = Course(parts, lambda *what: said.append(what), lambda: seconds[0])
    for kind, took in [("open", 8.0), ("turn a", 0.5), ("turn b", 2.0)]:
        seconds[0] += took
        course.done(kind)
    # Typical times first, then measured ones: one start, and three turns of each kind are left.
    assert said[0] == (0, 16_000)
    assert said[1:] == [(8000, 8000 + 16_000), (8500, 8500 + 13_500), (10_500, 10_500 + 15_500)]
    course.skip("b")
    seconds[0] += 1.5
    course.done("turn a")
    assert said[-1] == (12_000, 12_000 + 8000 + 2 * 1000)


def test_the_share_done_is_right_once_every_kind_was_seen() -> None:
    seconds, said = [0.0], list[tuple[int, int]]()
    true = {"open": 6.0, "slow": 3.0, "fast": 0.1}
    course = Course(
        {"open": (4, 1.0), "slow": (12, 0.05), "fast": (12, 0.05)},
        lambda *what: said.append(what),
        lambda: seconds[0],
    )
    for _ in range(4):
        for kind in ("open", *3 * ("slow", "fast")):
            seconds[0] += true[kind]
            course.done(kind)
    totals = [total for _, total in said[3:]]
    assert totals == pytest.approx([1e3 * (4 * 6.0 + 12 * 3.1)] * len(totals), rel=1e-3)
    assert said[-1][0] == said[-1][1]
