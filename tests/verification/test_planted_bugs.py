"""The list of planted bugs still fits the source."""

from __future__ import annotations

import pytest

from .planted_bugs import BUGS, Bug


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_planted_bug_finds_its_text_exactly_once_and_compiles(bug: Bug) -> None:
    right, wrong = bug.sources()
    assert right != wrong
    compile(wrong, bug.file, "exec")
    assert bug.selection
