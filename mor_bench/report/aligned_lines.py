"""Tables of texts in aligned lines, in which no name is broken."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.cells import cell_len
from rich.text import Text

GAP = "  "


@dataclass(frozen=True)
class Line:
    """A line of a table: its cells, or one cell alone as a heading inside the table."""

    cells: Sequence[str]
    style: str = ""


def aligned_lines(
    headings: Sequence[str], lines: Sequence[Line], width: int | None = None
) -> Iterator[Text]:
    """Yield the lines of a table: the first column to the left, all others to the right.

    Parameters
    ----------
    headings : sequence of str
        Each may have several lines.
    lines : sequence of Line
    width : int, optional
        Characters that a line may take. A first cell without room in its column stands on a line
        of its own. By default the first column is as wide as it needs to be.
    """
    titles = [heading.split("\n") for heading in headings]
    height = max(map(len, titles))
    top = [[*[""] * (height - len(title)), *title] for title in titles]
    full = [line for line in lines if len(line.cells) > 1]
    columns = zip(*(line.cells for line in full), strict=True)
    cells = list(columns) or [()] * len(headings)
    widths = [
        max(map(cell_len, (*title, *column))) for title, column in zip(titles, cells, strict=True)
    ]
    if width is not None:
        room = width - sum(cell_len(GAP) + wide for wide in widths[1:])
        least = max(map(cell_len, titles[0]))
        fitting = [cell_len(name) for name in cells[0] if cell_len(name) <= room]
        widths[0] = max([least, *fitting])
    for row in zip(*top, strict=True):
        yield Text(_joined(row, widths), style="bold", no_wrap=True)
    for line in lines:
        first = line.cells[0]
        if len(line.cells) == 1:
            yield Text(first, style=line.style, no_wrap=True)
        elif cell_len(first) > widths[0]:
            yield Text(first, style=line.style, no_wrap=True)
            yield Text(_joined(["", *line.cells[1:]], widths), style=line.style, no_wrap=True)
        else:
            yield Text(_joined(line.cells, widths), style=line.style, no_wrap=True)


def _joined(cells: Sequence[str], widths: Sequence[int]) -> str:
    spaces = [" " * max(wide - cell_len(cell), 0) for cell, wide in zip(cells, widths, strict=True)]
    others = [space + cell for cell, space in zip(cells[1:], spaces[1:], strict=True)]
    return GAP.join([cells[0] + spaces[0], *others]).rstrip()
