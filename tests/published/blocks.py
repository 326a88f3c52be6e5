"""Tables in Markdown that are generated from the evidence.

    <!-- from: reports/quick-start choice methods=fem,pod -->
    …
    <!-- end -->

The first word names the evidence, the second a function of `TABLES`, the others its options.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.published.number_tables import NUMBER_TABLES
from tests.published.other_tables import OTHER_TABLES
from tests.published.run_tables import RUN_TABLES
from tests.published.stored import BLOCK, ROOT, EvidenceError

TABLES: dict[str, Callable[..., str]] = {**RUN_TABLES, **OTHER_TABLES, **NUMBER_TABLES}

PAGES = ("README.md", "docs/*.md", "reports/README.md")
"""Pages whose numbers must have evidence."""


def pages(root: Path = ROOT) -> list[Path]:
    """List the pages whose numbers must have evidence."""
    return [path for pattern in PAGES for path in sorted(root.glob(pattern))]


def table_of(spec: str) -> str:
    """Generate the text of a block.

    Raises
    ------
    EvidenceError
        If there is no such table or no such evidence.
    """
    source, name, *options = spec.split()
    if name not in TABLES:
        raise EvidenceError(f"{spec}: there is no table {name!r}; tables are {sorted(TABLES)}.")
    return TABLES[name](source, **dict(option.split("=", 1) for option in options))


def with_blocks(text: str) -> str:
    """Return a page with all of its tables generated again."""
    if text.count("<!-- from:") != len(BLOCK.findall(text)):
        raise EvidenceError("A `<!-- from: … -->` has no `<!-- end -->`.")
    return BLOCK.sub(
        lambda match: f"<!-- from: {match['spec']} -->\n{table_of(match['spec'])}\n<!-- end -->",
        text,
    )
