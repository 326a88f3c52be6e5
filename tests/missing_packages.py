"""Pretend that a package is not installed."""

from __future__ import annotations

import builtins
from typing import Any

import pytest


def hide_package(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let import statements of a package fail as if it were not installed, until the test ends.

    Its modules stay loaded, because a second copy of a compiled module may crash.
    """
    real = builtins.__import__

    def without(name: str, *others: Any, **options: Any) -> Any:
        if name.partition(".")[0] == package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=package)
        return real(name, *others, **options)

    monkeypatch.setattr(builtins, "__import__", without)
