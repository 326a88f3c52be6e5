"""The tables of the U-Mesh paper from our own rows, with the paper's figures beside them.

Source of all figures here: Mendizabal, Márquez-Neila, Cotin: Simulation of hyperelastic materials in real-time using deep
learning, Medical Image Analysis 2020; its tables of error measures (one per scene) and its two comparisons with POD. Its networks
ran on a GeForce 1080 Ti, its errors are over a random split and its slopes and maxima are from the captions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mor_bench.report.summary import Entry, metres, number


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

SAME_ERROR_MS = {"fem": (740.0, 0.0), "pod": (120.0, 0.006), "umesh": (3.0, 0.006)}
"""beam-fine, by method: prediction time in ms and e in m, of POD with 3 modes."""

SAME_TIME_MS = {"fem": (740.0, 0.0), "hpod": (5.0, 0.084), "umesh": (3.0, 0.006)}
"""beam-fine, by method: prediction time in ms and e in m, of hyper-reduced POD with one mode."""

COMPARED = "beam-fine"
"""The scene of the paper's two comparisons."""


@dataclass(frozen=True)
class Grid:
    """A table of texts.

    Attributes
    ----------
    title, note : str
        What it shows, and how to read it.
    headings : sequence of str
    rows : sequence of sequence of str
        The first cell of each names it.
    """

    title: str
    note: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def _size(entry: Entry) -> tuple[int, int] | None:
    """Channels and steps of a configuration that is such a network."""
    parameters = entry.row.get("parameters") or {}
    if not entry.ran or not all(
        isinstance(parameters.get(name), int) for name in ("channels", "steps")
    ):
        return None
    return parameters["channels"], parameters["steps"]


def error_measures(dataset: str, entries: Sequence[Entry]) -> Grid | None:
    """The paper's table of error measures: a row per network that ran, with the paper's row of the same c and k; None without any."""
    ours = [(entry, size) for entry in entries if (size := _size(entry)) is not None]
    if not ours:
        return None
    published = {(row.channels, row.steps): row for row in PUBLISHED if row.dataset == dataset}
    rows = [_measures(entry.label, size, entry, published.get(size)) for entry, size in ours]
    tried = {size for _, size in ours}
    rows += [_measures("", size, None, row) for size, row in published.items() if size not in tried]
    measured = ("ē (m)", "σ(e) (m)", "max e (m)", "slope", "predict (ms)", "train (min)")
    headings = ["configuration", "c", "k", "FSS"] + [
        name for each in measured for name in ((each, "paper") if published else (each,))
    ]
    if not published:
        rows = [[*row[:4], *row[4::2]] for row in rows]
    note = "c channels, k steps, feature space size FSS = c·2ᵏ."
    if published:
        note += " The paper's networks were trained for 100,000 iterations and timed on a GeForce 1080 Ti, and tested on a random split."
    return Grid("Error measures of the networks", note, headings, rows)


def _measures(
    label: str, size: tuple[int, int], entry: Entry | None, paper: Published | None
) -> list[str]:
    def ours(group: str, key: str) -> float | None:
        return entry.figure(group, key) if entry else None

    fit = ours("offline_s", "fit")
    cells = [label or "not run here", str(size[0]), str(size[1]), str(size[0] * 2 ** size[1])]
    printed = (
        (paper.mean_m, paper.std_m, paper.max_m, paper.slope, paper.predict_ms, paper.train_min)
        if paper
        else (None,) * 6
    )
    measured = [
        metres(ours("error", key)) for key in ("mean_dof_m", "std_dof_m", "max_dof_m", "slope")
    ]
    measured += [number(ours("latency_ms", "median")), number(None if fit is None else fit / 60)]
    for mine, theirs in zip(measured, printed, strict=True):
        cells += [mine, _as_printed(theirs)]
    return cells


def _as_printed(value: float | None) -> str:
    return "–" if value is None else f"{value:g}"


def same_error(dataset: str, entries: Sequence[Entry]) -> Grid | None:
    """The paper's comparison at the same error: each method's fastest configuration that is as accurate as the best network."""
    network = _reference(entries)
    if network is None:
        return None
    target = network.mean_error_m
    chosen = {
        method: min(
            (e for e in mine if e.mean_error_m <= target), key=lambda e: e.latency_ms, default=None
        )
        for method, mine in _by_method(entries).items()
    }
    note = f"The fastest configuration of each method with ē ≤ {metres(target)} m, that of {network.label}."
    return _comparison("Comparison at the same error", note, dataset, chosen, SAME_ERROR_MS)


def same_time(dataset: str, entries: Sequence[Entry]) -> Grid | None:
    """The paper's comparison at the same time: each method's most accurate configuration that is as fast as the best network."""
    network = _reference(entries)
    if network is None:
        return None
    target = network.latency_ms
    chosen = {
        method: min(
            (e for e in mine if e.latency_ms <= target), key=lambda e: e.mean_error_m, default=None
        )
        for method, mine in _by_method(entries).items()
    }
    note = f"The most accurate configuration of each method within {number(target)} ms, the latency of {network.label}."
    return _comparison("Comparison at the same time", note, dataset, chosen, SAME_TIME_MS)


def _reference(entries: Sequence[Entry]) -> Entry | None:
    """The most accurate network, whatever its method is called."""
    networks = [entry for entry in entries if _size(entry) is not None]
    best = min(networks, key=lambda e: e.mean_error_m, default=None)
    return (
        best
        if best is not None and best.mean_error_m < float("inf") and best.latency_ms < float("inf")
        else None
    )


def _by_method(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    return {
        method: [e for e in entries if e.ran and e.method == method]
        for method in dict.fromkeys(e.method for e in entries)
    }


def _comparison(
    title: str,
    note: str,
    dataset: str,
    chosen: dict[str, Entry | None],
    paper: dict[str, tuple[float, float]],
) -> Grid:
    published = paper if dataset == COMPARED else {}
    rows = []
    for method, entry in chosen.items():
        cells = [
            method,
            *(
                [entry.label, number(entry.latency_ms), metres(entry.mean_error_m)]
                if entry
                else ["not reached", "–", "–"]
            ),
        ]
        time, error = published.get(method, (None, None))
        rows.append(cells + ([_as_printed(time), _as_printed(error)] if published else []))
    headings = [
        "method",
        "configuration",
        "time (ms)",
        "ē (m)",
        *(["paper: time (ms)", "paper: e (m)"] if published else []),
    ]
    return Grid(title, note, headings, rows)
