"""The sentences of a verdict as terminal and page show them: short names, the same words on both.

Stored verdicts keep their own words, so that a run's files do not depend on how they are shown.
"""

from __future__ import annotations

from collections.abc import Mapping

from mor_bench.analysis.selection_text import needs_text
from mor_bench.analysis.verdict import Requirements
from mor_bench.report.short_names import ShortName, renamed

ERROR = "relative L2 error"
"""The one name of this error on page, terminal and pictures."""

RUNNER_UP = "runner-up (another method)"
"""What the second is: the fastest, or by offline cost the cheapest, of those that qualify. A
configuration of the winner's own method is none."""

NO_RUNNER_UP = "No other method qualifies."
"""What is said where there is no runner-up."""

_WORDS = {
    "(relative l2, median)": f"({ERROR}, median)",
    "Runner-up: ": f"{RUNNER_UP.capitalize()}: ",
}
"""Words of `mor_bench.analysis.selection_text`, and those that are shown instead."""


def in_words(sentence: str, names: Mapping[str, ShortName | str] | None = None) -> str:
    """Return a sentence of a verdict with short names and the words of the page."""
    for stored, words in _WORDS.items():
        sentence = sentence.replace(stored, words)
    return renamed(sentence, names) if names else sentence


def needs_in_words(needs: Requirements) -> str:
    """State limits in the words of the page."""
    return in_words(needs_text(needs)).replace("<=", "≤")
