"""What a reader sees of a comparison: console tables, figures and an HTML page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mor_bench.report.console_tables import print_tables
    from mor_bench.report.page import render

__all__ = ["print_tables", "render"]

_HOMES = {
    "print_tables": "mor_bench.report.console_tables",
    "render": "mor_bench.report.page",
}


def __getattr__(name: str) -> Any:
    """Import a function when it is first used: tables do not wait for matplotlib."""
    if name not in _HOMES:
        raise AttributeError(f"module 'mor_bench.report' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
