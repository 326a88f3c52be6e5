"""The tables of the U-Mesh paper stand beside our rows, in the units of their headings."""

from __future__ import annotations

import pytest

from mor_bench.report.entries import Entry
from mor_bench.report.paper_tables import PUBLISHED, error_measures, same_error_or_time
from mor_bench.report.speed_tables import NOT_REACHED
from tests.synthetic import METHODS, a_row


@pytest.fixture
def entries() -> list[Entry]:
    """All synthetic methods with the figures that the paper's tables need."""
    return [
        Entry(
            a_row(
                method,
                swept,
                error={"rel_l2_median": error, "mean_dof_m": error / 10},
                latency_ms={"median": latency},
            )
        )
        for method, configurations in METHODS.items()
        for swept, error, latency in configurations
    ]


def test_the_error_table_of_the_paper_shows_its_networks_beside_ours(entries: list[Entry]) -> None:
    network = next(entry.row for entry in entries if entry.method == "umesh")
    size = {"channels": 128, "steps": 3}
    large = Entry(network.with_parts(label="large", parameters=size))
    measures = error_measures("beam-coarse", [*entries, large])
    assert measures is not None
    # Both of ours, and seven of the paper's eight: one has the size of one of ours.
    assert len(measures.rows) == 2 + 8 - 1
    assert measures.rows[0][1:4] == ["16", "2", "64"]
    assert measures.rows[1][:4] == ["large", "128", "3", "1024"]
    assert measures.rows[1][5::2] == ["0.0007", "0.0006", "–", "0.00352", "2.5", "35"]
    assert [row[0] for row in measures.rows[2:]] == ["not run here"] * 7
    others = [entry for entry in entries if entry.method != "umesh"]
    assert error_measures("beam-coarse", others) is None
    assert same_error_or_time("beam-coarse", others) == []


def test_the_paper_s_comparisons_stand_beside_ours_on_its_dataset(entries: list[Entry]) -> None:
    error, time = same_error_or_time("beam-fine", entries)
    by_method = {method: cells for method, *cells in error.rows}
    assert by_method["pod"][3:] == ["120", "0.006"]
    assert by_method["linear-fem"][0] == NOT_REACHED
    assert by_method["fem"][0] == "fem [tolerance=0.1]"
    assert {method: cells[3:] for method, *cells in time.rows}["hpod"] == ["5", "0.084"]


def test_the_published_figures_are_those_of_the_paper() -> None:
    by_size = {(row.dataset, row.channels, row.steps): row for row in PUBLISHED}
    assert len(by_size) == len(PUBLISHED) == 13
    assert by_size["beam-coarse", 64, 5].train_min == 426
    assert by_size["liver-tet", 128, 3].mean_m == 5.33e-5


def test_the_training_time_of_the_paper_s_table_is_in_minutes() -> None:
    network = Entry(
        a_row("umesh", parameters={"channels": 128, "steps": 3}, offline_s={"data": 0, "fit": 1200})
    )
    for dataset in ("beam-coarse", "another"):
        table = error_measures(dataset, [network])
        assert table is not None
        assert table.rows[0][table.headings.index("train (min)")] == "20"
