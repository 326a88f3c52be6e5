"""Tables in Markdown of stored runs. A table takes the run's folder and options of its block."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf, isfinite, isnan
from typing import Any

from mor_bench.analysis.break_even import FULL_ORDER, break_even
from mor_bench.analysis.frontier import median_error, median_latency_ms, number_or_inf
from mor_bench.analysis.told import class_text, given_by
from mor_bench.analysis.verdict import CHANCE_S
from mor_bench.report.entries import entries_of
from mor_bench.report.number_format import DASH, number, percent, short_swept
from mor_bench.report.paper_tables import against_the_paper
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import ErrorSummary
from mor_bench.results.row import Row
from tests.published.stored import EvidenceError, run_of

LEVELS = (0.03, 0.01, 0.003, 0.001)
"""Median relative l2 errors of the columns of `fastest`."""


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines).replace("e-0", "e-")


def _metres(value: float) -> str:
    return f"{value:.1e}" if isfinite(value) else "∞"


def _mean_error(error: ErrorSummary) -> str:
    """Return e over all degrees of freedom, and over the free ones in brackets if it is known."""
    free = error.mean_free_dof_m
    return _metres(error.mean_dof_m) + ("" if isnan(free) else f" ({_metres(free)})")


def _percent(value: float) -> str:
    return percent(value) if isfinite(value) else "∞"


def rows_of(run: Comparison, dataset: str, methods: str) -> list[Row]:
    """Return the rows that ran, of one dataset and of the named methods in this order."""
    name = dataset or next(iter(run.datasets))
    rows = [row for row in run.rows if row.ok and row.dataset == name]
    if not rows:
        raise EvidenceError(f"{run.out}: no configuration ran on {name}.")
    wanted = methods.split(",") if methods else list(dict.fromkeys(row.method for row in rows))
    return [row for method in wanted for row in rows if row.method == method]


def _by_method(rows: Iterable[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.method, []).append(row)
    return found


def chosen(rows: Sequence[Row], bounds: Mapping[str, float]) -> Row:
    """Return the most accurate configuration, by the error that the verdict uses."""
    return min(rows, key=lambda row: (bounds[row.label], row.label))


def _configuration(row: Row) -> str:
    return short_swept(row.swept) or DASH


def _figure(run: Comparison, row: Row, name: str) -> tuple[float | None, float | None]:
    """Return the 95 % interval of a figure of a configuration."""
    for record in (run.analysis or {})["rows"]:
        if (record["dataset"], record["label"]) == (row.dataset, row.label):
            return record[name]["low"], record[name]["high"]
    return None, None


def _with_interval(value: float, ends: tuple[float | None, float | None], scale: float) -> str:
    text = number(scale * value) if isfinite(value) else "∞"
    low, high = (None if end is None else scale * end for end in ends)
    if low is None or value == 0:
        return text
    return f"{text} ({number(low)}–{'∞' if high is None else number(high)})"


def _error(run: Comparison, row: Row) -> str:
    return _with_interval(median_error(row), _figure(run, row, "rel_l2_median"), 100.0)


ERRORS_SHOWN = ("e (free dofs), m", "median %", "p95 %", "max %")


def _errors(run: Comparison, row: Row) -> list[str]:
    """Return the cells of `ERRORS_SHOWN`."""
    error = row.error or ErrorSummary()
    ends = (_percent(error.rel_l2_p95), _percent(error.rel_l2_max))
    return [_mean_error(error), _error(run, row), *ends]


def _latency(run: Comparison, row: Row) -> str:
    if row.latency_ms is None:
        return DASH
    text = _with_interval(median_latency_ms(row), _figure(run, row, "latency_ms"), 1.0)
    return text + (" *" if row.latency_ms.stable is False else "")


def _offline(row: Row) -> str:
    if row.offline_s is None:
        return DASH
    found = row.trained_elsewhere
    origin = f" (trained elsewhere, {found.iterations:,} iterations)" if found else ""
    return f"{number(row.offline_s.data)} + {_core_s(row.offline_s.fit_core_s)}{origin}"


def _core_s(seconds: float | None) -> str:
    """Return the cost of a fit; repeated fits of less than a second differ by factors."""
    return number(seconds) if seconds is None or seconds >= CHANCE_S else f"< {CHANCE_S:g}"


def _queries(run: Comparison, row: Row, need: float) -> str:
    """Return the break-even number of queries of a row against `fem` at its error."""
    if row.method == FULL_ORDER:
        return DASH
    rows = [other for other in run.rows if other.dataset == row.dataset]
    record = {"dataset": row.dataset, "method": row.method, "target_rel_l2_median": need}
    bounds = error_bounds(run, row.dataset)
    best = {"label": row.label, "latency_ms": median_latency_ms(row)}
    record["best"] = best if bounds[row.label] <= need else None
    (found,) = break_even(rows, [record], bounds)
    return f"{found['queries']:,}" if found["queries"] is not None else str(found["verdict"])


def error_bounds(run: Comparison, dataset: str) -> dict[str, float]:
    """Return, by label, the error that selects each configuration that ran on a dataset."""
    stored = [r for r in (run.analysis or {})["rows"] if r["dataset"] == dataset]
    return {r["label"]: number_or_inf(r["error_bound"]) for r in stored}


def sufficient(rows: Sequence[Row], bounds: Mapping[str, float], limit: float) -> Row | None:
    """Return the fastest row whose error meets a limit by the rule of the verdict."""
    within = [row for row in rows if bounds[row.label] <= limit]
    return min(within, key=median_latency_ms, default=None)


def selected(source: str, dataset: str = "", methods: str = "", by: str = "need") -> str:
    """Show the configuration of each method that validation selects, scored on the test.

    By "need", it is the fastest that meets the dataset's required error by the rule of the verdict,
    or the most accurate if none does. By "error", it is the most accurate.
    """
    run = run_of(source)
    name = dataset or next(iter(run.datasets))
    need = float((run.datasets[name].get("needs") or {}).get("error", 0.01))
    bounds = error_bounds(run, name)
    rows = [
        (sufficient(own, bounds, need) if by == "need" else None) or chosen(own, bounds)
        for own in _by_method(rows_of(run, dataset, methods)).values()
    ]
    headings = ["method", "is given", "selected", *ERRORS_SHOWN, "fresh test: median %", "ms"]
    headings += ["data + fit, core-s", "break-even without tuning, queries"]
    return markdown(
        headings,
        [
            [
                f"`{row.method}`",
                class_text(row, given_by(run, name)),
                _configuration(row),
                *_errors(run, row),
                _percent(row.hidden.rel_l2_median) if row.hidden else DASH,
                _latency(run, row),
                _offline(row),
                _queries(run, row, need),
            ]
            for row in rows
        ],
    )


def best_of_class(source: str, dataset: str = "") -> str:
    """Show the fastest configuration that meets the need, by what is given; the verdict's rule."""
    run = run_of(source)
    name = dataset or next(iter(run.datasets))
    need = float((run.datasets[name].get("needs") or {}).get("error", 0.01))
    bounds, by_class = error_bounds(run, name), dict[str, list[Row]]()
    for row in rows_of(run, name, ""):
        by_class.setdefault(class_text(row, given_by(run, name)), []).append(row)
    body = []
    for told, rows in by_class.items():
        best = sufficient(rows, bounds, need)
        cells = (
            [f"`{best.method}`", _configuration(best), _error(run, best), _latency(run, best)]
            if best
            else ["none meets the need", *[DASH] * 3]
        )
        body.append([told, *cells])
    return markdown(["is given", "method", "configuration", "median %", "ms"], body)


def fastest(source: str, dataset: str = "", methods: str = "") -> str:
    """Show the latency of the fastest configuration below each error, method by method.

    The rule of the verdict decides. A dagger marks a larger error on the test samples.
    """
    run = run_of(source)
    name = dataset or next(iter(run.datasets))
    headings = ["method", "is given", *(f"≤ {number(100 * level)} %" for level in LEVELS)]
    body, bounds = [], error_bounds(run, name)
    for method, rows in _by_method(rows_of(run, dataset, methods)).items():
        fastest_of = [sufficient(rows, bounds, level) for level in LEVELS]
        cells = []
        for level, best in zip(LEVELS, fastest_of, strict=True):
            missed = best is not None and median_error(best) > level
            cells.append((DASH if best is None else _latency(run, best)) + " †" * missed)
        least = chosen(rows, bounds)
        largest = least.error.rel_l2_max if least.error else inf
        cells.append(f"{_error(run, least)}; {_percent(largest)}")
        shown = [row for row in (*fastest_of, least) if row is not None]
        told = dict.fromkeys(class_text(row, given_by(run, name)) for row in shown)
        body.append([f"`{method}`", "; or ".join(told), *cells])
    return markdown([*headings, "smallest median %; its max %"], body)


def named_sets(source: str, dataset: str = "", methods: str = "") -> str:
    """Show errors on the named test sets: of each method the configuration for the least error."""
    run = run_of(source)
    name = dataset or next(iter(run.datasets))
    bounds = error_bounds(run, name)
    rows = [chosen(mine, bounds) for mine in _by_method(rows_of(run, dataset, methods)).values()]
    names = list(dict.fromkeys(each for row in rows for each in row.sets))
    body = []
    for row in rows:
        found = [row.error, *(row.sets.get(each) for each in names)]
        cells = [
            DASH if each is None else f"{_percent(each.rel_l2_median)}; {_percent(each.rel_l2_max)}"
            for each in found
        ]
        told = class_text(row, given_by(run, name))
        body.append([f"`{row.method}`", told, _configuration(row), *cells])
    sets = ["split's test part", *(f"`{each}`" for each in names)]
    return markdown(["method", "is given", "configuration", *sets], body)


def covered(source: str) -> str:
    """Show bounds of single errors and their coverage of test sets; SOURCE is FOLDER,FOLDER,….

    Each method has its configuration for the least error, from the first run that has the method.
    The full-order model is left out.
    """
    found: dict[tuple[str, str], tuple[Row, str]] = {}
    for run in map(run_of, source.split(",")):
        for name in run.datasets:
            bounds, given = error_bounds(run, name), given_by(run, name)
            for method, mine in _by_method(rows_of(run, name, "")).items():
                row = chosen(mine, bounds)
                found.setdefault((name, method), (row, class_text(row, given)))
    names = list(
        dict.fromkeys(s for row, _ in found.values() if row.bound for s in row.bound.coverage)
    )
    body = []
    for (dataset, method), (row, told) in sorted(found.items(), key=lambda item: item[0][0]):
        if row.bound is None or row.reference:
            continue
        size, shares = row.bound.relative_l2, row.bound.coverage
        cells = [f"`{dataset}`", f"`{method}`", told, f"{row.bound.n_groups}", _percent(size)]
        cells += [number(size / median_error(row)) if isfinite(size) else DASH]
        body.append([*cells, *(_percent(shares[s]) if s in shares else DASH for s in names)])
        if scaled := row.bound.scaled:
            cells = [f"`{dataset}`", f"`{method}` × spread", told, cells[3], "of each load"]
            cells.append(number(scaled.widths["test"] / median_error(row)))
            shown = (
                f"{_percent(scaled.coverage[s])} ({_percent(scaled.widths[s])})"
                if s in scaled.widths
                else DASH
                for s in names
            )
            body.append([*cells, *shown])
    sets = ["split's test part" if name == "test" else f"`{name}`" for name in names]
    headings = ["dataset", "method", "is given", "regions", "bound", "bound / median", *sets]
    return markdown(headings, body)


def verdict(source: str, dataset: str = "") -> str:
    """State the verdict on a dataset in the words of the report."""
    run = run_of(source)
    name = dataset or next(iter(run.datasets))
    (found,) = [v for v in (run.analysis or {})["verdicts"] if v["dataset"] == name]
    beside = [line for line in found["beside"] if not line.startswith("Evidence:")]
    beside = [line.partition(" Time again:")[0] for line in beside]
    return "\n".join([found["headline"], *(f"- {line}" for line in beside)])


def headline(source: str, dataset: str = "") -> str:
    """State only the first sentences of the verdict: the needs, the winner and its errors."""
    return verdict(source, dataset).partition("\n")[0]


def indicated(source: str, methods: str = "") -> str:
    """Show how well errors are estimated without the reference; SOURCE is FOLDER,FOLDER,…."""
    runs = [run_of(folder) for folder in source.split(",")]
    names = [next(iter(run.datasets)) for run in runs]
    columns = []
    for run, name in zip(runs, names, strict=True):
        bounds, mine = error_bounds(run, name), _by_method(rows_of(run, "", methods))
        columns.append({method: chosen(own, bounds) for method, own in mine.items()})
    body = []
    for method in columns[0]:
        cells = [f"`{method}`", class_text(columns[0][method], given_by(runs[0], names[0]))]
        for column in columns:
            found = column[method].indicator if method in column else None
            if found is None:
                cells.append(DASH)
                continue
            ratios = ", ".join(
                f"{x:.2f}" for x in (found.ratio_p5, found.ratio_median, found.ratio_p95)
            )
            plain = f"{found.residual_rank_correlation:.2f}".replace("-", "−")
            cells.append(f"{ratios}; {found.rank_correlation:.3f} ({plain})")
        body.append(cells)
    return markdown(["method", "is given", *names], body)


def paper(source: str, methods: str = "") -> str:
    """Show our networks beside the paper's by slope and relative error; SOURCE is FOLDER,….

    The slope is that of the error e over the largest displacement of a sample.
    """
    headings: Sequence[str] = ()
    body = []
    runs = [run_of(folder) for folder in source.split(",")]
    for run, name in ((each, name) for each in runs for name in each.datasets):
        entries = [
            e
            for e in entries_of(run, name, run.analysis)
            if not methods or e.method in methods.split(",")
        ]
        table = against_the_paper(name, entries)
        if table is None:
            raise EvidenceError(f"{source}: {name} is no scene of the paper, or nothing ran.")
        headings = table.headings
        told = {e.label: class_text(e.row, given_by(run, name)) for e in entries}
        lasted = {e.label: _training(e.row) for e in entries}
        body += [
            [name, first, told.get(first, "force only"), *lasted.get(first, PAPER_TRAINING), *rest]
            for first, *rest in table.rows
        ]
    shown = ["scene", headings[0], "is given", "iterations", "trained, s", *headings[1:]]
    return markdown(shown, body)


PAPER_TRAINING = ("100,000", DASH)
"""Iterations of each network of the paper, as it states them, and the seconds."""


def _training(row: Row) -> tuple[str, str]:
    """Return the iterations and the seconds of a training; dashes for a method without one."""
    if row.training is None:
        return DASH, DASH
    fit_s = row.offline_s.fit if row.offline_s else None
    return f"{row.training.iterations:,}", DASH if fit_s is None else f"{fit_s:.0f}"


def facts(source: str, dataset: str = "") -> str:
    """State the settings of a run in one line: machine, samples, commit of the code."""
    run = run_of(source)
    rows = rows_of(run, dataset, "")
    needs: dict[str, Any] = run.datasets[rows[0].dataset].get("needs") or {}
    validation = rows[0].n_validation
    held = f", {validation:,} for validation" if validation else ""
    return (
        f"{rows[0].dataset}, split by {rows[0].split}: {rows[0].n_train:,} training samples"
        f"{held} and {rows[0].n_test:,} test samples, {rows[0].n_dofs:,} degrees of freedom. "
        f"Required: {number(100 * float(needs.get('error', inf)))} % and "
        f"{number(float(needs.get('latency_ms', inf)))} ms."
    )


RUN_TABLES: dict[str, Callable[..., str]] = {
    "selected": selected,
    "best-of-class": best_of_class,
    "fastest": fastest,
    "named-sets": named_sets,
    "covered": covered,
    "verdict": verdict,
    "headline": headline,
    "indicated": indicated,
    "paper": paper,
    "facts": facts,
}
