"""Commit, machine and date of a measurement that is kept in a file."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mor_bench.machine import describe_machine


def trust_record() -> dict[str, Any]:
    """Return the commit of the source (with "-dirty" if it was changed), machine and date."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"commit": commit, "machine": describe_machine(), "date": date}
