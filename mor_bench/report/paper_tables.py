"""The tables of the U-Mesh paper with our own figures beside the published ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite

from mor_bench.report.entries import Entry, best_per_method
from mor_bench.report.number_format import DASH, metres, number, percent
from mor_bench.report.published_figures import (
    COMPARED,
    REMARKS,
    SAME_ERROR,
    SAME_TIME,
    SCENES,
    SELECTED_ON_TEST,
    Published,
    published_of,
    scene_of,
)
from mor_bench.report.text_table import TextTable

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
    published = {(row.channels, row.steps): row for row in published_of(dataset)}
    rows = [
        _measures(entry.label, size, _measured(entry), published.get(size)) for entry, size in ours
    ]
    tried = {size for _, size in ours}
    rows += [
        _measures("not run here", size, [DASH] * 6, row)
        for size, row in published.items()
        if size not in tried
    ]
    measured = ("ē (m)", "σ(e) (m)", "max e (m)", "slope", "predict (ms)", "train (core-min)")
    headings = ["configuration", "c", "k", "FSS"]
    headings += [name for heading in measured for name in (heading, "paper")]
    note = "c channels, k steps, feature space size FSS = c·2ᵏ."
    if published:
        note += (
            " The paper's networks were trained for 100,000 iterations, "
            "timed on a GeForce 1080 Ti and tested on a random split; their minutes of training "
            "are minutes of that graphics processor. Errors in m compare only "
            "at equal deformations: see the next table."
        )
    else:
        headings, *rows = ([*row[:4], *row[4::2]] for row in (headings, *rows))
    return TextTable("Error measures of the networks", note, headings, rows)


def _measured(entry: Entry) -> list[str]:
    fit_s = entry.row.fit_core_s
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


def against_the_paper(dataset: str, entries: Sequence[Entry]) -> TextTable | None:
    """Build the comparison with the paper's network by slope and by relative error.

    The first row is the paper's network; each method's most accurate configuration follows. None
    if the dataset is none of the paper's scenes, or nothing ran.
    """
    scene, best = SCENES.get(scene_of(dataset)), best_per_method(entries)
    if scene is None or not best:
        return None
    paper = scene.network
    first = [
        f"U-Mesh in the paper, c = {paper.channels}, k = {paper.steps}",
        _as_printed(scene.amplitude_m),
        _as_printed(paper.mean_m),
        DASH,
        percent(paper.mean_m / scene.amplitude_m),
        DASH,
        _as_printed(paper.slope),
        DASH if paper.slope is None else "1",
        _percent_as_printed(scene.tip_at_max_e),
        _percent_as_printed(scene.tip_at_largest),
    ]
    note = (
        "ē counts all degrees of freedom of the mesh, supports included, as the paper's formula "
        "does; beside it over the free ones alone. Largest u: largest displacement of a node in "
        "the test set. Slope: of the least-squares line through the origin, e over the sample's "
        "largest displacement. Tip: relative error at the node that moves most, for the sample "
        "with the largest e and for the one with the largest displacement. "
    )
    headings = ["configuration", "largest u (m)", "ē (m)", "ē, free dofs (m)"]
    headings += ["ē / largest u (%)", "median relative L2 error (%)", "slope", "slope / paper's"]
    headings += ["tip at largest e (%)", "tip at largest u (%)"]
    note += " ".join([*REMARKS.get(scene_of(dataset), ()), SELECTED_ON_TEST])
    rows = [first, *(_against(entry, paper.slope) for entry in best)]
    return TextTable("Against the paper, by slope and relative error", note, headings, rows)


def _against(entry: Entry, slope: float | None) -> list[str]:
    own = entry.figure("error", "slope")
    return [
        entry.label,
        number(entry.figure("error", "amplitude_m")),
        metres(entry.figure("error", "mean_dof_m")),
        metres(entry.figure("error", "mean_free_dof_m")),
        percent(_relative(entry)),
        percent(entry.figure("error", "rel_l2_median")),
        metres(own),
        DASH if slope is None or own is None else number(own / slope),
        percent(entry.figure("error", "tip_rel_at_max_e")),
        percent(entry.figure("error", "tip_rel_at_largest")),
    ]


def _relative(entry: Entry) -> float | None:
    """Return ē over the largest displacement of the test set, as a fraction; None if unknown."""
    mean = entry.figure("error", "mean_dof_m")
    amplitude = entry.figure("error", "amplitude_m")
    return None if mean is None or not amplitude else mean / amplitude


def _percent_as_printed(fraction: float | None) -> str:
    return DASH if fraction is None else f"{100 * fraction:g}"


def same_error_or_time(dataset: str, entries: Sequence[Entry]) -> list[TextTable]:
    """Build the paper's two comparisons with its best network: at the same error and time.

    The first shows each method's fastest configuration that is as accurate as the network. The
    second shows its most accurate configuration that is as fast. The errors of the verdict select;
    the figures are those on the test set. Empty if no network ran.
    """
    network = _best_network(entries)
    if network is None:
        return []
    accurate = [e for e in entries if e.ran and e.error_bound <= network.error_bound]
    fast = [e for e in entries if e.ran and e.latency_ms <= network.latency_ms]
    error, time = metres(network.mean_error_m), number(network.latency_ms)
    methods = list(dict.fromkeys(e.method for e in entries))
    return [
        _comparison(
            "Comparison at the same error",
            "The fastest configuration of each method whose error by the rule of the verdict (the "
            f"95 % upper bound of the median) is at most that of {network.label} (ē = {error} m). "
            "ē does not select: a method can have a smaller one, and still not reach this bound.",
            _least(methods, accurate, lambda e: e.latency_ms),
            SAME_ERROR if scene_of(dataset) == COMPARED else {},
        ),
        _comparison(
            "Comparison at the same time",
            f"The most accurate configuration of each method, by the error that the verdict "
            f"uses, within {time} ms, the latency of {network.label}.",
            _least(methods, fast, lambda e: e.error_bound),
            SAME_TIME if scene_of(dataset) == COMPARED else {},
        ),
    ]


def _best_network(entries: Sequence[Entry]) -> Entry | None:
    """Return the most accurate network with a latency, under any method name."""
    networks = [entry for entry in entries if _size(entry) is not None]
    best = min(networks, key=lambda e: e.error_bound, default=None)
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
        cells = [method, "not reached", DASH, DASH, DASH]
        if entry:
            cells = [method, entry.label, number(entry.latency_ms), metres(entry.mean_error_m)]
            cells.append(percent(_relative(entry)))
        if published:
            time, e = published.get(method, (None, None))
            relative = None if e is None else e / SCENES[COMPARED].amplitude_m
            cells += [_as_printed(time), _as_printed(e), percent(relative)]
        rows.append(cells)
    headings = ["method", "configuration", "time (ms)", "ē (m)", "ē / largest u (%)"]
    if published:
        headings += ["paper: time (ms)", "paper: e (m)", "paper: e / largest u (%)"]
        note += f" {REMARKS[COMPARED][0]}"
    return TextTable(title, note, headings, rows)
