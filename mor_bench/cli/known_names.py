"""The names that exist, in lines for a reader who gave one that does not."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence

from mor_bench.errors import UnknownNameError
from mor_bench.report.line_wrapping import wrapped
from mor_bench.report.method_styles import OTHER, families

MOST_SIMILAR = 3
"""Most names that count as similar to the given one."""


def known_lines(error: UnknownNameError, width: int) -> Iterator[str]:
    """Yield the most similar names, then all others, methods by family, in lines of this width."""
    for title, names in _groups(error):
        yield from wrapped(
            ", ".join(names), width, "    ", first=f"  {title}: ", names=(title, *names)
        )


def _groups(error: UnknownNameError) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield titles and names; a name may be both among the similar ones and in its family."""
    if similar := difflib.get_close_matches(error.name, error.known, n=MOST_SIMILAR):
        yield "most similar", similar
    if error.kind != "methods":
        yield error.kind, error.known
        return
    grouped = families()
    member = {name for names in grouped.values() for name in names}
    grouped = {**grouped, OTHER: tuple(name for name in error.known if name not in member)}
    for family, names in grouped.items():
        if there := [name for name in names if name in error.known]:
            yield family, there
