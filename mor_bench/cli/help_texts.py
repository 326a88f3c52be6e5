"""Help texts of commands: options in panels, then examples and exit codes."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import typer
from typer.core import TyperCommand

EXIT_CODES = {
    0: "The command did what it says.",
    2: "An option, a name or a file is not valid. Standard error says why, in one line. At a "
    "terminal, the names that exist follow one that does not.",
    130: "Ctrl-C stopped the command. Signal n gives 128 + n.",
}
"""Meanings of the exit codes of every command."""

WIDTH = 78
"""Width of the examples and exit codes, in characters."""


class Command(TyperCommand):
    """A command whose help shows the options by panel, in plain text."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            default = "Arguments" if parameter.param_type_name == "argument" else "Options"
            panel = getattr(parameter, "rich_help_panel", None) or default
            if record := parameter.get_help_record(ctx):
                panels.setdefault(panel, []).append(record)
        for name, records in panels.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        formatter.write(self.epilog or "")


def command(
    app: typer.Typer,
    examples: Mapping[str, str],
    exit_codes: Mapping[int, str] | None = None,
    name: str | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a decorator that adds a command to an app.

    Parameters
    ----------
    app : typer.Typer
    examples : mapping
        Command lines without ``mor-bench``, and their purpose.
    exit_codes : mapping, optional
        Meanings beside or instead of those in `EXIT_CODES`.
    name : str, optional
        Default: the function's name.
    """
    codes = dict(sorted({**EXIT_CODES, **(exit_codes or {})}.items()))
    return app.command(name, cls=Command, epilog=_epilog(examples, codes))


def _epilog(examples: Mapping[str, str], exit_codes: Mapping[int, str]) -> str:
    lines = ["", "Examples:"]
    for line, purpose in examples.items():
        lines += [f"  mor-bench {line}", *_indented(purpose, "      ")]
    lines += ["", "Exit codes:"]
    for code, meaning in exit_codes.items():
        lines += _indented(meaning, f"  {code:<5}")
    return "\n".join(lines) + "\n"


def _indented(text: str, first: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first))
