"""Calls of the command line, in this process or in one of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner, Result

from mor_bench.cli.app import app


def invoke(*arguments: str) -> Result:
    """Run `mor-bench` with these arguments in this process."""
    return CliRunner().invoke(app, arguments)


def mor_bench_command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run `mor-bench` with these arguments in a folder, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "mor_bench", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
