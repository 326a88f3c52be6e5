"""Tables in Markdown about the size and the training of U-Mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp

from mor_bench.report.number_format import number
from mor_bench.report.published_figures import PUBLISHED
from tests.benchmarks.umesh_scaling import HELD_OUT, PAPER, fit_law
from tests.published.run_tables import markdown
from tests.published.stored import content_of

PAPER_E_M = next(
    row.mean_m
    for row in PUBLISHED
    if (row.dataset, row.channels, row.steps) == ("beam-coarse", PAPER["channels"], PAPER["steps"])
)
"""Mean error on the coarse beam in the paper, for the network that is extrapolated to, m."""

FLAT = 0.05
"""Fall of e by the last doubling of the iterations below which a training counts as converged."""


def network_sizes(source: str) -> str:
    """Show e of test samples by size of the network and number of iterations."""
    rows = content_of(source)["rows"]
    numbers = sorted({row["iterations"] for row in rows})
    body = []
    for size in dict.fromkeys((row["channels"], row["steps"]) for row in rows):
        mine = {r["iterations"]: r for r in rows if (r["channels"], r["steps"]) == size}
        cells = [_metres(mine[n]["test"]["mean_dof_m"]) if n in mine else "–" for n in numbers]
        last, before = (mine[n] for n in sorted(mine)[:-3:-1])
        fall = 1 - last["test"]["mean_dof_m"] / before["test"]["mean_dof_m"]
        flat = "yes" if fall < FLAT else "no"
        relative = number(100 * last["test"]["rel_l2_median"])
        body.append(
            [
                f"{size[0]}, {size[1]}",
                *cells,
                relative,
                number(last["core_s"]),
                f"{100 * fall:.0f}",
                flat,
            ]
        )
    headings = ["channels, steps", *(f"{n:,} iterations" for n in numbers)]
    headings += ["median % of the last", "core-s of the last", "fall by the last doubling, %"]
    return markdown([*headings, f"flat (< {100 * FLAT:.0f} %)"], body)


def network_size_law(source: str) -> str:
    """Show the scaling law, how well it extrapolates, and what it says of the paper's size."""
    rows = content_of(source)["rows"]
    law = fit_law(rows)
    body = [
        [f"exponent of the {name}", f"{law.coefficients[i]:.2f}", _pair(law.interval(i), _ratio)]
        for i, name in ((1, "channels"), (2, "iterations"))
    ]
    low, high = law.interval(3)
    further = _pair((exp(low), exp(high)), _ratio)
    body.append(["factor of a further step", _ratio(exp(law.coefficients[3])), further])
    held_out = [row for row in rows if HELD_OUT.items() <= row.items()]
    without = fit_law([row for row in rows if row not in held_out])
    for row in held_out:
        e, *ends = without.predict(row)
        found = row["test"]["mean_dof_m"]
        inside = "inside" if ends[0] <= found <= ends[1] else "outside"
        name = f"e at {row['channels']} channels, {row['iterations']:,} iterations, m"
        name += f", from the other sizes; measured {_metres(found)}: {inside}"
        body.append([name, _metres(e), _pair(ends, _metres)])
    e, *ends = law.predict(PAPER)
    name = f"e at {PAPER['channels']} channels, {PAPER['steps']} steps, as many samples as in the "
    name += f"paper, m, extrapolated; in the paper {_metres(PAPER_E_M)}"
    body.append([name, _metres(e), _pair(ends, _metres)])
    return markdown(["", "value", "95 % interval"], body)


def _ratio(value: float) -> str:
    return f"{value:.2f}"


def _metres(value: float) -> str:
    return f"{value:.1e}".replace("e-0", "e-")


def _pair(ends: Sequence[float], text: Callable[[float], str]) -> str:
    return " to ".join(map(text, ends))
