"""The page about attacks gives the numbers of the tests that exist."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations import PAGE, documented
from tests.verification.kills import COMMANDS, KILLS, SIGNALS
from tests.verification.load import PREDICTIONS

ROOT = Path(__file__).parents[1]


def test_the_documented_kills_and_predictions_are_those_of_the_scripts() -> None:
    counts = documented()
    names = [f"`{name}`" for name in COMMANDS]
    what = f"{', '.join(names[:-1])} and {names[-1]} by {', '.join(SIGNALS[:-1])} and {SIGNALS[-1]}"
    assert counts[f"kills of {what}"] == KILLS * len(COMMANDS) * len(SIGNALS)
    assert counts["predictions of each default method"] == PREDICTIONS
    test = (ROOT / "tests" / "test_interrupted_generation.py").read_text(encoding="utf-8")
    (kills,) = re.findall(r"while kills < (\d+):", test)
    assert counts["kills of one generation of samples, in the slow tests"] == int(kills)


@pytest.mark.slow
def test_the_documented_cases_are_those_that_pytest_finds() -> None:
    rows = re.findall(r"\| `(tests/\w+\.py)` \| ([\d,]+) \|", PAGE.read_text(encoding="utf-8"))
    assert len(rows) == 9
    collect = ["--collect-only", "-q", "-m", "slow or not slow", "-p", "no:cacheprovider"]
    found = subprocess.run(
        [sys.executable, "-m", "pytest", *collect, *(file for file, _ in rows)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    counted = {file: sum(line.startswith(f"{file}::") for line in found) for file, _ in rows}
    assert counted == {file: int(count.replace(",", "")) for file, count in rows}
