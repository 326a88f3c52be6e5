"""All figures of a comparison, in reading order."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from matplotlib.text import Text

from mor_bench.analysis.told import class_text, classes_of, given_by
from mor_bench.report.canvas import Drawn, Picture, add_note, save
from mor_bench.report.distribution_figure import error_distribution
from mor_bench.report.entries import Analysis, dataset_names
from mor_bench.report.error_against_deformation import error_against_deformation
from mor_bench.report.error_against_time import error_against_time
from mor_bench.report.error_over_position import error_over_position
from mor_bench.report.profile_figure import performance_profile
from mor_bench.report.short_names import explained_values
from mor_bench.report.singular_values import singular_values
from mor_bench.report.training_curves import learning_curves, loss_curves
from mor_bench.report.whole_cost import whole_cost
from mor_bench.report.worst_samples import worst_samples
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

WITHOUT_TOLD = ("singular-values", "error-over-position")
"""Pictures of no method, and those that say themselves what a method is told."""

ALL = "all datasets"
"""Replaces the dataset's name in figures about all datasets."""


def pictures_of(comparison: Comparison, dataset: str, analysis: Analysis) -> Iterator[Picture]:
    """Draw every figure of a dataset for which there is data."""
    for picture in (
        error_against_time(comparison, dataset, analysis),
        learning_curves(comparison, dataset),
        loss_curves(comparison, dataset),
        error_against_deformation(comparison, dataset, analysis),
        error_over_position(comparison, dataset, analysis),
        worst_samples(comparison, dataset, analysis),
        error_distribution(comparison, dataset, analysis),
        whole_cost(comparison, dataset, analysis),
        singular_values(comparison, dataset),
    ):
        if picture is not None:
            explain_names(picture, comparison, dataset)
            yield picture


def explain_names(picture: Picture, comparison: Comparison, dataset: str) -> None:
    """Explain in a picture its short names of parameters, and what its methods are told."""
    drawn = [t.get_text() for t in picture.figure.findobj(Text) if isinstance(t, Text)]
    rows = [row for row in comparison.rows if row.dataset == dataset]
    shown = " ".join(drawn)
    if note := explained_values(rows, shown):
        add_note(picture.figure, note)
    if picture.kind not in WITHOUT_TOLD and (note := _told(rows, shown, comparison, dataset)):
        add_note(picture.figure, note)


def _told(rows: Sequence[Row], shown: str, comparison: Comparison, dataset: str) -> str:
    """Name the methods of a picture by what they are given, and references as such."""
    given, order = given_by(comparison, dataset), classes_of(rows)
    named: dict[str, list[str]] = {}
    for row in sorted(rows, key=lambda row: (order.index(row.told), row.reference)):
        if row.told and re.search(rf"(?<![\w-]){re.escape(row.method)}(?![\w-])", shown):
            methods = named.setdefault(class_text(row, given), [])
            methods += [row.method] if row.method not in methods else []
    parts = [f"{words} ({', '.join(methods)})" for words, methods in named.items()]
    return f"Told: {'; '.join(parts)}" if parts else ""


def write_figures(comparison: Comparison, analysis: Analysis) -> list[Drawn]:
    """Draw and write every figure, dataset by dataset."""
    drawn = [
        save(picture, comparison, dataset)
        for dataset in dataset_names(comparison)
        for picture in pictures_of(comparison, dataset, analysis)
    ]
    profile = performance_profile(analysis)
    return drawn + ([save(profile, comparison, ALL)] if profile else [])
