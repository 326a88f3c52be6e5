"""The tables of the U-Mesh paper with our own figures beside the published ones.

Source of the published figures: Mendizabal, Márquez-Neila, Cotin: Simulation of hyperelastic
materials in real-time using deep learning, Medical Image Analysis 2020. The figures come from its
tables of error measures (one per scene) and its two comparisons with POD. The slopes and maxima
come from the captions. The paper's networks ran on a GeForce 1080 Ti, on a random split.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from mor_bench.report.entries import Entry
from mor_bench.report.number_format import DASH, metres, number
from mor_bench.report.text_table import TextTable


@dataclass(frozen=True)
class Published:
    """A row of the paper's tables of error measures: c channels, k steps; lengths in m."""

    dataset: str
    channels: int
    steps: int
    mean_m: float
    std_m: float
    predict_ms: float
    train_min: float
    max_m: float | None = None
    slope: float | None = None


PUBLISHED = (
    Published("beam-coarse", 64, 2, 0.0028, 0.0008, 2.0, 24),
    Published("beam-coarse", 16, 4, 0.0012, 0.0009, 3.2, 40),
    Published("beam-coarse", 32, 4, 0.0009, 0.0008, 3.2, 40),
    Published("beam-coarse", 64, 3, 0.0007, 0.0007, 2.5, 80),
    Published("beam-coarse", 64, 4, 0.0007, 0.0007, 3.3, 95),
    Published("beam-coarse", 128, 3, 0.0007, 0.0006, 2.5, 35, slope=0.00352),
    Published("beam-coarse", 64, 5, 0.0006, 0.0005, 4.0, 426),
    Published("beam-coarse", 128, 4, 0.0006, 0.0005, 3.45, 320),
    Published("beam-coarse-3-forces", 64, 4, 0.0007, 0.0003, 3.5, 100),
    Published("beam-fine", 128, 3, 0.0019, 0.0018, 3.0, 210, max_m=0.0265, slope=0.0083),
    Published("l-shape", 128, 3, 0.00648, 0.00493, 3.2, 97, max_m=0.0327, slope=0.002046),
    Published("liver-hex", 128, 3, 2.89e-5, 3.41e-5, 3.0, 149, max_m=4.07e-4, slope=0.0021),
    Published("liver-tet", 128, 3, 5.33e-5, 6.03e-5, 3.0, 149, max_m=4.9e-4),
)

SAME_ERROR = {"fem": (740.0, 0.0), "pod": (120.0, 0.006), "umesh": (3.0, 0.006)}
"""Published figures of `COMPARED`, by method: prediction time in ms, e in m; POD has 3 modes."""

SAME_TIME = {"fem": (740.0, 0.0), "hpod": (5.0, 0.084), "umesh": (3.0, 0.006)}
"""Published figures of `COMPARED`, by method: time in ms, e in m; the POD has one mode."""

COMPARED = "beam-fine"
"""Dataset of the paper's two comparisons."""

Size = tuple[int, int]
"""Channels and steps of a network."""


def _size(entry: Entry) -> Size | None:
    """Size of a configuration if it is a network of the paper's kind and ran, else None."""
    channels, steps = (entry.row.parameters.get(name) for name in ("channels", "steps"))
    if entry.ran and isinstance(channels, int) and isinstance(steps, int):
        return channels, steps
    return None


def error_measures(dataset: str, entries: Sequence[Entry]) -> TextTable | None:
    """Build the paper's table of error measures; None if no such network ran.

    Each network that ran has a row beside the paper's network of the same size. The paper's other
    networks follow, one per row.
    """
    ours = [(entry, size) for entry in entries if (size := _size(entry)) is not None]
    if not ours:
        return None
    published = {(row.channels, row.steps): row for row in PUBLISHED if row.dataset == dataset}
    rows = [
        _measures(entry.label, size, _measured(entry), published.get(size)) for entry, size in ours
    ]
    tried = {size for _, size in ours}
    rows += [
        _measures("not run here", size, [DASH] * 6, row)
        for size, row in published.items()
        if size not in tried
    ]
    measured = ("ē (m)", "σ(e) (m)", "max e (m)", "slope", "predict (ms)", "train (min)")
    headings = ["configuration", "c", "k", "FSS"]
    headings += [name for heading in measured for name in (heading, "paper")]
    note = "c channels, k steps, feature space size FSS = c·2ᵏ."
    if published:
        note += (
            " The paper's networks were trained for 100,000 iterations, "
            "timed on a GeForce 1080 Ti and tested on a random split."
        )
    else:
        headings, *rows = ([*row[:4], *row[4::2]] for row in (headings, *rows))
    return TextTable("Error measures of the networks", note, headings, rows)


def _measured(entry: Entry) -> list[str]:
    fit_s = entry.figure("offline_s", "fit")
    errors = ("mean_dof_m", "std_dof_m", "max_dof_m", "slope")
    return [
        *(metres(entry.figure("error", name)) for name in errors),
        number(entry.figure("latency_ms", "median")),
        number(None if fit_s is None else fit_s / 60),
    ]


def _measures(label: str, size: Size, ours: Sequence[str], paper: Published | None) -> list[str]:
    """Build a row of the table of error measures: our figures and the paper's alternate."""
    printed = [DASH] * len(ours)
    if paper:
        lengths = (paper.mean_m, paper.std_m, paper.max_m, paper.slope)
        printed = [_as_printed(x) for x in (*lengths, paper.predict_ms, paper.train_min)]
    channels, steps = size
    cells = [label, str(channels), str(steps), str(channels * 2**steps)]
    return cells + [cell for both in zip(ours, printed, strict=True) for cell in both]


def _as_printed(value: float | None) -> str:
    return DASH if value is None else f"{value:g}"


def same_error_or_time(dataset: str, entries: Sequence[Entry]) -> list[TextTable]:
    """Build the paper's two comparisons with its best network: at the same error and time.

    The first shows each method's fastest configuration that is as accurate as the network. The
    second shows its most accurate configuration that is as fast. Empty if no network ran.
    """
    network = _best_network(entries)
    if network is None:
        return []
    accurate = [e for e in entries if e.ran and e.mean_error_m <= network.mean_error_m]
    fast = [e for e in entries if e.ran and e.latency_ms <= network.latency_ms]
    error, time = metres(network.mean_error_m), number(network.latency_ms)
    methods = list(dict.fromkeys(e.method for e in entries))
    return [
        _comparison(
            "Comparison at the same error",
            f"The fastest configuration of each method with ē ≤ {error} m, the error of "
            f"{network.label}.",
            _least(methods, accurate, lambda e: e.latency_ms),
            SAME_ERROR if dataset == COMPARED else {},
        ),
        _comparison(
            "Comparison at the same time",
            f"The most accurate configuration of each method within {time} ms, "
            f"the latency of {network.label}.",
            _least(methods, fast, lambda e: e.mean_error_m),
            SAME_TIME if dataset == COMPARED else {},
        ),
    ]


def _best_network(entries: Sequence[Entry]) -> Entry | None:
    """Return the most accurate network with a latency, under any method name."""
    networks = [entry for entry in entries if _size(entry) is not None]
    best = min(networks, key=lambda e: e.mean_error_m, default=None)
    if best is None or not (isfinite(best.mean_error_m) and isfinite(best.latency_ms)):
        return None
    return best


def _least(
    methods: Sequence[str], entries: Sequence[Entry], cost: Callable[[Entry], float]
) -> dict[str, Entry | None]:
    """Return the entry of least cost for each method; None if it has none."""
    return {m: min((e for e in entries if e.method == m), key=cost, default=None) for m in methods}


def _comparison(
    title: str,
    note: str,
    chosen: Mapping[str, Entry | None],
    published: Mapping[str, tuple[float, float]],
) -> TextTable:
    rows = []
    for method, entry in chosen.items():
        cells = [method, "not reached", DASH, DASH]
        if entry:
            cells = [method, entry.label, number(entry.latency_ms), metres(entry.mean_error_m)]
        if published:
            cells += map(_as_printed, published.get(method, (None, None)))
        rows.append(cells)
    headings = ["method", "configuration", "time (ms)", "ē (m)"]
    headings += ["paper: time (ms)", "paper: e (m)"] if published else []
    return TextTable(title, note, headings, rows)
