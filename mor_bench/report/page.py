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
from mor_bench.report.details import dataset_details, overall
from mor_bench.report.entries import (
    Analysis,
    Entry,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.figures import write_figures
from mor_bench.report.number_format import explain_short_names
from mor_bench.report.page_columns import ConfigurationTable, configuration_columns
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


@dataclass(frozen=True)
class Event:
    """A failure, doubt or warning of a configuration."""

    label: str
    text: str
    failed: bool = False


@dataclass(frozen=True)
class Section:
    """Content of the page about one dataset.

    `verdict` is the summary of the verdict. `classes` maps labels and methods to what they are
    told, for the filter. `facts` describe the run. `basis` and `short_names` are sentences under
    the tables. `targets` are time at error and error at time; `details` are the tables after the
    figures.
    """

    name: str
    title: str
    verdict: Mapping[str, Any]
    classes: Mapping[str, str]
    facts: list[tuple[str, str]]
    configurations: ConfigurationTable
    basis: str
    short_names: str
    events: list[Event]
    targets: list[TextTable]
    details: list[TextTable]
    figures: list[Drawn]


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
    page = environment.get_template("page.html.j2").render(
        sections=[_section(comparison, name, drawn, analysis) for name in names],
        overall=overall(analysis),
        overall_figures=[figure for figure in drawn if figure.dataset not in names],
        machine=list(_flat(comparison.machine)),
        told={told or "": told_text(told, observed) for told in classes_of(comparison.rows)},
        legend=LEGEND,
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
    return Section(
        name=dataset,
        title=str(comparison.datasets.get(dataset, {}).get("title") or ""),
        verdict=verdict_of(analysis, dataset),
        classes={name: e.row.told or "" for e in entries for name in (e.method, e.label)},
        facts=_facts(comparison, dataset, entries),
        configurations=configuration_columns(entries),
        basis=interval_basis(dataset, analysis),
        short_names=explain_short_names(entry.swept for entry in entries),
        events=_events(entries, notes_of(comparison, dataset, analysis)),
        targets=[
            target_table(comparison, dataset, kind, analysis)
            for kind in ("time_at_error", "error_at_time")
        ],
        details=dataset_details(comparison, dataset, analysis),
        figures=[figure for figure in drawn if figure.dataset == dataset],
    )


def _events(entries: Sequence[Entry], notes: Sequence[tuple[str, str]]) -> list[Event]:
    """List failures and skips, then doubts, then warnings."""
    return [
        *(Event(e.label, e.trouble, failed=True) for e in entries if e.trouble),
        *(Event(label, doubt) for label, doubt in notes),
        *(Event(label, f"warning: {warning}") for label, warning in warnings_of(entries)),
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
    facts += [
        (key, "; ".join(f"{k}: {v}" if k else v for k, v in _flat(spec[key])))
        for key in ("geometry", "material", "supports", "loads", "snapshots")
        if key in spec
    ]
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
