"""A few kills of each command; `python -m tests.verification.kills` makes many."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import pytest

from tests.verification.kills import COMMANDS, SIGNALS, Undisturbed, kill_often, undisturbed


@pytest.fixture(scope="module", params=COMMANDS)
def expected(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Undisturbed:
    return undisturbed(request.param, tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("name", "kills"),
    [
        pytest.param("SIGKILL", 1, marks=pytest.mark.slow),
        *(pytest.param(name, 5, marks=pytest.mark.nightly) for name in SIGNALS),
    ],
)
def test_a_killed_command_leaves_nothing_and_ends_with_the_same_result(
    expected: Undisturbed, name: str, kills: int, tmp_path: Path
) -> None:
    found = kill_often(expected, signal.Signals[name], kills, tmp_path, int(time.time()))
    assert found.kills == kills
    assert not found.wrong
