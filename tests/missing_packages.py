"""Pretend that a package is not installed."""

from __future__ import annotations

import sys
from typing import Any

import pytest


class _Without:
    """A finder that finds no module of a package."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=self.package)


def hide_package(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every import of a package fail as if it were not installed, until the test ends."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("sys.meta_path", [_Without(package), *sys.meta_path])
