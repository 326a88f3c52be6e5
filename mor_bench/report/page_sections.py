"""The content of a page about one dataset, or about one method on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mor_bench.analysis.told import FORCE, given_by
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.canvas import Drawn
from mor_bench.report.details import dataset_details, hard_cases
from mor_bench.report.entries import Analysis, Entry, entries_of, verdict_of
from mor_bench.report.hardest_loads import hardest_loads
from mor_bench.report.not_measured import unmeasured
from mor_bench.report.number_format import explain_short_names, percent
from mor_bench.report.page_data import Shown, cells_of, payload, reading_order
from mor_bench.report.page_facts import (
    answer_of,
    deformation,
    facts_of,
    limits_of,
    method_facts,
    n_refined,
    protocol_of,
    untested_of,
)
from mor_bench.report.page_findings import Chart, charts, frontier
from mor_bench.report.page_samples import dataset_arrays, sampled
from mor_bench.report.page_strains import strain_facts
from mor_bench.report.page_tables import figure_tables, with_content
from mor_bench.report.page_verdict import Card, FullOrder, card, method_card
from mor_bench.report.page_worst import worst_cases
from mor_bench.report.scene_text import scene_text
from mor_bench.report.short_names import ShortName, constants, renamed
from mor_bench.report.speed_tables import target_table
from mor_bench.report.summary import interval_basis, needs_in_words, notes_of, warnings_of
from mor_bench.report.text_table import TextTable, with_information, with_short_names
from mor_bench.report.whole_cost import costs_of
from mor_bench.results.comparison import Comparison

UNSTEADY = "timing not stable: "


@dataclass(frozen=True)
class Event:
    """A failure, doubt or warning of a configuration."""

    label: str
    text: str


@dataclass(frozen=True)
class Section:
    """Content of the page about one dataset.

    `rows` are the entries with their short names, cells, and whether they qualify. `constants` are
    parameters that do not vary. `given` is what every method gets. `events` are failures, doubts
    and warnings other than unstable timings, which are `unsteady`. `methods` are facts about each.
    `unmeasured` lists what a full comparison adds. `hard` are tables about difficult loads,
    `details` all further tables.
    `body_picture` replaces the turning bodies on paper. `worst` describes the worst test loads by
    label, and `faster` is the title of the table of pairs. `protocol` says how all was measured.
    `untested` says, by method, why it is not tested where it is built for.
    `data` is the content for the scripts. `elsewhere` is the address of the page that has what a
    brief section leaves out; empty if nothing is left out.
    """

    name: str
    title: str
    scene: str
    limits: str
    card: Card
    given: str
    needs: str
    frontier: Chart
    charts: list[Chart]
    rows: list[tuple[Entry, str, Mapping[str, list[str]], str]]
    constants: str
    short_names: str
    basis: str
    untested: Mapping[str, str]
    facts: list[tuple[str, str]]
    failures: list[Event]
    events: list[Event]
    unsteady: list[Event]
    unmeasured: list[str]
    hard: list[TextTable]
    details: list[TextTable]
    methods: list[tuple[str, list[tuple[str, str]]]]
    body_picture: Drawn | None
    worst: dict[str, list[str]]
    faster: str
    protocol: str
    data: dict[str, Any]
    elsewhere: str = ""

    def brief(self, elsewhere: str) -> Section:
        """Return only the verdict, the error against time and the table of configurations."""
        kept = {key: value for key, value in self.data.items() if key not in _CHARTS_ALONE}
        return replace(
            self,
            charts=[],
            hard=[],
            details=[],
            body_picture=None,
            data=kept,
            elsewhere=elsewhere,
        )


_CHARTS_ALONE = (
    "distributions",
    "deformations",
    "positions",
    "singular",
    "learning",
    "losses",
    "costs",
    "bodies",
)
"""Keys of the data that only the charts of a whole section read."""


@dataclass(frozen=True)
class View:
    """What the sections of a page are made of.

    Attributes
    ----------
    comparison : Comparison
    analysis : dict
    drawn : sequence of Drawn
        The pictures on disk.
    names : dict
        By dataset and label: the short name of a configuration.
    body_bytes : int
        Room for the bodies of a section, in letters of the page.
    method : str or None
        The method that the page is about; None for all.
    pages : dict
        By dataset: the address of its own page.
    """

    comparison: Comparison
    analysis: Analysis
    drawn: Sequence[Drawn]
    names: Mapping[str, Mapping[str, ShortName]]
    body_bytes: int
    method: str | None = None
    pages: Mapping[str, str] = field(default_factory=dict)


def section_of(view: View, dataset: str) -> Section:
    """Collect the content about one dataset."""
    comparison, analysis = view.comparison, view.analysis
    entries = entries_of(comparison, dataset, analysis)
    rows = [entry.row for entry in entries]
    named, needs = view.names[dataset], needs_of(comparison, dataset)
    given = given_by(comparison, dataset)
    names = {label: str(name) for label, name in named.items()}
    verdict = _card(view, dataset, entries, names)
    untested = untested_of(analysis, entries)
    shown = Shown(comparison, dataset, analysis, entries, names, verdict, untested)
    data = payload(shown, view.body_bytes)
    tables = [target_table(comparison, dataset, kind, analysis) for kind in _TARGETS]
    tables += [*dataset_details(comparison, dataset, analysis), *figure_tables(entries)]
    picks = [pick.entry for ranking in verdict.rankings for pick in ranking.picks]
    samples = sampled(comparison, entries, picks)
    hard = [
        *hard_cases(dataset, entries, analysis),
        *hardest_loads(samples, dataset_arrays(comparison, dataset)),
    ]
    pictures = (d for d in view.drawn if d.dataset == dataset and "worst-samples" in d.path.name)
    return Section(
        name=dataset,
        title=str(comparison.datasets.get(dataset, {}).get("title") or ""),
        scene=" ".join(
            [scene_text(comparison.datasets.get(dataset, {})), deformation(entries, samples)]
        ),
        limits=limits_of(comparison, analysis, entries),
        card=verdict,
        given="nodal forces (N)" if given == FORCE else f"the {given} (m)",
        needs=needs_in_words(needs),
        frontier=frontier(data, _frontier_title(verdict)),
        charts=charts(data),
        rows=[
            (entry, names[entry.label], cells_of(entry), answer_of(entry, needs))
            for entry in sorted(entries, key=reading_order)
        ],
        constants=constants(rows),
        short_names=explain_short_names(entry.swept for entry in entries),
        basis=interval_basis(dataset, analysis),
        untested=untested,
        facts=[
            *facts_of(comparison, dataset, entries),
            *strain_facts(samples, dataset_arrays(comparison, dataset)),
        ],
        failures=[Event(names[e.label], e.trouble) for e in entries if e.trouble],
        events=_events(view, dataset, entries),
        unsteady=[Event(names[e.label], "; ".join(e.unstable)) for e in entries if e.unstable],
        unmeasured=unmeasured(comparison, dataset, entries),
        hard=_complete(hard, entries, named),
        details=_complete(tables, entries, named),
        methods=[
            (method, method_facts(comparison, method))
            for method in dict.fromkeys(entry.method for entry in entries)
        ],
        body_picture=next(pictures, None),
        worst={item.entry.label: worst_cases(item.arrays) for item in samples},
        faster=f"Who is faster at {percent(needs.error)} %, the required error",
        protocol=protocol_of(comparison, dataset, entries),
        data=data,
    )


def _card(view: View, dataset: str, entries: Sequence[Entry], names: Mapping[str, str]) -> Card:
    """Return the verdict on all methods, or on the one of the page."""
    if not entries:
        return _EMPTY_CARD
    found = verdict_of(view.analysis, dataset)
    if view.method:
        return method_card(found, entries, names, view.method)
    costs = costs_of(view.comparison, dataset, view.analysis, entries)
    error = needs_of(view.comparison, dataset).error
    pairs, break_even = (
        [
            record
            for record in view.analysis[key]
            if (record["dataset"], record["target_rel_l2_median"]) == (dataset, error)
        ]
        for key in ("pairwise", "break_even")
    )
    n = n_refined(view.comparison.datasets.get(dataset, {}))
    return card(found, entries, names, FullOrder(costs, pairs, break_even, n))


def _events(view: View, dataset: str, entries: Sequence[Entry]) -> list[Event]:
    """List doubts and warnings other than unstable timings."""
    notes = notes_of(view.comparison, dataset, view.analysis)
    events = [(label, doubt) for label, doubt in notes if not doubt.startswith(UNSTEADY)]
    events += [(label, f"warning: {warning}") for label, warning in warnings_of(entries)]
    return [Event(renamed(label, view.names[dataset]), text) for label, text in events]


_TARGETS = ("time_at_error", "error_at_time")

_EMPTY_CARD = Card([], "No configuration was run.", "No configuration was run.", "", "", "", [], [])


def _frontier_title(verdict: Card) -> str:
    """State who wins, as the title of the chart."""
    if not verdict.rankings:
        return "No configuration meets both needs"
    first = verdict.rankings[0].picks[0]
    answer = f"{first.name} answers in {first.latency} ms with an error of {first.error} %"
    return f"{first.part.capitalize()}: {answer}"


def _complete(
    tables: Sequence[TextTable], entries: Sequence[Entry], names: Mapping[str, ShortName]
) -> list[TextTable]:
    """Drop empty tables; add what the methods are told, and short names."""
    return [
        with_short_names(with_information(table, entries), names) for table in with_content(tables)
    ]
