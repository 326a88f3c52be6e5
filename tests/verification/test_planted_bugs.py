"""The list of planted bugs still fits the source."""

from __future__ import annotations

import pytest

from .planted_bugs import BUGS, Bug, sources


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_planted_bug_finds_its_text_exactly_once(bug: Bug) -> None:
    right, wrong = sources(bug)
    assert right != wrong
    compile(wrong, bug.file, "exec")
