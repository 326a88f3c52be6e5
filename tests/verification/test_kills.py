"""A few kills of each command; `python -m tests.verification.kills` makes many."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import pytest

from tests.verification.kills import (
    COMMANDS,
    SIGNALS,
    Undisturbed,
    heed_signals,
    kill_often,
    undisturbed,
)


@pytest.fixture(scope="module", params=COMMANDS)
def expected(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Undisturbed:
    return undisturbed(request.param, tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("name", SIGNALS)
def test_a_killed_command_leaves_nothing_and_ends_with_the_same_result(
    expected: Undisturbed, name: str, tmp_path: Path
) -> None:
    heed_signals()
    found = kill_often(expected, signal.Signals[name], 2, tmp_path, int(time.time()))
    assert found.kills == 2
    assert not found.wrong
