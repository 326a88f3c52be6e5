"""The table of errors of stresses."""

from __future__ import annotations

from tests.published.run_tables import markdown, rows_of
from tests.published.stored import run_of

KINDS = ("stress", "peak_stress", "peak_tension")


def stresses(source: str, dataset: str = "") -> str:
    """Show the errors of displacements and of stresses, in %, of every configuration that ran."""
    body = []
    for row in rows_of(run_of(source), dataset, ""):
        error = row.error
        if row.reference or error is None:
            continue
        cells = [f"`{row.method}`", row.label.partition("[")[2].rstrip("]") or "–"]
        cells.append(f"{100 * error.rel_l2_median:.3g} / {100 * error.rel_l2_max:.3g}")
        for kind in KINDS:
            ends = (getattr(error, f"{kind}_rel_{end}") for end in ("median", "max"))
            cells.append(" / ".join(f"{100 * end:.3g}" for end in ends))
        body.append(cells)
    headings = ["method", "configuration", "displacement", "stress field"]
    return markdown([*headings, "largest von Mises stress", "largest principal stress"], body)
