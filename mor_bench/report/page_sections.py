"""The content of a page about one dataset, or about one method on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mor_bench.analysis.selection_text import needs_text
from mor_bench.analysis.told import is_observed
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.canvas import Drawn
from mor_bench.report.cards import pair_text
from mor_bench.report.details import dataset_details, hard_cases
from mor_bench.report.entries import Analysis, Entry, best_per_method, entries_of, verdict_of
from mor_bench.report.hardest_loads import hardest_loads
from mor_bench.report.number_format import explain_short_names
from mor_bench.report.page_data import Shown, cells_of, dataset_arrays, payload, reading_order
from mor_bench.report.page_findings import Chart, charts, frontier
from mor_bench.report.page_samples import sampled
from mor_bench.report.page_tables import figure_tables, with_content
from mor_bench.report.page_verdict import Card, card, method_card
from mor_bench.report.short_names import ShortName, constants, renamed
from mor_bench.report.speed_tables import target_table
from mor_bench.report.summary import (
    discretisation_error,
    interval_basis,
    notes_of,
    warnings_of,
)
from mor_bench.report.text_table import TextTable, with_information, with_short_names
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

    `rows` are the entries with their short names and cells; `constants` are parameters that do not
    vary. `given` is what every method gets. `events` are failures, doubts and warnings other than
    unstable timings, which are `unsteady`. `hard` are tables about difficult loads, `targets` and
    `details` all further tables.
    `body_picture` replaces the turning bodies on paper. `data` is the content for the scripts.
    """

    name: str
    title: str
    card: Card
    given: str
    needs: str
    frontier: Chart
    charts: list[Chart]
    rows: list[tuple[Entry, str, Mapping[str, list[str]]]]
    constants: str
    short_names: str
    basis: str
    facts: list[tuple[str, str]]
    failures: list[Event]
    events: list[Event]
    unsteady: list[Event]
    hard: list[TextTable]
    details: list[TextTable]
    body_picture: Drawn | None
    data: dict[str, Any]


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
    """

    comparison: Comparison
    analysis: Analysis
    drawn: Sequence[Drawn]
    names: Mapping[str, Mapping[str, ShortName]]
    body_bytes: int
    method: str | None = None


def section_of(view: View, dataset: str) -> Section:
    """Collect the content about one dataset."""
    comparison, analysis = view.comparison, view.analysis
    entries = entries_of(comparison, dataset, analysis)
    rows = [entry.row for entry in entries]
    named = view.names[dataset]
    names = {label: str(name) for label, name in named.items()}
    verdict = _EMPTY_CARD
    if entries:
        found = verdict_of(analysis, dataset)
        verdict = (
            method_card(found, entries, names, view.method)
            if view.method
            else card(found, entries, names)
        )
    shown = Shown(comparison, dataset, analysis, entries, names, verdict)
    data = payload(shown, view.body_bytes)
    notes = notes_of(comparison, dataset, analysis)
    events = [Event(label, doubt) for label, doubt in notes if not doubt.startswith(UNSTEADY)]
    events += [Event(label, f"warning: {warning}") for label, warning in warnings_of(entries)]
    tables = [target_table(comparison, dataset, kind, analysis) for kind in _TARGETS]
    tables += [*dataset_details(comparison, dataset, analysis), *figure_tables(entries)]
    samples = sampled(comparison, entries, best_per_method(entries))
    hard = [
        *hard_cases(dataset, entries, analysis),
        *hardest_loads(samples, dataset_arrays(comparison, dataset)),
    ]
    pictures = (d for d in view.drawn if d.dataset == dataset and "worst-samples" in d.path.name)
    return Section(
        name=dataset,
        title=str(comparison.datasets.get(dataset, {}).get("title") or ""),
        card=verdict,
        given="observed displacements" if is_observed(comparison, dataset) else "nodal forces (N)",
        needs=needs_text(needs_of(comparison, dataset)),
        frontier=frontier(data, _frontier_title(verdict)),
        charts=charts(data),
        rows=[
            (entry, names[entry.label], cells_of(entry))
            for entry in sorted(entries, key=reading_order)
        ],
        constants=constants(rows),
        short_names=explain_short_names(entry.swept for entry in entries),
        basis=interval_basis(dataset, analysis),
        facts=_facts(comparison, dataset, entries),
        failures=[Event(names[e.label], e.trouble) for e in entries if e.trouble],
        events=[Event(renamed(e.label, named), e.text) for e in events],
        unsteady=[Event(names[e.label], "; ".join(e.unstable)) for e in entries if e.unstable],
        hard=_complete(hard, entries, named),
        details=_complete(tables, entries, named),
        body_picture=next(pictures, None),
        data=data,
    )


_TARGETS = ("time_at_error", "error_at_time")

_EMPTY_CARD = Card([], "No configuration was run.", "No configuration was run.", "", "", "", [], [])


def _frontier_title(verdict: Card) -> str:
    """State who wins, as the title of the chart."""
    if not verdict.rankings:
        return "No configuration meets both needs"
    first = verdict.rankings[0].picks[0]
    return f"{first.name} answers in {first.latency} ms with an error of {first.error} %"


def _complete(
    tables: Sequence[TextTable], entries: Sequence[Entry], names: Mapping[str, ShortName]
) -> list[TextTable]:
    """Drop empty tables; add what the methods are told, and short names."""
    return [
        with_short_names(with_information(table, entries), names) for table in with_content(tables)
    ]


def _facts(comparison: Comparison, dataset: str, entries: Sequence[Entry]) -> list[tuple[str, str]]:
    """List facts about the run: the dataset's description, its split, its needs, counts of rows."""
    spec, rows = comparison.datasets.get(dataset, {}), [entry.row for entry in entries]
    unused = _values(row.n_unused for row in rows)
    split = f"by {_values(row.split for row in rows)}; "
    split += f"training samples: {_values(row.n_train for row in rows)}; "
    split += f"validation samples: {_values(row.n_validation for row in rows)}; "
    split += f"test samples: {_values(row.n_test for row in rows)}"
    split += f"; in no part: {unused}" if any(row.n_unused for row in rows) else ""
    counts = (
        f"{sum(r.status == status for r in rows)} {status}" for status in ("failed", "skipped")
    )
    facts = [("source", str(spec["source"]))] if spec.get("source") else []
    for key, heading in _SCENE.items():
        if spec.get(key):
            pairs = [(k, _WORDS.get((key, k, v), v)) for k, v in flat(spec[key]) if v != "None"]
            facts.append((heading, "; ".join(pair_text(k, v) if k else v for k, v in pairs)))
    return [
        *facts,
        ("split", split),
        ("needs", needs_text(needs_of(comparison, dataset))),
        ("degrees of freedom", _values(f"{row.n_dofs:,}" for row in rows if row.n_dofs)),
        ("discretisation error of the dataset's mesh", discretisation_error(entries)),
        ("threads", _values(row.threads for row in rows)),
        ("configurations", f"{len(rows)}: {sum(r.ok for r in rows)} ran, {', '.join(counts)}"),
    ]


_SCENE = {
    "geometry": "geometry",
    "discretisation": "discretisation",
    "material": "material",
    "supports": "supports (clamped: no displacement)",
    "loads": "loads",
    "snapshots": "snapshots",
}
"""Parts of a dataset's description, and their headings."""

_WORDS = {
    ("discretisation", "element", "hexahedron"): "hexahedron with 8 nodes (H8)",
    ("discretisation", "element", "tetrahedron"): "tetrahedron with 4 nodes (T4)",
    ("loads", "kind", "force"): "force, its direction uniform on the sphere",
    ("loads", "kind", "normal"): "force along the normal, pressing or pulling",
    ("loads", "kind", "tangential"): "force along the surface, its direction uniform",
}
"""What some values mean, by part, key and value."""


def _values(found: Iterable[object]) -> str:
    """Join the different values, in order; a dash if there are none."""
    return ", ".join(dict.fromkeys(map(str, found))) or "–"


def flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Flatten nested tables to pairs such as ``("versions numpy", "2.4.6")``."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from flat(item, f"{prefix} {key}".strip())
    elif isinstance(value, list | tuple) and any(isinstance(item, dict) for item in value):
        for item in value:
            yield from flat(item, prefix)
    else:
        yield prefix, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
