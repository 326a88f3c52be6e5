"""The tables of the U-Mesh paper stand beside our rows, in the units of their headings."""

from __future__ import annotations

import pytest

from mor_bench.report.entries import Entry
from mor_bench.report.paper_tables import (
    against_the_paper,
    error_measures,
    same_error_or_time,
)
from mor_bench.report.published_figures import PUBLISHED, SCENES
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
    assert by_method["pod"][4:] == ["120", "0.006", "0.593"]
    assert by_method["linear-fem"][0] == NOT_REACHED
    assert by_method["fem"][0] == "fem [tolerance=0.1]"
    assert {method: cells[4:-1] for method, *cells in time.rows}["hpod"] == ["5", "0.084"]
    assert all("0.0019 m" in table.note and "740 ms" in table.note for table in (error, time))


def test_the_published_figures_are_those_of_the_paper() -> None:
    by_size = {(row.dataset, row.channels, row.steps): row for row in PUBLISHED}
    assert len(by_size) == len(PUBLISHED) == 13
    assert by_size["beam-coarse", 64, 5].train_min == 426
    assert by_size["liver-tet", 128, 3].mean_m == 5.33e-5


@pytest.mark.parametrize("dataset", ["beam-coarse", "beam-coarse-paper"])
def test_methods_stand_beside_the_paper_by_slope_and_relative_error(dataset: str) -> None:
    figures = {
        "mean_dof_m": 0.0014,
        "mean_free_dof_m": 0.0015,
        "amplitude_m": 0.5,
        "slope": 0.00704,
        "rel_l2_median": 0.05,
        "tip_rel_at_max_e": 0.08,
        "tip_rel_at_largest": 0.02,
    }
    measured, old = (
        Entry(a_row(name, error=error))
        for name, error in (("umesh", figures), ("pod", {"mean_dof_m": 0.002}))
    )
    table = against_the_paper(dataset, [measured, old])
    assert table is not None
    by_heading = [dict(zip(table.headings, row, strict=True)) for row in table.rows]
    paper, own, without = by_heading
    assert paper["largest u (m)"] == "0.724"
    assert paper["ē / largest u (%)"] == "0.0967"
    assert paper["tip at largest e (%)"] == "5.1"
    assert own["slope / paper's"] == "2"
    assert own["ē / largest u (%)"] == "0.28"
    assert own["ē, free dofs (m)"] == "1.5e-03"
    assert (own["tip at largest e (%)"], own["tip at largest u (%)"]) == ("8", "2")
    assert set(list(without.values())[3:]) == {"–"}
    assert "selects one" in table.note
    assert against_the_paper("beam-tiny", [measured]) is None


def test_every_scene_of_the_paper_has_its_selected_network_and_its_amplitude() -> None:
    assert {name: scene.amplitude_m for name, scene in SCENES.items()} == {
        "beam-coarse": 0.724,
        "beam-coarse-3-forces": 1.0035,
        "beam-fine": 1.011,
        "l-shape": 8.9016,
        "liver-hex": 0.0536,
        "liver-tet": 0.088,
    }
    assert all(scene.network.dataset == name for name, scene in SCENES.items())
    slopes = [scene.network.slope for scene in SCENES.values()]
    assert slopes == [0.00352, None, 0.0083, 0.002046, 0.0021, None]


def test_the_training_time_of_the_paper_s_table_is_in_minutes() -> None:
    network = Entry(
        a_row("umesh", parameters={"channels": 128, "steps": 3}, offline_s={"data": 0, "fit": 1200})
    )
    for dataset in ("beam-coarse", "another"):
        table = error_measures(dataset, [network])
        assert table is not None
        assert table.rows[0][table.headings.index("train (core-min)")] == "20"
