"""The report as one HTML page that needs no other file, and a folder of pages of the same parts."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.told import FORCE, LEGEND, classes_of, given_by, told_text
from mor_bench.hard_cases.suite import StressResults
from mor_bench.report.canvas import Drawn
from mor_bench.report.details import overall
from mor_bench.report.entries import Analysis, dataset_names
from mor_bench.report.figures import write_figures
from mor_bench.report.hard_case_table import stress_table
from mor_bench.report.method_view import method_view
from mor_bench.report.number_format import unbroken, whole
from mor_bench.report.page_facts import AGAIN, machine_facts, method_facts
from mor_bench.report.page_index import standings
from mor_bench.report.page_scripts import Assets, beside, embedded_json, inlined
from mor_bench.report.page_sections import Section, View, section_of
from mor_bench.report.page_tables import in_python, with_content
from mor_bench.report.short_names import short_names
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically

PAGES = "pages"
"""Folder of the index and of the pages of single datasets and methods."""

STRESS = "stress.json"
"""Name of a file of `mor-bench stress --out` that the report shows."""

MOST_BYTES = 6_000_000
"""Size of a page from which on its sections are brief, and link to the datasets' own pages."""

BODY_BYTES = 1_800_000
"""Room for the bodies of all datasets, in letters of the page; on a method's page a quarter."""


@dataclass(frozen=True)
class Frame:
    """What surrounds the sections of a page.

    Attributes
    ----------
    heading : str
    links : sequence of (str, str)
        Address and text of each link to another page.
    root : str
        Path from the page to the folder of the run.
    assets : Assets
    stressed : StressResults or None
        Results of the hard cases.
    facts : sequence of (str, str)
        What a method's file says of it.
    """

    heading: str
    links: Sequence[tuple[str, str]]
    root: str
    assets: Assets
    stressed: StressResults | None = None
    facts: Sequence[tuple[str, str]] = ()


def render(
    comparison: Comparison, analysis: Analysis | None = None, *, pages: bool = False
) -> list[Path]:
    """Write all figures and the page; `analyse` makes the analysis if it is not given.

    With several datasets, if `pages` asks for it, or if it exists, also write OUT/pages/: an index,
    and a page per dataset and per method.

    Returns
    -------
    list of Path
        The figures, the pages, and OUT/report.html last.
    """
    analysis = analysis or analyse(comparison)
    drawn = write_figures(comparison, analysis)
    return [
        *(figure.path for figure in drawn),
        *write_page(comparison, analysis, drawn, pages=pages),
    ]


def write_page(
    comparison: Comparison,
    analysis: Analysis,
    drawn: Sequence[Drawn] = (),
    *,
    pages: bool = False,
) -> list[Path]:
    """Write the page, and those in OUT/pages/ as `render` does; `drawn` are the figures on disk.

    Returns
    -------
    list of Path
        The pages, OUT/report.html last.
    """
    datasets = dataset_names(comparison)
    named = {
        name: short_names(row for row in comparison.rows if row.dataset == name)
        for name in datasets
    }
    room = BODY_BYTES // max(len(datasets), 1)
    view = View(comparison, analysis, drawn, named, room)
    frame = Frame("mor-bench report", [], "", inlined(), _stressed(comparison))
    written: list[Path] = []
    if pages or len(datasets) > 1 or (comparison.out / PAGES).is_dir():  # never leave old ones
        written += _write_pages(view, frame)
        files = _files("dataset", datasets)
        view = replace(view, pages={name: f"{PAGES}/{file}" for name, file in files.items()})
        frame = replace(frame, links=[(f"{PAGES}/index.html", "A page per dataset and method")])
    path = comparison.out / "report.html"
    _write(path, view, frame)
    return [*written, path]


def _stressed(comparison: Comparison) -> StressResults | None:
    try:
        return StressResults.read(comparison.out / STRESS)
    except FileNotFoundError:
        return None


def _write_pages(view: View, frame: Frame) -> list[Path]:
    """Write an index, and a page per dataset and method, with one copy of the scripts."""
    comparison, folder = view.comparison, view.comparison.out / PAGES
    methods = list(dict.fromkeys(row.method for row in comparison.rows))
    files = {
        "dataset": _files("dataset", dataset_names(comparison)),
        "method": _files("method", methods),
    }
    links = [("index.html", "All pages"), ("../report.html", "Everything on one page")]
    frame = replace(frame, root="../", assets=beside(folder / "shared"))
    written = []
    for name, file in files["dataset"].items():
        rows = [row for row in comparison.rows if row.dataset == name]
        part = replace(comparison, rows=rows, datasets={name: comparison.datasets.get(name, {})})
        mine = [files["method"][row.method] for row in rows]
        more = [(file, text) for text, file in files["method"].items() if file in mine]
        about = replace(frame, heading=f"Dataset {name}", links=[*links, *more])
        written.append(_write(folder / file, replace(view, comparison=part), about))
    for name, file in files["method"].items():
        part, analysis = method_view(comparison, view.analysis, name)
        room = view.body_bytes // 4
        about = replace(
            frame,
            heading=f"Method {name}",
            links=[
                *links,
                *((files["dataset"][d], d) for d in dataset_names(part)),
            ],
            facts=method_facts(comparison, name),
        )
        shown = replace(
            view,
            comparison=part,
            analysis=analysis,
            body_bytes=room,
            method=name,
            pages=files["dataset"],
        )
        written.append(_write(folder / file, shown, about))
    index = (
        _environment()
        .get_template("index.html.j2")
        .render(
            frame=replace(frame, heading="mor-bench: datasets and methods", links=links[1:]),
            standings=standings(view, files),
        )
    )
    write_atomically(folder / "index.html", index.encode())
    return [*written, folder / "index.html"]


def _files(kind: str, names: Iterable[str]) -> dict[str, str]:
    """Give each name a file name of its own, also on disks that ignore case."""
    files: dict[str, str] = {}
    for name in names:
        stem = f"{kind}-" + re.sub(r"[^a-zA-Z0-9_.=-]+", "-", name)[:100]
        while f"{stem}.html".lower() in map(str.lower, files.values()):
            stem += "-2"
        files[name] = f"{stem}.html"
    return files


def _write(path: Path, view: View, frame: Frame) -> Path:
    """Write a page with a section per dataset, brief ones if it would become too large."""
    names = dataset_names(view.comparison)
    sections = [section_of(view, name) for name in names]
    page = _page(view, frame, sections)
    if len(names) > 1 and view.pages and len(page.encode()) > MOST_BYTES:
        page = _page(view, frame, [section.brief(view.pages[section.name]) for section in sections])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, page.encode())
    return path


def _page(view: View, frame: Frame, sections: Sequence[Section]) -> str:
    comparison, names = view.comparison, [section.name for section in sections]
    inputs = {given_by(comparison, name) for name in names}
    given = inputs.pop() if len(inputs) == 1 else FORCE
    methods = [view.method] if view.method else [row.method for row in comparison.rows]
    hard = stress_table(frame.stressed, list(dict.fromkeys(methods))) if frame.stressed else None
    return (
        _environment()
        .get_template("page.html.j2")
        .render(
            frame=frame,
            sections=sections,
            hard=with_content([hard] if hard else []),
            overall=[] if view.method else with_content(overall(view.analysis)),
            machine=machine_facts(comparison.machine),
            n_resamples=whole(view.analysis["settings"]["n_resamples"]),
            told={told or "": told_text(told, given) for told in classes_of(comparison.rows)},
            legend=LEGEND,
            AGAIN=AGAIN,
            data=embedded_json([section.data for section in sections]),
        )
    )


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("mor_bench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_joined,
    )
    environment.filters |= {
        "data_uri": _data_uri,
        "code": _code,
        "slug": _slug,
        "in_python": in_python,
    }
    return environment


def _data_uri(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _joined(value: Any) -> Any:
    """Keep numbers beside their units in every text of a template."""
    return unbroken(value) if type(value) is str else value


def _code(text: str) -> Markup:
    """Show what stands between backticks as code; no line breaks at a hyphen in it."""

    def shown(found: re.Match[str]) -> str:
        words = re.sub(r"(\S*-\S*)", r'<span class="whole">\1</span>', found[1])
        return f"<code>{words}</code>"

    return Markup(re.sub("`([^`]*)`", shown, str(escape(unbroken(text)))))


def _slug(text: str) -> str:
    """Return the part of an address for a title."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
