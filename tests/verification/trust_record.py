"""Commit, machine and date of a measurement that is kept in a file."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mor_bench.machine import describe_machine

CODE = ("mor_bench", "methods", "datasets", "tests")
"""Folders whose uncommitted changes count."""


def trust_record() -> dict[str, Any]:
    """Return the commit of the code (with "-dirty" if it was changed), machine and date."""
    changed = "-dirty" if git("status", "--porcelain", "--", *CODE) else ""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {
        "commit": git("rev-parse", "HEAD") + changed,
        "machine": describe_machine(),
        "date": date,
    }


def git(*words: str) -> str:
    """Return what git prints in the root of the repository."""
    command = ["git", "-C", str(Path(__file__).parents[2]), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
