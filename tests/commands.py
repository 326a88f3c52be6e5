"""Calls of the command line in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def mor_bench_command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run `mor-bench` with these arguments in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "mor_bench", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
