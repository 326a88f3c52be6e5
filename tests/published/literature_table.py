"""Tables of numbers from the literature beside ours, on the nearest set-up that was measured."""

from __future__ import annotations

from mor_bench.report.number_format import DASH, number
from tests.published.record import experiments
from tests.published.run_tables import markdown
from tests.published.stored import EvidenceError, content_of, number_of


def literature(source: str) -> str:
    """Show each number of a TOML file beside ours, and their ratio, in a table per family.

    The last column is the command that repeats ours.

    An entry has the `family`, `what` is measured, the `published` number with its `unit` and
    `source`, the `nearest` set-up of ours, and a number `ours` as in claims.toml. Its file belongs
    to the `experiment` of sources.toml. `published_largest_m` and `largest` give the largest
    displacements of both set-ups, m; with `relative`, our number is divided by it.

    Raises
    ------
    EvidenceError
        If an experiment is unknown, or does not write the file of our number.
    """
    families: dict[str, list[list[str]]] = {}
    for entry in content_of(source)["number"]:
        name, file = entry["experiment"], entry["ours"]["file"]
        if name not in experiments() or not file.startswith(f"reports/{name}"):
            raise EvidenceError(f"{source}: {file} is not of an experiment {name!r}.")
        ours, amplitudes = number_of(entry["ours"]), DASH
        if "largest" in entry:
            largest = number_of(entry["largest"])
            amplitudes = f"{number(entry['published_largest_m'])} / {number(largest)}"
            ours /= largest if entry.get("relative") else 1.0
        families.setdefault(entry["family"], []).append(
            [
                f"{entry['what']} ({entry['unit']})",
                f"{number(entry['published'])}: {entry['source']}",
                f"{number(ours)}: {entry['nearest']}",
                number(ours / entry["published"]),
                amplitudes,
                f"`python -m tests.published.record {name}`",
            ]
        )
    headings = ["quantity", "published", "ours", "ours / published"]
    headings += ["largest u, m: published / ours", "command"]
    tables = (
        f"**{name[0].upper()}{name[1:]}**\n\n{markdown(headings, body)}"
        for name, body in families.items()
    )
    return "\n\n".join(tables)
