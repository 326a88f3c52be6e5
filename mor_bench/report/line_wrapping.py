"""Lines of at most a given width that end between words and never inside a name or a command."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from textwrap import wrap

from mor_bench.report.number_format import joined_units

KEPT = "\N{NO-BREAK SPACE}"
"""A space at which `textwrap` does not break."""


def wrapped(
    text: str, width: int, indent: str = "", *, first: str = "", names: Iterable[object] = ()
) -> list[str]:
    """Return a text in lines that end between words; a longer word is not broken.

    Parameters
    ----------
    text : str
    width : int
        Most characters of a line.
    indent, first : str
        What begins each later line, and the first one.
    names : iterable
        Names that may contain spaces and stay on one line, such as ``hpod · r5``. Numbers stay
        beside their units.
    """
    spaced = {str(name) for name in names if " " in str(name)}
    for name in sorted(spaced, key=len, reverse=True):
        text = text.replace(name, name.replace(" ", KEPT))
    lines = wrap(
        joined_units(text),
        width,
        initial_indent=first,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(KEPT, " ") for line in lines]


def command_lines(command: str, width: int, indent: str = "  ") -> list[str]:
    r"""Return a shell command in lines that can be copied: all but the last end with ``\``."""
    if len(indent) + len(command) <= width:
        return [indent + command]
    # Each line begins with an option, so that its value stays beside it.
    words = " ".join(shlex.quote(word).replace(" ", KEPT) for word in shlex.split(command))
    words = re.sub(r"(?<= )(--?[\w-]+) (?!-)", rf"\1{KEPT}", words)
    lines = wrap(
        words,
        width - 2,
        initial_indent=indent,
        subsequent_indent=f"{indent}    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(KEPT, " ") for line in (*(f"{line} \\" for line in lines[:-1]), lines[-1])]
