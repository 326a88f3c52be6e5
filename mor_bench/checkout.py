"""The commit of the checkout that the package lies in."""

from __future__ import annotations

import subprocess
from pathlib import Path


def source_commit() -> str | None:
    """Return the commit of the package's own checkout, with "-dirty" if its code was changed.

    None if the package is not in a git checkout of its own, or git is not installed.
    """
    root = Path(__file__).parents[1]
    top = _git(root, "rev-parse", "--show-toplevel")
    if not top or Path(top).resolve() != root.resolve():
        return None
    changed = _git(root, "status", "--porcelain", "--", "mor_bench", "datasets", "methods")
    commit = _git(root, "rev-parse", "--verify", "--quiet", "HEAD")
    return f"{commit}{'-dirty' if changed else ''}" if commit else None


def _git(folder: Path, *words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words],
            check=True,
            capture_output=True,
            text=True,
            encoding="utf-8",
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
