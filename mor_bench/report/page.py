"""The report as one HTML page that needs no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.selection_text import needs_text
from mor_bench.analysis.told import LEGEND, classes_of, is_observed, told_text
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.canvas import Drawn
from mor_bench.report.details import dataset_details, hard_cases, overall
from mor_bench.report.entries import (
    Analysis,
    Entry,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.figures import write_figures
from mor_bench.report.number_format import bytes_text, explain_short_names
from mor_bench.report.page_data import Shown, cells_of, payload, reading_order
from mor_bench.report.page_findings import Chart, charts, frontier
from mor_bench.report.page_scripts import embedded_json, policy, scripts, styles
from mor_bench.report.page_tables import figure_tables, with_content
from mor_bench.report.page_verdict import Card, card
from mor_bench.report.short_names import constants, short_names
from mor_bench.report.speed_tables import target_table
from mor_bench.report.summary import (
    discretisation_error,
    interval_basis,
    notes_of,
    warnings_of,
)
from mor_bench.report.text_table import TextTable
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically

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
    vary. `events` are failures, doubts and warnings other than unstable timings, which are
    `unsteady`. `hard` are tables about difficult loads, `targets` and `details` all further tables.
    `body_picture` replaces the turning bodies on paper. `data` is the content for the scripts.
    """

    name: str
    title: str
    card: Card
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


def render(comparison: Comparison, analysis: Analysis | None = None) -> list[Path]:
    """Write all figures and the page; `analyse` makes the analysis if it is not given.

    Returns
    -------
    list of Path
        The figures, and OUT/report.html last.
    """
    analysis = analysis or analyse(comparison)
    drawn = write_figures(comparison, analysis)
    names = dataset_names(comparison)
    observed = all(is_observed(comparison, name) for name in names)
    environment = Environment(
        loader=PackageLoader("mor_bench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = _data_uri
    sections = [_section(comparison, name, drawn, analysis) for name in names]
    included = scripts()
    page = environment.get_template("page.html.j2").render(
        sections=sections,
        overall=with_content(overall(analysis)),
        machine=[_readable(*pair) for pair in _flat(comparison.machine)],
        told={told or "": told_text(told, observed) for told in classes_of(comparison.rows)},
        legend=LEGEND,
        styles=styles(),
        scripts=included,
        policy=policy(included),
        data=embedded_json([section.data for section in sections]),
    )
    path = comparison.out / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, page.encode())
    return [*(figure.path for figure in drawn), path]


def _data_uri(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _section(
    comparison: Comparison, dataset: str, drawn: Sequence[Drawn], analysis: Analysis
) -> Section:
    entries = entries_of(comparison, dataset, analysis)
    rows = [entry.row for entry in entries]
    names = {label: str(name) for label, name in short_names(rows).items()}
    verdict = card(verdict_of(analysis, dataset), entries, names) if entries else _EMPTY_CARD
    data = payload(
        Shown(comparison, dataset, analysis, entries, names, verdict),
        len(dataset_names(comparison)),
    )
    notes = notes_of(comparison, dataset, analysis)
    events = [Event(label, doubt) for label, doubt in notes if not doubt.startswith(UNSTEADY)]
    events += [Event(label, f"warning: {warning}") for label, warning in warnings_of(entries)]
    tables = [target_table(comparison, dataset, kind, analysis) for kind in _TARGETS]
    pictures = (d for d in drawn if d.dataset == dataset and "worst-samples" in d.path.name)
    return Section(
        name=dataset,
        title=str(comparison.datasets.get(dataset, {}).get("title") or ""),
        card=verdict,
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
        failures=[Event(e.label, e.trouble) for e in entries if e.trouble],
        events=events,
        unsteady=[Event(e.label, "; ".join(e.unstable)) for e in entries if e.unstable],
        hard=with_content(hard_cases(dataset, entries, analysis)),
        details=with_content(
            [*tables, *dataset_details(comparison, dataset, analysis), *figure_tables(entries)]
        ),
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
    for key in ("geometry", "material", "supports", "loads", "snapshots"):
        if key in spec:
            pairs = [f"{k}: {v}" if k else v for k, v in _flat(spec[key]) if v != "None"]
            facts.append((key, "; ".join(pairs)))
    return [
        *facts,
        ("split", split),
        ("needs", needs_text(needs_of(comparison, dataset))),
        ("discretisation error of the dataset's mesh", discretisation_error(entries)),
        ("threads", _values(row.threads for row in rows)),
        ("configurations", f"{len(rows)}: {sum(r.ok for r in rows)} ran, {', '.join(counts)}"),
    ]


def _values(found: Iterable[object]) -> str:
    """Join the different values, in order; a dash if there are none."""
    return ", ".join(dict.fromkeys(map(str, found))) or "–"


def _readable(key: str, text: str) -> tuple[str, str]:
    """Format a size in bytes."""
    name = key.removesuffix("_bytes")
    return (name, bytes_text(float(text))) if name != key and text.isdecimal() else (key, text)


def _flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Flatten nested tables to pairs such as ``("versions numpy", "2.4.6")``."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{prefix} {key}".strip())
    elif isinstance(value, list | tuple) and any(isinstance(item, dict) for item in value):
        for item in value:
            yield from _flat(item, prefix)
    else:
        yield prefix, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
