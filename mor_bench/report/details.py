"""The page's additional tables, in reading order; a table without data is left out."""

from __future__ import annotations

from collections.abc import Sequence

from mor_bench.report.caveat_tables import (
    error_bounds,
    hidden_table,
    named_sets,
    out_of_range,
    regimes_table,
    tuning_table,
)
from mor_bench.report.entries import Analysis, Entry, entries_of, selected_per_method
from mor_bench.report.measurement_tables import indicated, resources, seeds, timing, training
from mor_bench.report.paper_tables import against_the_paper, error_measures, same_error_or_time
from mor_bench.report.speed_tables import break_even_table, pairwise, profile_table
from mor_bench.report.text_table import TextTable
from mor_bench.results.comparison import Comparison


def dataset_details(comparison: Comparison, dataset: str, analysis: Analysis) -> list[TextTable]:
    """List the additional tables of a dataset."""
    entries = entries_of(comparison, dataset, analysis)
    tables = [
        *pairwise(comparison, dataset, analysis),
        break_even_table(dataset, analysis, entries),
        timing(entries),
        resources(entries),
        indicated(entries),
        named_sets(entries),
        out_of_range(entries),
        error_bounds(entries),
        hidden_table(dataset, entries, analysis),
        training(entries),
        seeds(entries),
        tuning_table(dataset, analysis),
        error_measures(dataset, entries),
        against_the_paper(dataset, entries),
        *same_error_or_time(dataset, entries),
    ]
    return [table for table in tables if table is not None]


def hard_cases(dataset: str, entries: Sequence[Entry], analysis: Analysis) -> list[TextTable]:
    """List the tables about loads that are harder than those of the main test set, or fresh.

    Each method has its fastest configuration that qualifies there, or else its most accurate one.
    """
    chosen = selected_per_method(entries)
    tables = (
        named_sets(chosen),
        out_of_range([entry for entry in chosen if entry.row.sets]),
        error_bounds([entry for entry in chosen if entry.row.sets]),
        hidden_table(dataset, chosen, analysis),
    )
    return [table for table in tables if table is not None]


def overall(analysis: Analysis) -> list[TextTable]:
    """List the tables over all datasets; a profile over one dataset says nothing about others."""
    several = analysis["profile"]["n_datasets"] > 1
    tables = (profile_table(analysis) if several else None, regimes_table(analysis))
    return [table for table in tables if table is not None]
