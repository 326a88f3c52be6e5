"""Tables in Markdown about the cost of the full-order model."""

from __future__ import annotations

import numpy as np

from mor_bench.report.number_format import DASH, number
from tests.published.run_tables import markdown
from tests.published.stored import content_of


def law_speed(source: str) -> str:
    """Show what a residual and a tangent of each law cost on each element."""
    rows = {(row["law"], row["element"]): row for row in content_of(source)["rows"]}
    elements = list(dict.fromkeys(element for _, element in rows))
    pairs = [(element, kind) for element in elements for kind in ("residual", "tangent")]
    body = [
        [
            law,
            *(
                f"{number(rows[law, element][f'{kind}_ratio'])} "
                f"({number(rows[law, element][f'{kind}_ms'])} ms)"
                for element, kind in pairs
            ),
        ]
        for law in dict.fromkeys(law for law, _ in rows)
    ]
    return markdown(["", *(f"{element}: {kind}" for element, kind in pairs)], body)


def probe_cost(source: str) -> str:
    """Show the share of the search for negative curvature in the counted work of a solve."""
    units = {"residuals": "element_evaluations", "back-solves": "back_solves"}
    units["multiply-adds"] = "multiply_adds"
    return markdown(
        ["end moves, m", "iterations without it", "with it", *units],
        [
            [
                f"{row['amplitude_m']:g}",
                f"{row['iterations_without']}",
                f"{row['iterations']}",
                *(f"{100 * row['shares'][unit]:.1f} %" for unit in units.values()),
            ]
            for row in content_of(source)["loads"]
        ],
    )


def poisson_ratios(source: str) -> str:
    """Show the work of multigrid by Poisson's ratio and size, relative to the least ratio."""
    rows = content_of(source)["rows"]
    sizes = list(dict.fromkeys(row["unknowns"] for row in rows))
    of = {(row["unknowns"], row["poisson"]): row for row in rows}
    ratios = list(dict.fromkeys(row["poisson"] for row in rows))
    headings = ("cycles", "iterations: median, most", "multiply-adds")
    return markdown(
        ["ν", *(f"{size:,} unknowns: {heading}" for size in sizes for heading in headings)],
        [
            [
                f"{ratio:g}",
                *(
                    cell
                    for size in sizes
                    for row in [of[size, ratio]]
                    for cell in (
                        f"{row['cycles']}",
                        f"{row['iterations']:.0f}, {row['most_iterations']}",
                        number(row["multiply_adds"] / of[size, ratios[0]]["multiply_adds"]),
                    )
                ),
            ]
            for ratio in ratios
        ],
    )


def scaling(source: str) -> str:
    """Show the cost of a solve against the number of unknowns."""
    headings = ["unknowns", "rest state", "set-up, s", "solve, ms", "on two threads, ms"]
    return markdown(
        [*headings, "iterations", "peak MB"],
        [
            [
                f"{row['unknowns']:,}",
                "banded" if "Banded" in row["rest_state"] else "multigrid",
                f"{row['set_up_s']:.1f}",
                number(1e3 * row["solve_s"]),
                number(1e3 * row["two_threads_s"]),
                f"{row['iterations']:.0f}",
                number(row["peak_mb"]),
            ]
            for row in content_of(source)["sizes"]
        ],
    )


def generation(source: str) -> str:
    """Show the cost of generating samples against their number."""
    headings = ["samples", "seconds", "samples/s", "ms per sample", "disk, MB", "memory: parent"]
    return markdown(
        [*headings, "memory: worker"],
        [
            [
                f"{row['samples']:,}",
                f"{row['seconds']:.1f}",
                number(row["rate"]),
                number(1e3 / row["rate"]),
                number(row["disk_mb"]),
                f"{number(row['parent_mb'])} MB",
                f"{number(row['worker_mb'])} MB" if row["worker_mb"] else DASH,
            ]
            for row in content_of(source)["sizes"]
        ],
    )


def large_deformation(source: str) -> str:
    """Show the time of a solve and the ratio of another code's, by the displacement of the end."""
    body = []
    for found in content_of(source)["datasets"].values():
        own, peer = (np.median(np.array(row["times_ms"]), axis=1) for row in found["contenders"])
        columns = found["amplitudes_m"], found["contenders"][0]["steps"], own, peer
        body += [
            [
                f"{found['n_unknowns']:,}",
                f"{amplitude:g}",
                f"{n}",
                number(float(ms)),
                number(float(other / ms)),
            ]
            for amplitude, n, ms, other in zip(*columns, strict=True)
        ]
    headings = ["unknowns", "end moves, m", "back-solves", "`auto`, ms", "felupe, Pardiso: ratio"]
    return markdown(headings, body)
