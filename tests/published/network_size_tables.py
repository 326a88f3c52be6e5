"""Tables in Markdown about the size and the training of U-Mesh."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import exp
from typing import Any

from mor_bench.report.number_format import number
from mor_bench.report.published_figures import PUBLISHED, Published
from tests.benchmarks.umesh_scaling import BATCH, HELD_OUT, Law, fit_law
from tests.published.run_tables import markdown
from tests.published.stored import content_of
from tests.published.training_curve_tables import FLATNESS, flatness

PARTS = ("forward", "backward", "optimiser")

Rows = list[dict[str, Any]]

ENDS = ("median", "p95", "max")

SIZES = {
    "umesh": ("channels", "steps"),
    "mesh-graph-net": ("width", "steps"),
    "graph-u-net": ("width", "levels", "steps"),
    "transolver": ("width", "layers", "heads", "slices"),
}
"""Parameters that set the size of a network, by method."""

N_LAST = 5
"""Points at the end of a loss curve, of 100 to 200, whose mean is its loss at the end."""

MEASURED = {"dataset": "beam-coarse-paper", "channels": 128, "steps": 3}
"""The training in the paper's size beside which the scaling laws stand."""


def network_sizes(source: str) -> str:
    """Show e of test samples by size of the network and number of iterations.

    SOURCE is FILE,FILE,…. A training is flat by the rule of the learning curves, on validation
    samples.
    """
    rows = _small(_rows_of(source))
    numbers = sorted({row["iterations"] for row in rows})
    body = []
    for size in dict.fromkeys((row["channels"], row["steps"]) for row in rows):
        mine = {r["iterations"]: r for r in rows if (r["channels"], r["steps"]) == size}
        cells = [_metres(mine[n]["test"]["mean_dof_m"]) if n in mine else "–" for n in numbers]
        last = mine[max(mine)]
        most = max(n for n in mine if "core_s" in mine[n])
        errors = [mine[n]["validation"]["mean_dof_m"] for n in sorted(mine)]
        relative = number(100 * last["test"]["rel_l2_median"])
        body.append(
            [
                f"{size[0]}, {size[1]}",
                *cells,
                relative,
                f"{number(mine[most]['core_s'])} ({most:,})",
                *flatness(errors),
            ]
        )
    headings = ["channels, steps", *(f"{n:,} iterations" for n in numbers)]
    headings += ["median % of the last", "core-s on a processor (iterations)"]
    return markdown([*headings, *FLATNESS], body)


def network_size_law(source: str) -> str:
    """Show three scaling laws, how well they extrapolate, and what they say of the paper's size.

    SOURCE is FILE,FILE,…: small networks, and some in the paper's size, whose batches differ, so
    they count by their number of samples.
    """
    every = _rows_of(source)
    rows = _small(every)
    held_out = [row for row in rows if HELD_OUT.items() <= row.items()]
    others = [row for row in rows if row not in held_out]
    large = [row for row in every if MEASURED.items() <= row.items()]
    sizes = [
        {**MEASURED, "iterations": round(r["iterations"] * r["batch_size"] / BATCH)} for r in large
    ]
    columns = [_law_cells(rows, others, held_out, sizes, n_floor) for n_floor in range(3)]
    names = ["exponent of the channels", "exponent of the iterations", "factor of a further step"]
    names += ["floor, m", "exponent of the channels in the floor"]
    names += ["standard deviation of log e", "AICc (less is better)"]
    for row in held_out:
        name = f"e at {row['channels']} channels, {row['iterations']:,} iterations, m"
        names.append(f"{name}, from the other sizes; measured {_metres(row['test']['mean_dof_m'])}")
    for row, size in zip(large, sizes, strict=True):
        name = f"e at {size['channels']} channels, {size['steps']} steps, {size['iterations']:,} "
        measured = _metres(row["test"]["mean_dof_m"])
        names.append(f"{name}iterations, m, extrapolated; measured {measured}")
    names += ["the last but one with 4 channels, too", "the last with 4 channels, too"]
    body = [list(cells) for cells in zip(names, *columns, strict=True)]
    return markdown(["", "power law", "above a floor", "above a power of the channels"], body)


def paper_size(source: str) -> str:
    """Show the errors of the paper's networks, trained here, beside those of the paper.

    SOURCE is FILE,FILE,….
    """
    body = []
    for row in _rows_of(source):
        if row.get("method", "umesh") != "umesh":
            continue
        test, paper = row["test"], _published(row)
        body.append(
            [
                row["dataset"],
                f"{row['channels']}, {row['steps']}",
                f"{row['iterations']:,}",
                f"{row['n_train']:,}",
                number(row["fit_s"]),
                _beside(test["mean_dof_m"], paper.mean_m),
                _beside(test["std_dof_m"], paper.std_m),
                _beside(test["max_dof_m"], paper.max_m),
                _beside(test["slope"], paper.slope),
                " / ".join(number(100 * test[f"rel_l2_{name}"]) for name in ENDS),
                number(100 * test["tip_rel_at_largest"]),
            ]
        )
    headings = ["dataset", "c, k", "iterations", "training samples", "trained, s"]
    headings += [f"{name}: ours / paper's" for name in ("ē, m", "σ(e), m", "largest e, m", "slope")]
    headings += ["relative L2 error, %: median / p95 / max", "tip at largest u, %"]
    return markdown(headings, body)


def paper_size_latency(source: str) -> str:
    """Show the times of single queries of the paper's networks on a graphics processor.

    SOURCE is FILE,FILE,….
    """
    body = []
    for row in _rows_of(source):
        times = [row["latency_ms"][name] for name in ("predict", "replayed", "launched")]
        cells = [f"{number(found['median'])}; {number(found['p95'])}" for found in times]
        published = number(_published(row).predict_ms)
        body.append([row["dataset"], f"{row['n_weights']:,}", *cells, published])
    headings = ["dataset", "weights", "whole query, ms", "network, replayed, ms"]
    return markdown([*headings, "network, launched by PyTorch, ms", "paper's query, ms"], body)


def recipes(source: str) -> str:
    """Show the errors and the loss of trainings that differ by precision and learning rate."""
    body = [
        [
            row["precision"],
            number(row["learning_rate"]),
            f"{row['iterations']:,}",
            _metres(row["test"]["mean_dof_m"]),
            " / ".join(number(100 * row["test"][f"rel_l2_{name}"]) for name in ENDS),
            number(row["test"]["slope"]),
            number(sum(row["loss_curve"][-N_LAST:]) / N_LAST),
        ]
        for row in _rows_of(source)
    ]
    headings = ["precision", "peak of the learning rate", "iterations", "ē, m"]
    headings += ["relative L2 error, %: median / p95 / max", "slope", "loss at the end"]
    return markdown(headings, body)


def full_sizes(source: str, dataset: str) -> str:
    """Show full-size networks on one dataset, the most accurate first; SOURCE is FILE,FILE,…."""
    rows = [row for row in _rows_of(source) if row["dataset"] == dataset]
    body = []
    for row in sorted(rows, key=lambda row: float(row["test"]["mean_dof_m"])):
        test, method = row["test"], row.get("method", "umesh")
        times = [number(row["latency_ms"][name]["median"]) for name in ("replayed", "launched")]
        body.append(
            [
                f"`{method}`",
                ", ".join(f"{name} {row[name]}" for name in SIZES[method]),
                f"{row['n_weights']:,}",
                f"{row['iterations']:,}",
                number(row["fit_s"]),
                *(_metres(test[name]) for name in ("mean_dof_m", "std_dof_m", "max_dof_m")),
                " / ".join(number(100 * test[f"rel_l2_{name}"]) for name in ENDS),
                number(100 * test["tip_rel_at_largest"]),
                " / ".join(times),
            ]
        )
    headings = ["method", "size", "weights", "iterations", "trained, s", "ē, m", "σ(e), m"]
    headings += ["largest e, m", "relative L2 error, %: median / p95 / max", "tip at largest u, %"]
    return markdown([*headings, "network, replayed / launched by PyTorch, ms"], body)


def training_speed(source: str) -> str:
    """Show the times of a training step of U-Mesh with the axes of its grid in two orders."""
    rows: Rows = content_of(source)["rows"]
    first = {row["scene"]: row for row in reversed(rows)}
    body = []
    for row in rows:
        total, before = (
            sum(found[f"{part}_ms"] for part in PARTS) for found in (row, first[row["scene"]])
        )
        body.append(
            [
                f"{row['scene']}, batch of {row['batch_size']}",
                f"{row['choice']}: {row['grid']}",
                *(number(row[f"{part}_ms"]) for part in PARTS),
                number(total / before),
            ]
        )
    return markdown(["scene", "axes", *(f"{part}, ms" for part in PARTS), "whole step"], body)


def _rows_of(source: str) -> Rows:
    """Return the rows of several files, without those of trainings that failed."""
    files = [content_of(name) for name in source.split(",")]
    rows = [{"batch_size": file.get("batch_size"), **row} for file in files for row in file["rows"]]
    return [row for row in rows if "error" not in row]


def _small(rows: Rows) -> Rows:
    return [row for row in rows if row["batch_size"] == BATCH]


def _published(row: dict[str, Any]) -> Published:
    """Return the paper's figures for a scene and size; our deformation is in the name of ours."""
    name = row["dataset"].removesuffix("-paper")
    (found,) = [
        paper
        for paper in PUBLISHED
        if (paper.dataset, paper.channels, paper.steps) == (name, row["channels"], row["steps"])
    ]
    return found


def _beside(ours: float, published: float | None) -> str:
    return f"{_metres(ours)} / {'–' if published is None else _metres(published)}"


def _law_cells(rows: Rows, others: Rows, held_out: Rows, large: Rows, n_floor: int) -> list[str]:
    """Return the cells of one law: all rows fit it, and the others alone for those held out."""
    law, without = fit_law(rows, n_floor), fit_law(others, n_floor)
    c = law.coefficients
    cells = [f"{_ratio(c[i])} ({_pair(law.interval(i), _ratio)})" for i in (1, 2)]
    cells.append(_factor(law, 3, _ratio))
    cells.append(_factor(law, 4, _metres) if n_floor == 1 else "–")
    cells.append(f"{_ratio(c[5])} ({_pair(law.interval(5), _ratio)})" if n_floor == 2 else "–")
    cells += [_ratio(law.deviation), f"{law.aicc:.0f}"]
    for known, row in [*((without, row) for row in held_out), *((law, row) for row in large)]:
        cells.append(_predicted(known, row))
    every = fit_law(rows, n_floor, least_channels=1)
    return [*cells, *(_predicted(every, row) for row in large)]


def _predicted(law: Law, row: dict[str, Any]) -> str:
    e, *ends = law.predict(row)
    return f"{_metres(e)} ({_pair(ends, _metres)})"


def _factor(law: Law, which: int, text: Callable[[float], str]) -> str:
    """Return the exponential of a coefficient with its confidence interval."""
    return f"{text(exp(law.coefficients[which]))} ({_pair(map(exp, law.interval(which)), text)})"


def _ratio(value: float) -> str:
    return f"{value:.2f}"


def _metres(value: float) -> str:
    return f"{value:.1e}".replace("e-0", "e-")


def _pair(ends: Iterable[float], text: Callable[[float], str]) -> str:
    return " to ".join(map(text, ends))
