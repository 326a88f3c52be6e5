"""Learning curves, and the performance profile over all problems."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mor_bench.report.canvas import (
    COLOURS,
    INK,
    Drawn,
    Style,
    dress,
    new_figure,
    plain,
    save,
    shortened,
)
from mor_bench.report.details import profile_note
from mor_bench.results.comparison import Comparison

ALL = "all datasets"
"""In the place of a dataset's name, of a figure over all of them."""


def learning_curves(comparison: Comparison, dataset: str, styles: dict[str, Style]) -> Drawn | None:
    """Error over the number of training samples, log-log, a line per configuration; None if no line has two points."""
    lines: dict[tuple[str, str], list[tuple[int, float]]] = {}
    left_out = 0
    for record in comparison.learning:
        if record["dataset"] != dataset:
            continue
        error = (record.get("error") or {}).get("rel_l2_median")
        if error is None or not isfinite(error) or error <= 0:
            left_out += 1
            continue
        lines.setdefault((record["method"], record["label"]), []).append(
            (record["n_train"], 100 * error)
        )
    if not any(len(points) > 1 for points in lines.values()):
        return None
    figure = new_figure(4.8)
    axes = figure.subplots()
    dress(axes)
    for (method, label), points in lines.items():
        style = styles.get(method, Style(INK, "o"))
        xy = np.array(sorted(points), dtype=float)
        axes.loglog(
            *xy.T,
            color=style.colour,
            marker=style.marker,
            markeredgecolor="white",
            markersize=7,
            linewidth=1.3,
            label=plain(shortened(label, 40)),
        )
    sizes = sorted({n for points in lines.values() for n, _ in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.xaxis.set_minor_formatter(NullFormatter())
    values = [error for points in lines.values() for _, error in points]
    axes.yaxis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if max(values) / min(values) < 300 else (1.0,))
    )
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("training samples")
    axes.set_ylabel("relative L2 error, median over the test set (%)")
    axes.set_title(plain(f"Learning curves – {dataset}"), loc="left", fontsize=13, color=INK)
    figure.legend(loc="outside right upper", fontsize=9, frameon=False)
    path = save(figure, comparison, dataset, "learning-curves")
    caption = "Error on the test set of the same configuration, fitted to more and more of the training samples."
    if left_out:
        caption += f" {left_out} {'fit' if left_out == 1 else 'fits'} without a finite error cannot be shown."
    return Drawn(dataset, path, "Learning curves", caption)


def loss_curves(comparison: Comparison, dataset: str, styles: dict[str, Style]) -> Drawn | None:
    """Loss over the course of the training, a panel per method and a colour per configuration; None where nothing was trained.

    Validation is dashed. What the losses of different methods measure differs, so that each has its own axis.
    """
    curves: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for row in comparison.rows:
        if row["dataset"] == dataset and row["status"] == "ok" and row.get("training"):
            samples = comparison.samples(row)
            if len(samples.get("loss_curve", ())):
                swept = row["label"].removeprefix(row["method"]).strip() or row["method"]
                iterations = row["training"].get("iterations")
                name = swept if iterations is None else f"{swept}, {iterations:,} iterations"
                curves.setdefault(row["method"], []).append((name, samples))
    if not curves:
        return None
    n_columns = min(2, len(curves))
    n_rows = -(-len(curves) // n_columns)
    figure = new_figure(0.6 + 3.4 * n_rows)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes in panels[len(curves) :]:
        axes.set_visible(False)
    validated = False
    for axes, (method, trained) in zip(panels, curves.items(), strict=False):
        dress(axes)
        for i, (label, samples) in enumerate(trained):
            colour = COLOURS[i % len(COLOURS)]
            for name, line in (("loss_curve", "-"), ("validation_curve", "--")):
                losses = np.asarray(samples.get(name, ()), dtype=float)
                shown = np.isfinite(losses) & (losses > 0)
                x = 100 * np.arange(1, len(losses) + 1) / max(len(losses), 1)
                alone = "o" if shown.sum() == 1 else ""
                named = plain(shortened(label, 50)) if line == "-" else None
                axes.plot(
                    x[shown],
                    losses[shown],
                    line,
                    marker=alone,
                    color=colour,
                    linewidth=1.3,
                    label=named,
                )
                validated |= name == "validation_curve" and bool(shown.any())
        axes.set_yscale("log")
        axes.set_xlabel("part of the training (%)")
        axes.set_ylabel("loss")
        axes.set_title(plain(method), loc="left", fontsize=11, color=INK)
        axes.legend(fontsize=8, frameon=False)
    figure.suptitle(plain(f"Loss curves – {dataset}"), x=0.01, ha="left", fontsize=13, color=INK)
    path = save(figure, comparison, dataset, "loss-curves")
    caption = "Training loss from the beginning to where the training ended, in the method's own units, which no other method shares."
    return Drawn(
        dataset,
        path,
        "Loss curves",
        caption
        + (" Dashed: of the samples that were held out of the training." if validated else ""),
    )


def performance_profile(
    comparison: Comparison, analysis: Mapping[str, Any], styles: dict[str, Style]
) -> Drawn | None:
    """Share of problems solved within a factor of the fastest method, a staircase per method; None with less than two methods."""
    found = analysis["profile"]
    solving = {
        method: sorted(f for f in factors if f is not None)
        for method, factors in found["factors"].items()
    }
    solving = {method: factors for method, factors in solving.items() if factors}
    n = len(found["problems"])
    if len(solving) < 2:
        return None
    figure = new_figure(4.4)
    axes = figure.subplots()
    dress(axes)
    end = 1.3 * max(max(factors) for factors in solving.values())
    for i, (method, factors) in enumerate(solving.items()):
        style = styles[method]
        # Staircases that run together are told apart by a shift of a thousandth or two.
        x, y = (
            np.array([1.0, *factors, end]),
            np.array([0, *range(1, len(factors) + 1), len(factors)]) / n
            + 0.0015 * (i - len(solving) / 2),
        )
        axes.step(x, 100 * y, where="post", color=style.colour, linewidth=1.6)
        axes.plot(
            x[1:-1],
            100 * y[1:-1],
            style.marker,
            color=style.colour,
            markeredgecolor="white",
            markersize=7,
            label=plain(method),
        )
    axes.set_xscale("log")
    axes.set_xlim(0.95, end)
    axes.set_ylim(-4, 104)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}×"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("at most this factor slower than the fastest method")
    axes.set_ylabel("problems solved (%)")
    over = (
        f"{found['n_datasets']} datasets"
        if found["n_datasets"] > 1
        else "the errors of one dataset"
    )
    axes.set_title(plain(f"Performance profile over {over}"), loc="left", fontsize=13, color=INK)
    figure.legend(loc="outside right upper", fontsize=9, frameon=False)
    return Drawn(
        ALL,
        save(figure, comparison, ALL, "performance-profile"),
        "Performance profile",
        profile_note(found),
    )
