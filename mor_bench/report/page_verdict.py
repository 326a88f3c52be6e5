"""The verdict card of the page: the choice, its rivals, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mor_bench.analysis.selection_text import NO_RUNNER_UP, RUNNER_UP
from mor_bench.analysis.verdict import offline_rank
from mor_bench.report.entries import Entry, most_accurate
from mor_bench.report.number_format import DASH, number, percent, span, whole
from mor_bench.report.short_names import renamed
from mor_bench.report.whole_cost import Costs

MESH_MEANING = "Below that, a ranking says nothing about the real body."
"""What a discretisation error means for the ranking."""

MOST_NAMES = 4
"""Most names in a sentence; the others are counted."""


@dataclass(frozen=True)
class Pick:
    """A configuration on the card: its part, names, and figures with 95 % intervals."""

    part: str
    entry: Entry
    name: str
    error: str
    error_span: str
    tail: str
    selected: str
    slow: str
    latency: str
    latency_span: str
    offline: str


@dataclass(frozen=True)
class FullOrder:
    """What is known of the winner against the full-order model.

    `pairs` and `break_even` are records of the analysis for this dataset at the required error.
    `n_refined` is the number of loads that the discretisation error was measured with; 0: unknown.
    """

    costs: Costs | None = None
    pairs: Sequence[Mapping[str, Any]] = ()
    break_even: Sequence[Mapping[str, Any]] = ()
    n_refined: int = 0


@dataclass(frozen=True)
class Ranking:
    """The first and the second of the qualified ones by `by`, and what cannot be told apart."""

    by: str
    title: str
    picks: list[Pick]
    sentence: str


@dataclass(frozen=True)
class Card:
    """The verdict card.

    Attributes
    ----------
    rankings : list of Ranking
        By latency and by offline cost; the one by latency is the verdict. Empty without a winner.
    title : str
        The finding without a winner, or the winner.
    headline : str
        The verdict in a sentence or two.
    mesh, stability, command : str
        Discretisation error, stability of the timings, and the command that repeats them.
    sentences, evidence : list of str
        Everything else.
    """

    rankings: list[Ranking]
    title: str
    headline: str
    mesh: str
    stability: str
    command: str
    sentences: list[str]
    evidence: list[str]


def card(
    verdict: Mapping[str, Any],
    entries: Sequence[Entry],
    names: Mapping[str, str],
    known: FullOrder | None = None,
) -> Card:
    """Build the card of a dataset from its verdict; `known` adds the gain over the full order."""
    by_label = {entry.label: entry for entry in entries}
    qualified = [by_label[label] for label in verdict["qualified"] if label in by_label]
    sentences = list(verdict["beside"])
    unsteady = next((s for s in sentences if "timings w" in s), "")
    stability, _, command = unsteady.partition(" Time again: ")
    mesh = next((s for s in sentences if s.startswith("The discretisation error")), "")
    if " is " in mesh:
        counted = (
            f"(median of {known.n_refined} loads)" if known and known.n_refined else "(median)"
        )
        size = mesh.partition(" is ")[2].partition(" (median)")[0]
        mesh = f"Errors are against FEM on this mesh, whose own error is {size} {counted}. "
        mesh += MESH_MEANING
    rankings = []
    if qualified:
        undecided = [names[label] for label in verdict["undecided"] if label in names]
        rankings = [
            _by_latency(qualified, verdict["runner_up"], undecided, names, (entries, known)),
            _by_offline(qualified, verdict["cheapest"], names),
        ]
    headline = renamed(verdict["headline"], names)
    return Card(
        rankings,
        rankings[0].title if rankings else headline.split(". ", 1)[-1],
        headline,
        mesh,
        stability,
        command,
        [renamed(sentence, names) for sentence in sentences],
        [renamed(line, names) for line in verdict["evidence"]],
    )


def method_card(
    verdict: Mapping[str, Any], entries: Sequence[Entry], names: Mapping[str, str], method: str
) -> Card:
    """Build the card of one method on a dataset: its best configuration beside the winner."""
    by_label = {entry.label: entry for entry in entries}
    mine = [entry for entry in entries if entry.method == method and entry.ran]
    qualified = [by_label[label] for label in verdict["qualified"] if label in by_label]
    own = [entry for entry in qualified if entry.method == method]
    n = f"{len(own)} of {sum(e.method == method for e in entries)} configurations qualify."
    picks: list[Pick] = []
    if own:
        first, title = own[0], f"{names[own[0].label]} qualifies"
        picks = [_pick(f"fastest of {method} that qualifies", first, names)]
    elif mine:
        first, how = most_accurate(mine)
        title = f"No configuration of {method} qualifies"
        picks = [_pick(how, first, names)]
    else:
        return replace(card(verdict, entries, names), rankings=[], title=f"{method} did not run")
    sentence = n
    if qualified and first == qualified[0]:
        title = f"{names[first.label]} wins"
    elif qualified:
        picks.append(_pick("winner of the dataset", qualified[0], names))
        ratio = first.latency_ms / qualified[0].latency_ms
        sentence += f" It takes {number(ratio)} times as long as the winner."
    ranking = Ranking("latency", title, picks, sentence)
    return replace(card(verdict, entries, names), rankings=[ranking], title=title)


def _by_latency(
    qualified: Sequence[Entry],
    runner_up: str | None,
    undecided: Sequence[str],
    names: Mapping[str, str],
    others: tuple[Sequence[Entry], FullOrder | None],
) -> Ranking:
    entries, known = others
    first, winner = qualified[0], names[qualified[0].label]
    second = next((e for e in qualified if e.label == runner_up), None)
    picks = [_pick("fastest", first, names)]
    picks += [_pick(RUNNER_UP, second, names)] if second else []
    if undecided:
        sentence = f"Its latency cannot be told apart from that of {listed(undecided)}."
    elif len(qualified) > 1:
        sentence = "It is faster than all others that qualify (95 % intervals of the ratios)."
    else:
        sentence = "No other configuration that was tried qualifies."
    sentence += f" {NO_RUNNER_UP}" if second is None and len(qualified) > 1 else ""
    sentence += _faster(entries, first, names)
    full_order = [e for e in qualified if e.row.reference]
    full_order = full_order or [e for e in entries if e.row.reference and e.ran]
    if full_order and not first.row.reference:
        fastest = min(full_order, key=lambda e: e.latency_ms)
        sentence += _speed_up(fastest, first, names, fastest in qualified)
        sentence += _interval_of_pair(known, fastest.method, first.method)
    sentence += _pays_off(known, first)
    return Ranking("latency", f"Take {winner}", picks, sentence)


def _faster(entries: Sequence[Entry], first: Entry, names: Mapping[str, str]) -> str:
    """Name the configurations that are faster than the winner and do not qualify."""
    faster = [e for e in entries if e.ran and e.latency_ms < first.latency_ms]
    if not faster:
        return ""
    verb = "does" if len(faster) == 1 else "do"
    ordered = sorted(faster, key=lambda e: e.latency_ms)
    return f" Faster, but {verb} not qualify: {listed([names[e.label] for e in ordered], 2)}."


def _speed_up(full_order: Entry, first: Entry, names: Mapping[str, str], meets: bool) -> str:
    """State the ratio of the two latencies shown, which is the one to quote."""
    ratio = number(full_order.latency_ms / first.latency_ms)
    mark = "~" if full_order.unstable else ""
    which = "that meets the needs" if meets else "that was tried; it does not qualify"
    return (
        f" The speed-up to quote is {ratio}: over {names[full_order.label]}{mark}, the fastest "
        f"full-order model {which}."
    )


def _interval_of_pair(known: FullOrder | None, full_order: str, method: str) -> str:
    """State the gain over the full-order model at the required error, with its interval."""
    pairs = known.pairs if known else ()
    pair = next((p for p in pairs if (p["a"], p["b"]) == (full_order, method)), None)
    if pair is None or None in (pair["ratio"], pair["low"], pair["high"]):
        return ""
    ends = f"{number(pair['low'])}–{number(pair['high'])}"
    at = percent(pair["target_rel_l2_median"])
    return f" At an equal error of {at} % it is {number(pair['ratio'])} ({ends})."


def _pays_off(known: FullOrder | None, first: Entry) -> str:
    """State after how many queries the winner is cheaper in total than the full-order model."""
    lines = known.costs.lines if known and known.costs else []
    line = next((line for line in lines if line.label == first.label), None)
    if known is None or line is None or line.break_even is None:
        return ""
    records = (r for r in known.break_even if r["label"] == first.label)
    tuned = next((r["queries_with_tuning"] for r in records), None)
    n = first.row.n_train + (first.row.n_validation or 0)
    samples = f"{whole(n)} samples ({number(line.data)} core-s) and the" if line.data else "its"
    text = f" With {samples} fit, it pays off after {whole(line.break_even)} queries"
    return f"{text} ({whole(tuned)} with tuning)." if tuned is not None else f"{text}."


def _by_offline(
    qualified: Sequence[Entry], cheapest: str | None, names: Mapping[str, str]
) -> Ranking:
    ordered = sorted(qualified, key=lambda entry: offline_rank(entry.row))
    first = next((e for e in qualified if e.label == cheapest), ordered[0])
    second = next((e for e in ordered if e.method != first.method), None)
    picks = [_pick("cheapest offline", first, names)]
    picks += [_pick(RUNNER_UP, second, names)] if second else []
    sentence = (
        "Offline cost: core-seconds of training data and fit, compared with two digits. Repeated "
        "fits differ, so costs of less than a second count as equal; the fastest of them is named."
    )
    return Ranking("offline cost", f"Take {names[first.label]}", picks, sentence)


def _pick(part: str, entry: Entry, names: Mapping[str, str]) -> Pick:
    return Pick(
        part,
        entry,
        names[entry.label],
        percent(entry.figure("error", "rel_l2_median")),
        _interval(entry, "rel_l2_median", percent),
        _error_tail(entry),
        _selected_by(entry),
        _latency_tail(entry),
        number(entry.figure("latency_ms", "median")),
        _interval(entry, "latency_ms", number),
        offline_text(entry),
    )


def _error_tail(entry: Entry) -> str:
    """State the errors of the difficult test loads."""
    p95, worst = (entry.figure("error", name) for name in ("rel_l2_p95", "rel_l2_max"))
    if p95 is None or worst is None:
        return ""
    return (
        f"95 % of the {entry.row.n_test:,} test loads: ≤ {percent(p95)} %; "
        f"largest: {percent(worst)} %"
    )


def _selected_by(entry: Entry) -> str:
    """State the errors on the validation loads, which selected the configuration."""
    found = entry.row.validation
    if found is None:
        return ""
    figures = (found.rel_l2_median, found.rel_l2_p95, found.rel_l2_max)
    median, p95, worst = (percent(value) for value in figures)
    return (
        f"The {entry.row.n_validation:,} validation loads selected it. There, the median is "
        f"{median} %, 95 % of them have ≤ {p95} %, the largest is {worst} %."
    )


def _latency_tail(entry: Entry) -> str:
    """State the latency of slow queries."""
    p99 = entry.figure("latency_ms", "p99")
    return "" if p99 is None else f"99 of 100 queries: at most {number(p99)} ms."


def _interval(entry: Entry, name: str, shown: Callable[[float | None], str]) -> str:
    interval = entry.intervals.get(name)
    return "" if interval is None else span(interval, shown)


def offline_text(entry: Entry) -> str:
    """Format the core-seconds of data and fit in core-seconds, -minutes or -hours."""
    seconds = entry.row.offline_core_s
    if seconds is None:
        return DASH
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{number(seconds / size)} core-{unit}"
    return f"{number(seconds)} core-s"


def listed(names: Sequence[str], most: int = MOST_NAMES) -> str:
    """Join names, and count those that are too many for a sentence."""
    shown = list(names[:most])
    shown += [f"{len(names) - most} more"] if len(names) > most else []
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"
