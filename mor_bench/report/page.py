"""The report as one HTML page that needs nothing but itself."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mor_bench.analysis.analyse import analyse
from mor_bench.report.canvas import Drawn
from mor_bench.report.console_tables import target_cells
from mor_bench.report.details import dataset_details, interval_cells, overall
from mor_bench.report.figures import write_figures
from mor_bench.report.paper import Grid
from mor_bench.report.summary import (
    Entry,
    basis_of,
    dataset_names,
    discretisation_error,
    entries_of,
    headline,
    metres,
    needs_of,
    notes_of,
    number,
    percent,
    short_names_used,
    size_of,
    warnings_of,
)
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: #222; background: #fff;
       max-width: 1160px; margin: 0 auto; padding: 24px 20px 60px; }
h1 { font-size: 27px; margin: 0 0 4px; } h2 { font-size: 21px; margin: 42px 0 8px; border-bottom: 1px solid #ddd; padding-bottom: 4px; }
h3 { font-size: 16px; margin: 26px 0 6px; } p { margin: 6px 0; }
.headline { background: #f1f6fa; border-left: 4px solid #0072B2; padding: 12px 16px; font-size: 16px; margin: 14px 0; }
.quiet { color: #666; font-size: 13px; } .wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; margin: 6px 0; }
th, td { padding: 3px 7px; text-align: right; vertical-align: top; border-bottom: 1px solid #e8e8e8; white-space: nowrap; }
thead th { background: #f5f5f5; border-bottom: 1px solid #bbb; font-weight: 600; vertical-align: bottom; }
th.text, td.text { text-align: left; } td.reason { white-space: normal; min-width: 240px; text-align: left; }
th.group { text-align: center; border-left: 1px solid #ddd; }
tr.meets td, .pinned tr.meets td:first-child { background: #eef6ea; } tr.bad td, .pinned tr.bad td:first-child { color: #a33; background: #fdf3f1; }
tr.front td:first-child { font-weight: 600; }
.pinned td:first-child, .pinned tr:first-child th:first-child { position: sticky; left: 0; background: #fff; }
.pinned tr:first-child th:first-child { background: #f5f5f5; }
td small, td .quiet { color: #777; font-size: 11.5px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 3px 18px; margin: 6px 0; } dt { color: #666; }
dd { margin: 0; overflow-wrap: anywhere; }
dl.words dt { color: #222; font-weight: 600; }
figure { margin: 18px 0 26px; } figure img { width: 100%; height: auto; border: 1px solid #eee; } figcaption { color: #555; font-size: 13px; }
@media (max-width: 700px) { dl { grid-template-columns: 1fr; } dd { margin-bottom: 6px; } }
"""

SURE = "95 %"
"""The column of intervals."""

OF_TEXT = frozenset(
    {"configuration", "test set", "stable", "verdict", "where it belongs", "tested there"}
)
"""Columns that are no figures."""

GROUPS = (
    (
        "relative L2 (%)",
        (
            ("median", "rel_l2_median"),
            (SURE, "rel_l2_median"),
            ("p95", "rel_l2_p95"),
            ("max", "rel_l2_max"),
        ),
    ),
    ("latency (ms)", (("median", "median"), (SURE, "latency_ms"), ("p95", "p95"), ("p99", "p99"))),
    (
        "per degree of freedom (m)",
        (("ē", "mean_dof_m"), (SURE, "mean_dof_m"), ("σ(e)", "std_dof_m"), ("max e", "max_dof_m")),
    ),
    ("offline (s)", (("data", "data"), ("fit", "fit"))),
    ("nodal (m)", (("max", "max_nodal_m"),)),
    ("e over u", (("slope", "slope"),)),
)
"""Headings of the configuration table that stand over several figures: name, and the columns with their keys."""

DEFINITIONS = (
    ("e", "of a test sample: the mean absolute error over the degrees of freedom, m."),
    ("ē, σ(e), max e", "mean, standard deviation (with M − 1) and maximum of e over the test set."),
    (
        "relative L2",
        "of a test sample: the norm of the error over the norm of the reference displacement; median, 95th percentile, maximum over the test set.",
    ),
    ("largest nodal", "the largest Euclidean error of any node in any test sample."),
    (
        "slope",
        "of the least-squares line through the origin of e over the largest nodal displacement of the sample.",
    ),
    (
        "latency",
        "wall-clock time of one query at a time, from nodal forces to nodal displacements on the host, after warm-up; percentiles over the queries.",
    ),
    (
        "95 %",
        "of an error: the interval that other load regions (and training seeds, where several were tried) would give, from a bootstrap over the "
        "load regions of the test set, the same for all methods. Of a latency: the interval in which the median of a repeated measurement in as many "
        "fresh processes is expected. Of the ratio of two times: both, without what the two share. Nothing is corrected for the number of pairs.",
    ),
    (
        "failures",
        "a test sample without a prediction counts as an infinite error; it is never dropped.",
    ),
    (
        "meets the needs",
        "the median relative L2 error and the median latency are both within what the dataset's file asks for.",
    ),
    (
        "Pareto",
        "no other configuration of the dataset has both a smaller median error and a smaller median latency.",
    ),
    (
        "time at error, error at time",
        "log-log between adjacent non-dominated configurations of a method, beside the best real configuration that meets the target. "
        "Interpolation never extrapolates: beyond the configurations measured, a target is “not reached”.",
    ),
    (
        "discretisation error",
        "of the scene's own mesh against the limit of uniformly refined ones (Richardson's where they show a sane order, else the finest), under the "
        "same tractions: mean of e, median of relative L2, over a few loads of the dataset. All errors above are against the full-order model on "
        "this mesh: methods' errors below it are errors against this mesh, not against the body.",
    ),
)

RAW_FILES = (
    ("results.json", "all rows, machine and datasets"),
    ("results.csv", "the same rows, flat"),
    (
        "comparison.json",
        "time at error, error at time, pairs of methods, break-even and more, with intervals",
    ),
    ("samples/", "raw latencies and per-sample errors of every row (HDF5)"),
    ("figures/", "the figures of this page (PNG)"),
)


def render(comparison: Comparison, analysis: Mapping[str, Any] | None = None) -> list[Path]:
    """Write all figures and the page.

    Parameters
    ----------
    comparison : Comparison
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, which is called if it is not given.

    Returns
    -------
    list of Path
        The figures, and OUT/report.html last.
    """
    analysis = analysis or analyse(comparison)
    drawn = write_figures(comparison, analysis)
    return [*(figure.path for figure in drawn), _write_page(comparison, drawn, analysis)]


def write_report(comparison: Comparison, analysis: Mapping[str, Any] | None = None) -> Path:
    """Write all figures and OUT/report.html; return the page's path."""
    return render(comparison, analysis)[-1]


def _write_page(
    comparison: Comparison, drawn: Sequence[Drawn], analysis: Mapping[str, Any]
) -> Path:
    names = dataset_names(comparison)
    sections = "\n".join(
        _dataset_section(
            comparison, name, [figure for figure in drawn if figure.dataset == name], analysis
        )
        for name in names
    )
    headlines = "".join(
        f'<p class="headline"><b>{escape(name)}</b>: {escape(headline(comparison, name))}</p>'
        for name in names
    )
    shared = "".join(map(_grid, overall(analysis))) + "".join(
        _figure(figure) for figure in drawn if figure.dataset not in names
    )
    raw = "".join(
        f'<dt><a href="{name}">{name}</a></dt><dd>{escape(what)}</dd>' for name, what in RAW_FILES
    )
    words = "".join(
        f"<dt>{escape(word)}</dt><dd>{escape(meaning)}</dd>" for word, meaning in DEFINITIONS
    )
    page = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>mor-bench: {escape(", ".join(names))}</title><style>{STYLE}</style></head><body>
<h1>mor-bench report</h1>
<p class="quiet">Speed against error of model-order-reduction methods, on the same snapshots and the same machine.</p>
{headlines or "<p>There is nothing to report: no dataset was run.</p>"}
{sections}
{f"<h2>All datasets together</h2>{shared}" if shared else ""}
<h2>Machine</h2><dl>{"".join(_definition(key, value) for key, value in _flat(comparison.machine))}</dl>
<h2>How the numbers are defined</h2><dl class="words">{words}</dl>
<h2>Raw files</h2><p class="quiet">Beside this page:</p><dl>{raw}</dl>
</body></html>
"""
    path = comparison.out / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, page.encode())
    return path


def _flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Nested tables as rows such as ``("versions numpy", "2.4.6")``."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{prefix} {key}".strip())
    elif isinstance(value, list | tuple) and any(isinstance(item, dict) for item in value):
        for item in value:
            yield from _flat(item, prefix)
    else:
        yield prefix, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _definition(key: str, value: str) -> str:
    return f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>"


def _dataset_section(
    comparison: Comparison, dataset: str, drawn: Sequence[Drawn], analysis: Mapping[str, Any]
) -> str:
    entries, spec = entries_of(comparison, dataset, analysis), comparison.datasets.get(dataset, {})
    names = short_names_used(entries)
    targets = "".join(
        f"<h3>{title}</h3>{_target_table(comparison, dataset, kind, analysis)}"
        for kind, title in (
            ("time_at_error", "Time at error: median latency at a median relative L2 error"),
            ("error_at_time", "Error at time: median relative L2 error within a median latency"),
        )
    )
    note = f"In brackets and below: the best real configuration{', and the 95 % interval' if any(e.intervals for e in entries) else ''}. "
    note += f"{escape(names)}{'.' if names else ''}"
    return f"""<h2>{escape(dataset)}{f": {escape(str(spec['title']))}" if spec.get("title") else ""}</h2>
<h3>What was run</h3><dl>{"".join(_definition(key, value) for key, value in _what_was_run(comparison, dataset, entries))}</dl>
<h3>Configurations</h3><div class="wide">{_configuration_table(entries)}</div>
<p class="quiet">Green: meets the needs. Bold: on the Pareto front. Red: failed, skipped, or samples without a prediction. ~: timing not stable.
{escape(basis_of(dataset, analysis))}</p>
{_troubles(entries, notes_of(comparison, dataset, analysis))}
{targets}<p class="quiet">{note}</p>
{"".join(map(_figure, drawn)) or "<p>There are no figures: no configuration gave samples to draw.</p>"}
{"".join(map(_grid, dataset_details(comparison, dataset, analysis)))}"""


def _what_was_run(
    comparison: Comparison, dataset: str, entries: Sequence[Entry]
) -> list[tuple[str, str]]:
    spec, needs = comparison.datasets.get(dataset, {}), needs_of(comparison, dataset)
    scene = [
        (key, "; ".join(f"{k}: {v}" if k else v for k, v in _flat(spec[key])))
        for key in ("geometry", "material", "supports", "loads", "snapshots")
        if key in spec
    ]

    def values(name: str) -> str:
        return ", ".join(dict.fromkeys(str(entry.row.get(name)) for entry in entries)) or "–"

    unused = (
        f"; in neither part: {values('n_unused')}"
        if any(entry.row.get("n_unused") for entry in entries)
        else ""
    )
    return [
        *([("source", str(spec["source"]))] if spec.get("source") else []),
        *scene,
        (
            "split",
            f"by {values('split')}; training samples: {values('n_train')}; test samples: {values('n_test')}{unused}",
        ),
        (
            "needs",
            f"median relative L2 error ≤ {percent(needs['error'])} %, median latency ≤ {number(needs['latency_ms'])} ms",
        ),
        ("discretisation error of the scene itself", discretisation_error(entries)),
        ("threads", values("threads")),
        (
            "configurations",
            f"{len(entries)}, of which {sum(e.ran for e in entries)} ran, {sum(e.row['status'] == 'failed' for e in entries)} failed, "
            f"{sum(e.row['status'] == 'skipped' for e in entries)} were skipped",
        ),
    ]


def _cell(group: str, name: str, key: str, entry: Entry) -> str:
    if name == SURE:
        return interval_cells(entry)[key]
    if (group, key) == ("latency (ms)", "median") and entry.unstable:
        return number(entry.latency_ms) + "~"
    if group.startswith("latency"):
        return number(entry.figure("latency_ms", key))
    if group.startswith("offline"):
        return number(entry.figure("offline_s", key))
    value = entry.figure("error", key)
    return percent(value) if group.startswith("relative") else metres(value)


def _count(value: object) -> str:
    return "–" if value is None else str(value)


def _configuration_table(entries: Sequence[Entry]) -> str:
    sure = any(entry.intervals for entry in entries)
    groups = [
        (group, [column for column in columns if sure or column[0] != SURE])
        for group, columns in GROUPS
    ]
    over = "".join(
        f'<th class="group" colspan="{len(columns)}">{escape(group)}</th>'
        for group, columns in groups
    )
    under = "".join(f"<th>{escape(name)}</th>" for _, columns in groups for name, _ in columns)
    plain = (
        "size",
        "threads",
        "n train",
        "n test",
        "without<br>prediction",
        "discretisation<br>error (m)",
    )
    tail = "".join(f'<th rowspan="2">{name}</th>' for name in plain)
    body = []
    for entry in entries:
        row = entry.row
        cells = [
            escape(_cell(group, name, key, entry))
            for group, columns in groups
            for name, key in columns
        ]
        discretisation = row.get("discretisation_error_m")
        cells += [
            escape(size_of(row.get("model_bytes"))),
            *(escape(_count(row.get(key))) for key in ("threads", "n_train", "n_test", "n_failed")),
        ]
        cells.append("not measured" if discretisation is None else metres(float(discretisation)))
        kind = "meets" if entry.meets_needs else "bad" if entry.trouble else ""
        marks = f"<td>{'yes' if entry.meets_needs else 'no'}</td><td>{'*' if entry.on_front else ''}</td>"
        status = f'<td class="text">{escape(str(row["status"]))}</td>'
        body.append(
            f'<tr class="{kind}{" front" if entry.on_front else ""}"><td class="text">{escape(entry.label)}</td>{status}{marks}'
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + "</tr>"
        )
    first = "".join(
        f'<th rowspan="2" class="text">{name}</th>'
        for name in ("configuration", "status", "needs<br>met", "Pareto")
    )
    head = f"<thead><tr>{first}{over}{tail}</tr><tr>{under}</tr></thead>"
    return f'<table class="pinned">{head}<tbody>{"".join(body)}</tbody></table>'


def _troubles(entries: Sequence[Entry], notes: Sequence[str]) -> str:
    """Failed and skipped configurations, those with failed samples, each with its reason, what casts doubt, and all warnings."""
    said = [("bad", e.label, e.trouble) for e in entries if e.trouble]
    said += [("", label, doubt) for label, _, doubt in (note.partition(": ") for note in notes)]
    said += [("", label, f"warning: {warning}") for label, warning in warnings_of(entries)]
    rows = "".join(
        f'<tr class="{kind}"><td class="text">{escape(label)}</td><td class="reason">{escape(text)}</td></tr>'
        for kind, label, text in said
    )
    if not rows:
        return "<p>Every configuration ran without a warning and predicted every test sample.</p>"
    head = '<thead><tr><th class="text">configuration</th><th class="text">what happened</th></tr></thead>'
    return f'<h3>Failures, skips and warnings</h3><div class="wide"><table>{head}<tbody>{rows}</tbody></table></div>'


def _target_table(
    comparison: Comparison, dataset: str, kind: str, analysis: Mapping[str, Any]
) -> str:
    headings, rows = target_cells(comparison, dataset, kind, analysis)
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = []
    for method, cells in rows.items():
        lines = (cell.partition("\n") for cell in cells)
        tds = "".join(
            f"<td>{escape(first)}<br><small>{_lines(second)}</small></td>"
            for first, _, second in lines
        )
        body.append(f'<tr><td class="text">{escape(method)}</td>{tds}</tr>')
    return f'<div class="wide"><table><thead><tr><th class="text">method</th>{head}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'


def _lines(text: str) -> str:
    return escape(text).replace("\n", "<br>")


def _grid(grid: Grid) -> str:
    """A table with its title; further lines of a cell in small print, long texts folded."""
    kinds = [
        "text" if i == 0 or heading in OF_TEXT else "" for i, heading in enumerate(grid.headings)
    ]
    head = "".join(
        f'<th class="{kind}">{escape(heading)}</th>'
        for kind, heading in zip(kinds, grid.headings, strict=True)
    )
    body = []
    for row in grid.rows:
        cells = []
        for kind, cell in zip(kinds, row, strict=True):
            first, _, more = cell.partition("\n")
            cells.append(
                f'<td class="{"reason" if len(first) > 60 else kind}">{escape(first)}{f"<br><small>{_lines(more)}</small>" if more else ""}</td>'
            )
        body.append(f"<tr>{''.join(cells)}</tr>")
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    return f'<h3>{escape(grid.title)}</h3><div class="wide">{table}</div><p class="quiet">{escape(grid.note)}</p>\n'


def _figure(drawn: Drawn) -> str:
    data = base64.b64encode(drawn.path.read_bytes()).decode()
    alt = escape(f"{drawn.title}, {drawn.dataset}", quote=True)
    caption = f"<b>{escape(drawn.title)}.</b> {escape(drawn.caption)}"
    return f'<figure><img alt="{alt}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>\n'
