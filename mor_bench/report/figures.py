"""All figures of a comparison, in reading order."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.text import Text

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
    """Explain in a picture the short names of parameters that it uses."""
    drawn = [t.get_text() for t in picture.figure.findobj(Text) if isinstance(t, Text)]
    rows = [row for row in comparison.rows if row.dataset == dataset]
    if note := explained_values(rows, " ".join(drawn)):
        add_note(picture.figure, note)


def write_figures(comparison: Comparison, analysis: Analysis) -> list[Drawn]:
    """Draw and write every figure, dataset by dataset."""
    drawn = [
        save(picture, comparison, dataset)
        for dataset in dataset_names(comparison)
        for picture in pictures_of(comparison, dataset, analysis)
    ]
    profile = performance_profile(analysis)
    return drawn + ([save(profile, comparison, ALL)] if profile else [])
