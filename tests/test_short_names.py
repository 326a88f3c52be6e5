"""Short names of configurations are unique and hold only what varies."""

from __future__ import annotations

from mor_bench.report.number_format import MEANINGS, short_name
from mor_bench.report.short_names import constants, short_names
from mor_bench.specs import list_suite, load_method_spec
from tests.synthetic import a_row


def test_names_hold_only_what_varies() -> None:
    rows = [
        *(a_row("hpod", {"n_modes": r, "sampling": "points"}) for r in (5, 10)),
        *(a_row("fem", {"tolerance": t}) for t in (0.01, 1e-8)),
        *(a_row("fno", {"input": given}) for given in ("force", "linear-response")),
        a_row("umesh", {"channels": 16}),
    ]
    assert [str(name) for name in short_names(rows).values()] == [
        "hpod · r5",
        "hpod · r10",
        "fem · tol 0.01",
        "fem · tol 1e-08",
        "fno · force",
        "fno · linear-response",
        "umesh",
    ]
    assert constants(rows) == "hpod: points; umesh: channels 16"


def test_parameters_with_one_initial_keep_their_names_apart() -> None:
    rows = [a_row("a", {"n_wide": i, "n_west": i}) for i in (1, 2)]
    assert str(short_names(rows)[rows[0].label]) == "a · n_wide 1, n_west 1"


def test_values_that_round_to_one_text_stay_apart() -> None:
    rows = [a_row("a", {"tolerance": t}) for t in (0.1, 0.1000000001)]
    assert str(short_names(rows)[rows[1].label]) == "a · tolerance=0.1000000001"


def test_every_short_name_of_the_suite_has_a_meaning() -> None:
    specs = [load_method_spec(name) for name in list_suite("methods")]
    sweeps = [s for spec in specs for s in (spec.sweep, *(p.sweep for p in spec.profiles.values()))]
    keys = {key for sweep in sweeps for key in sweep if short_name(key) != key}
    assert len(keys) > 8
    assert keys <= set(MEANINGS)
