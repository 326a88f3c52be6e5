"""The page about attacks gives the numbers of the tests that exist."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from mor_bench.checked_files import read_json
from mor_bench.runs.configurations import CORE_METHODS
from tests.mutations import PAGE
from tests.verification.kills import COMMANDS, KILLS, SIGNALS
from tests.verification.load import MOST_GROWTH_BYTES, PREDICTIONS

ROOT = Path(__file__).parents[1]


def test_the_documented_kills_and_predictions_were_done() -> None:
    trust = ROOT / "reports" / "trust"
    commands = [f"`{name}`" for name in COMMANDS]
    assert f"{KILLS} times with each of {', '.join(SIGNALS[:-1])} and {SIGNALS[-1]} for " + (
        f"{', '.join(commands[:-1])} and {commands[-1]}"
    ) in " ".join(PAGE.read_text("utf-8").split())
    for name in ("generate", "fit", "run"):
        rows = read_json(trust / f"kills-{name}.json")["kills"]
        done = [(row["command"], row["signal"], row["kills"], row["wrong"]) for row in rows]
        assert done == [(name, number, KILLS, 0) for number in SIGNALS]
    load = read_json(trust / "load.json")["methods"]
    assert [row["method"] for row in load] == list(CORE_METHODS)
    for row in load:
        assert row["n"] == PREDICTIONS
        assert row["drifted"] == 0
        assert row["growth_bytes"] <= MOST_GROWTH_BYTES
    test = (ROOT / "tests" / "test_interrupted_generation.py").read_text(encoding="utf-8")
    (kills_of_one,) = re.findall(r"while kills < (\d+) or", test)
    assert f"kill one generation of samples {kills_of_one} times" in PAGE.read_text("utf-8")


@pytest.mark.slow
def test_the_documented_cases_are_those_that_pytest_finds() -> None:
    rows = re.findall(r"\| `(tests/\w+\.py)` \| ([\d,]+) \|", PAGE.read_text(encoding="utf-8"))
    assert len(rows) == 11
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
