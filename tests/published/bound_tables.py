"""Table of bounds of errors that follow a method's spread, beside constant ones."""

from __future__ import annotations

from mor_bench.report.number_format import number
from tests.published.run_tables import markdown
from tests.published.stored import content_of


def spread_bounds(source: str) -> str:
    """Show both bounds of each method on each scene, and the shares of loads within them."""
    rows = content_of(source)["rows"]
    kinds = list(dict.fromkeys(row["test"] for row in rows))
    headings = ["scene", "method"]
    for kind in kinds:
        headings += [f"{kind}: equal for all loads", f"{kind}: × spread"]
    cells: dict[tuple[str, str], list[str]] = {}
    for kind in kinds:
        for row in rows:
            if row["test"] == kind:
                cells.setdefault((row["dataset"], row["method"]), []).extend(
                    f"{number(100 * row[name])} ({number(100 * row[f'{name}_coverage'])})"
                    for name in ("constant", "spread")
                )
    body = [[f"`{scene}`", f"`{method}`", *found] for (scene, method), found in cells.items()]
    return markdown(headings, body)
