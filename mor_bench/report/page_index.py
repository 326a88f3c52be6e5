"""The index of a folder of pages: where each method stands on each dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

from mor_bench.analysis.verdict import needs_of
from mor_bench.report.entries import Entry, dataset_names, entries_of, most_accurate, verdict_of
from mor_bench.report.number_format import number, percent
from mor_bench.report.page_sections import View
from mor_bench.report.short_names import renamed
from mor_bench.report.summary import needs_in_words

Link = tuple[str, str]
"""Address and text."""


@dataclass(frozen=True)
class Standing:
    """A method on a dataset: the main line, small print, and the latency if it qualifies."""

    main: str
    small: str = ""
    latency_ms: float = inf

    @property
    def qualified(self) -> bool:
        return self.latency_ms < inf


@dataclass(frozen=True)
class Standings:
    """The content of the index.

    Attributes
    ----------
    datasets : list of (Link, str, str)
        Each dataset with its needs and its verdict.
    methods : list of (Link, list of Standing)
        Each method with its standing on each dataset; those that qualify most often come first.
    """

    datasets: list[tuple[Link, str, str]]
    methods: list[tuple[Link, list[Standing]]]


def standings(view: View, files: Mapping[str, Mapping[str, str]]) -> Standings:
    """Collect the index; `files` holds the pages of each "dataset" and "method"."""
    comparison = view.comparison
    datasets, columns = [], []
    for name in dataset_names(comparison):
        verdict = verdict_of(view.analysis, name).get("headline", "No configuration was run.")
        finding = renamed(verdict, view.names[name]).partition(". ")[2] or verdict
        needs = needs_in_words(needs_of(comparison, name))
        datasets.append(((files["dataset"][name], name), needs, finding))
        columns.append(entries_of(comparison, name, view.analysis))
    methods = [
        (
            (file, method),
            [_standing([e for e in column if e.method == method], view) for column in columns],
        )
        for method, file in files["method"].items()
    ]
    methods.sort(key=lambda item: sorted(standing.latency_ms for standing in item[1])[::-1])
    return Standings(datasets, methods)


def _standing(entries: Sequence[Entry], view: View) -> Standing:
    """Say how fast a method is where it qualifies, or how accurate it is."""
    if not entries:
        return Standing("not run")
    ran = [entry for entry in entries if entry.ran]
    if not ran:
        return Standing(entries[0].row.status)
    qualified = [entry for entry in ran if entry.qualified]
    if not qualified:
        found, how = most_accurate(ran)
        return Standing("does not qualify", f"test error {percent(found.error)} % ({how})")
    best = min(qualified, key=lambda entry: entry.latency_ms)
    values = view.names[best.row.dataset][best.label].values
    small = [f"at {percent(best.error)} %", values, "timing not stable" if best.unstable else ""]
    return Standing(
        f"{number(best.latency_ms)} ms", ", ".join(filter(None, small)), best.latency_ms
    )
