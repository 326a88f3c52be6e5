"""Pages made from the suite and the stored runs: a card per method, and the list of them.

A card shows the method file, the text of `cards/NAME.md` (equation, algorithm, cost, failures), the
class, and every stored measurement of the method with its curve.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
from sphinx.application import Sphinx

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_hex, to_rgb

from mor_bench.analysis.frontier import Point, median_error, median_latency_ms, non_dominated
from mor_bench.report.cards import Card, method_card
from mor_bench.report.method_styles import style_of
from mor_bench.report.number_format import number, percent, short_swept
from mor_bench.report.suite_overview import overview
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs import load_method_spec
from mor_bench.specs.suite_folder import list_suite

ROOT = Path(__file__).parents[2]


@cache
def stored_rows() -> dict[str, list[Row]]:
    """Return the measured rows of every stored run, by its folder in `reports/`."""
    runs = sorted(path.parent for path in (ROOT / "reports").rglob("results.json"))
    found = {}
    for run in runs:
        rows = Comparison.read(run).rows
        name = run.relative_to(ROOT / "reports").as_posix()
        found[name] = [row for row in rows if row.ok and row.error and row.latency_ms]
    return found


def measured(method: str) -> Iterator[tuple[str, Row]]:
    for run, rows in stored_rows().items():
        yield from ((run, row) for row in rows if row.method == method)


def picture(method: str, folder: Path) -> str | None:
    """Draw the method's curve over the grey points of all others.

    The stored run and dataset are those with most configurations of the method, and of these the
    one with most rows.
    """
    found: dict[tuple[str, str], list[Row]] = {}
    for run, rows in stored_rows().items():
        for row in rows:
            found.setdefault((run, row.dataset), []).append(row)
    own = {place: sum(r.method == method for r in rows) for place, rows in found.items()}
    if not any(own.values()):
        return None
    place = max(found, key=lambda name: (own[name], len(found[name])))
    points, dataset = found[place], place[1]
    figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
    others = [row for row in points if row.method != method]
    axes.plot(*_places(others), "o", color="#c8c8c8", ms=4, label="other methods")
    style = style_of(method)
    curves = curves_of([row for row in points if row.method == method])
    shades = np.linspace(0.0, 0.7, max(len(curves), 2))
    for number_of, ((name, rows), shade) in enumerate(zip(curves.items(), shades, strict=False)):
        marker = (style.marker, *MORE_MARKERS)[number_of % (1 + len(MORE_MARKERS))]
        look = {"color": blended(style.colour, shade), "marker": marker}
        label = f"{method}, {name}" if name else method
        front = front_of(rows)
        axes.plot(*_places(rows), ls="none", **look, label="_" if len(front) > 1 else label)
        if len(front) > 1:
            axes.plot(*_places(front), **look, label=label)
        for row in (front[0], front[-1]) if len(front) > 1 else ():
            where = next(zip(*_places([row]), strict=True))
            beside = (4, 4 - 13 * (number_of % 2))
            text = short_swept(varied_in(rows, row))
            axes.annotate(text, where, beside, textcoords="offset points", fontsize=7)
    axes.margins(x=0.1)
    axes.set(xscale="log", yscale="log", xlabel="latency of one query, median (ms)")
    axes.set(ylabel="relative L2 error, median (%)", title=f"{method} on {dataset}")
    axes.legend(frameon=False, fontsize=8)
    axes.grid(color="#e8e8e8")
    figure.savefig(folder / f"{method}.png", dpi=110)
    plt.close(figure)
    return f"{method}.png"


MORE_MARKERS = "ovD^sP"


def varied_in(rows: list[Row], row: Row) -> dict[str, Any]:
    """Return the swept values of a row that differ within its group."""
    return {k: v for k, v in row.swept.items() if any(other.swept.get(k) != v for other in rows)}


def is_size(value: object) -> bool:
    """Return whether a swept value is a number or a list of them, which trade speed for error."""
    return not isinstance(value, bool | str)


def curves_of(rows: list[Row]) -> dict[str, list[Row]]:
    """Group configurations by what is not a number; one curve each, by the name of the group."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        kind = {key: value for key, value in row.swept.items() if not is_size(value)}
        found.setdefault(", ".join(f"{key}={value}" for key, value in kind.items()), []).append(row)
    return found


def front_of(rows: list[Row]) -> list[Row]:
    """Return the rows that no other one of the group beats in latency and error, fastest first."""
    points = [Point(median_latency_ms(row), median_error(row), row.label) for row in rows]
    labels = {point.label: i for i, point in enumerate(non_dominated(points))}
    return sorted((row for row in rows if row.label in labels), key=lambda row: labels[row.label])


def blended(colour: str, share: float) -> str:
    """Return a colour mixed with a share of white."""
    return to_hex([(1 - share) * part + share for part in to_rgb(colour)])


LEAST_ERROR = 1e-6
"""Smaller errors, which are those of round-off, are drawn here."""


def _places(rows: list[Row]) -> tuple[list[float], list[float]]:
    return (
        [row.latency_ms.median for row in rows if row.latency_ms],
        [100 * max(row.error.rel_l2_median, LEAST_ERROR) for row in rows if row.error],
    )


def table(method: str) -> list[str]:
    rows = list(measured(method))
    if not rows:
        return ["No stored run measures this method yet."]
    headings = ["run", "dataset", "configuration", "median %", "p95 %", "max %", "ms"]
    lines = [f"| {' | '.join(headings)} |", f"|{'---|' * len(headings)}"]
    for run, row in rows:
        assert row.error
        assert row.latency_ms
        swept = ", ".join(f"{key}={value}" for key, value in row.swept.items()) or "–"
        e, ms = row.error, row.latency_ms.median
        errors = [percent(x) for x in (e.rel_l2_median, e.rel_l2_p95, e.rel_l2_max)]
        cells = [f"`{run}`", f"`{row.dataset}`", swept, *errors, number(ms)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def card_page(name: str, folder: Path, *, draw: bool = True) -> str:
    """Return the source of a method's page; its picture is drawn into the folder."""
    spec = load_method_spec(name)
    card = method_card(spec)
    lines = [f"# {name}", "", f"**{spec.title}**", ""]
    text = ROOT / "docs" / "cards" / f"{name}.md"
    if text.exists():
        lines += [f"```{{include}} ../cards/{name}.md", "```", ""]
        lines += [*_references(text.read_text(encoding="utf-8")), ""]
    lines += ["## Where it fails", "", " ".join(card.facts["limits"].split()), ""]
    lines += ["## In short", "", *facts_of(name, card), "", *_hyperparameters(card)]
    lines += ["## Measured", "", "Errors are those of the test samples of each stored run.", ""]
    if draw and (shown := picture(name, folder)):
        caption = f"Error over latency of {name}, with the other methods of the run in grey. "
        caption += "A line joins the configurations that none of their group beats in both; its "
        caption += "ends name their sizes. "
        caption += f"Errors below {100 * LEAST_ERROR:g} % are drawn there."
        lines += [f"![{caption}]({shown})", ""]
    lines += [*table(name), ""]
    target = spec.surrogate.replace(":", ".")
    module, _, cls = target.rpartition(".")
    # The pages of the source code link to this anchor.
    lines += ["## Class", "", f'<span id="{target}"></span>', "", "```{eval-rst}"]
    lines += [f".. currentmodule:: {module}", ""]
    lines += [f".. autoclass:: {cls}", "   :no-members:", "   :no-index:", "```", ""]
    lines += ["## Commands", "", "```bash", *card.commands, "```", ""]
    return "\n".join(lines)


ENTRY = re.compile(r"@\w+\{(?P<key>\w+),(?P<fields>.*)\}$", re.M)
FIELD = re.compile(r"\b(author|title|year|doi|url)=\{((?:[^{}]|\{[^{}]*\})*)\}")


@cache
def bibliography() -> dict[str, dict[str, str]]:
    """Return author, title, year, and doi or url of every cited work, by its key."""
    text = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
    return {entry["key"]: dict(FIELD.findall(entry["fields"])) for entry in ENTRY.finditer(text)}


def cited(card: str) -> list[str]:
    """Return the keys of the works that a card cites; one citation may have several."""
    groups = re.findall(r"\{cite\}`([^`]+)`", card)
    return list(dict.fromkeys(key.strip() for group in groups for key in group.split(",")))


def _references(card: str) -> Iterator[str]:
    """List the works that a card cites, each with a link."""
    for key in cited(card):
        work = bibliography()[key]
        address = f"https://doi.org/{work['doi']}" if "doi" in work else work.get("url")
        if address:
            yield f"- {key}: <{address}>"


def measured_fit(method: str, dataset: str = "beam-coarse") -> str | None:
    """Return the cost of the method's fits in stored runs; None if no run measured it."""
    found = [
        (row.offline_s.fit_core_s, run)
        for run, row in measured(method)
        if row.dataset == dataset and row.offline_s and row.offline_s.fit_core_s
    ]
    if not found:
        return None
    ends = [f"{number(end(found)[0])}" for end in (min, max)]
    runs = ", ".join(f"`{run}`" for run in dict.fromkeys(run for _, run in found))
    return f"{' to '.join(dict.fromkeys(ends))} core-seconds on {dataset}, measured in {runs}"


def facts_of(method: str, card: Card) -> Iterator[str]:
    facts = {name: text for name, text in card.facts.items() if name != "limits"}
    if fit := measured_fit(method):
        # Two trainings: the stored runs measured that of the profile quick only.
        _, both, rest = facts.get("cost of a fit", "").partition(" with the profile quick;")
        facts["cost of a fit"] = fit + both + rest
    for fact, value in facts.items():
        yield f"{fact}\n: {' '.join(value.split())}\n"


def _hyperparameters(card: Card) -> Iterator[str]:
    if card.hyperparameters:
        yield "| hyperparameter | in `mor-bench run` | allowed |\n|---|---|---|"
        for row in card.hyperparameters:
            cells = " | ".join(cell.replace("|", "\\|") or "–" for cell in row)
            yield f"| {cells} |"
        yield ""


def index_page() -> str:
    """Return the source of the list of all methods."""
    lines = [
        "# Method cards",
        "",
        "Every method of the suite: its equation, its algorithm, its cost, where it fails, and its",
        "measured curve. {doc}`Which method? <../which-method>` helps to choose.",
        "",
    ]
    items = overview()["methods"]
    by_family: dict[str, list[Any]] = {}
    for item in items:
        by_family.setdefault(item.family, []).append(item)
    for family, members in by_family.items():
        lines += [f"## {family.capitalize()}", "", "| method | title | needs |", "|---|---|---|"]
        lines += [f"| [{m.name}]({m.name}.md) | {m.title} | {m.needs} |" for m in members]
        lines += [""]
    lines += ["```{toctree}", ":hidden:", "", *(item.name for item in items), "```", ""]
    return "\n".join(lines)


def make_pages(app: Sphinx) -> None:
    """Write all pages before Sphinx reads its sources; unchanged ones keep their time."""
    folder = Path(app.srcdir) / "methods"
    folder.mkdir(exist_ok=True)
    names = list(list_suite("methods", ROOT))
    for name in names:
        _write(folder / f"{name}.md", card_page(name, folder))
    _write(folder / "index.md", index_page())
    for path in folder.iterdir():
        if path.stem not in {*names, "index", "orders-of-convergence"}:
            path.unlink()


def _write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", make_pages)
    return {"parallel_read_safe": True}
