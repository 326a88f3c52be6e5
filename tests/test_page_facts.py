"""What the page says of scenes, methods and configurations, in words."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.verdict import Requirements
from mor_bench.machine import describe_machine
from mor_bench.report.caveat_tables import error_bounds
from mor_bench.report.entries import Entry, entries_of
from mor_bench.report.not_measured import unmeasured
from mor_bench.report.number_format import joined_units, unbroken
from mor_bench.report.page_facts import (
    answer_of,
    facts_of,
    limits_of,
    machine_facts,
    method_facts,
    reason_of,
    untested_of,
)
from mor_bench.report.page_samples import Sampled
from mor_bench.report.page_strains import strain_facts
from mor_bench.report.page_tables import run_again
from mor_bench.report.scene_text import scene_text
from mor_bench.report.summary import interval_basis, paper_size
from mor_bench.results.parts import ErrorSummary
from mor_bench.results.row import BoundQuality, SetErrors
from mor_bench.runs.run_folder import record_commit
from mor_bench.scene.mesh import box_mesh
from mor_bench.specs import list_suite, load_dataset_spec
from tests.report_runs import add_row, tiny
from tests.synthetic import a_row, synthetic_comparison

NEEDS = Requirements(error=0.01, latency_ms=3.0)


def entry(error: float, latency_ms: float, n_failed: int = 0) -> Entry:
    return Entry(
        a_row(
            "pod",
            error={"rel_l2_median": error},
            latency_ms={"median": latency_ms},
            n_failed=n_failed,
        )
    )


def test_a_configuration_that_does_not_qualify_names_the_limits_that_it_misses() -> None:
    assert answer_of(replace(entry(0.001, 1.0), qualified=True), NEEDS) == "yes"
    assert answer_of(entry(0.02, 1.0), NEEDS) == "no: median error, 95 % bound 2 %"
    assert answer_of(entry(0.02, 4.0), NEEDS) == (
        "no: median error, 95 % bound 2 %, latency, 95 % bound 4 ms"
    )
    assert answer_of(entry(0.001, 1.0, n_failed=2), NEEDS) == "no: loads without an answer"
    assert answer_of(Entry(a_row("pod", status="failed", reason="x")), NEEDS) == "failed"
    text = reason_of(entry(0.02, 4.0), NEEDS)
    assert text == (
        "no: median error: 95 % upper bound 2 %, limit 1 %; "
        "latency: 95 % upper bound 4 ms, limit 3 ms"
    )


def test_the_validation_part_and_its_interval_give_the_reason() -> None:
    row = entry(0.001, 1.0).row.with_parts(validation=ErrorSummary(rel_l2_median=0.004))
    sure = Entry(row, intervals={"validation_rel_l2_median": (0.002, 0.009)})
    unsure = Entry(row, intervals={"validation_rel_l2_median": (0.002, 0.0118)})
    assert answer_of(sure, NEEDS) == "no"
    assert reason_of(unsure, NEEDS) == (
        "no: median validation error: 95 % upper bound 1.18 %, limit 1 %"
    )
    assert answer_of(unsure, NEEDS) == "no: median validation error, 95 % bound 1.18 %"


@pytest.mark.parametrize("name", list_suite("datasets"))
def test_every_scene_of_the_suite_has_a_sentence(name: str) -> None:
    text = scene_text(load_dataset_spec(name).model_dump(mode="json"))
    assert text.endswith(".")
    assert "None" not in text
    assert any(unit in text for unit in (" N ", " m.", " Pa "))


def test_the_sentence_of_a_scene() -> None:
    text = scene_text(load_dataset_spec("beam-coarse").model_dump(mode="json"))
    assert text == (
        "Box of 4 × 1 × 1 m, Saint Venant-Kirchhoff (E 500 Pa, ν 0.4), clamped at x-min with "
        "one dead force of 0 to 1 N in any direction on z-max, as a uniform traction on a patch of "
        "0.11 m² each."
    )
    text = scene_text(load_dataset_spec("artery-pressure").model_dump(mode="json"))
    assert "on springs with dead pressures of 0 to 20000 Pa on inner and outer." in text
    text = scene_text(load_dataset_spec("beam-stiffness").model_dump(mode="json"))
    assert text.endswith("; sampled per body: E from 300 to 800 Pa, ν from 0.35 to 0.45.")


@pytest.mark.parametrize("content", [{}, {"geometry": 5}, {"loads": {"kind": "force"}}])
def test_a_damaged_description_has_no_sentence(content: dict[str, object]) -> None:
    assert scene_text(content) == ""


def test_strains_are_those_of_the_stored_displacements() -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))
    stretches = np.array([1.2, 0.9, 0.95])
    u = mesh.points * (stretches - 1)
    item = Sampled(entry(0.001, 1.0), {"worst_reference": u, "middle_reference": 0 * u})
    ((name, text),) = strain_facts([item], {"points": mesh.points, "cells": mesh.cells})
    assert name == "strains"
    assert text.startswith("stretches from 0.9 to 1.2, det F at least 1, at the")
    assert strain_facts([item], {}) == []


def test_the_page_tells_how_to_run_again_and_what_was_not_tested(tmp_path: Path) -> None:
    run = tiny(tmp_path / "run")
    run.settings.update(seeds=1)
    run.methods["pod"] = {"title": "POD", "regime": {"says": "large meshes", "min_dofs": 10**6}}
    add_row(run, "pod", {"n_modes": 20}, 0.008, 2.5)
    entries = entries_of(run, "beam-tiny")
    facts = dict(facts_of(run, "beam-tiny", entries))
    assert facts["command that runs it all again"].startswith("mor-bench run beam-tiny")
    assert ("built for", "large meshes") in method_facts(run, "pod")
    text = limits_of(run, analyse(run), entries)
    assert text.startswith("Errors are those of static displacements against full-order solutions")
    assert "1 of 1 configurations ran and answered every test load." in text
    assert "hold for this body, material, supports and kind of load only" in text
    assert "No test load is centred where a training load is centred" in text
    full = "`mor-bench run beam-tiny --profile full`"
    assert f"Errors beyond the training loads were not measured; {full} measures them." in text
    learning, beyond = unmeasured(run, "beam-tiny", entries)
    assert learning.startswith("Learning curves, ")
    assert all(line.endswith(f": {full}.") for line in (learning, beyond))
    run.settings.update(profile="full")
    assert unmeasured(run, "beam-tiny", entries) == []
    bound = BoundQuality(level=0.9, relative_l2=inf, n=20, n_groups=2)
    finite = bound.model_copy(update={"relative_l2": 0.1})
    unbounded = [Entry(entries[0].row.with_parts(bound=bound))]
    (few,) = unmeasured(run, "beam-tiny", unbounded)
    assert few.startswith("Calibrated error bounds: ")
    assert error_bounds(unbounded) is None
    assert error_bounds([Entry(entries[0].row.with_parts(bound=finite))])
    run.settings.update(profile="quick")
    sets = {name: SetErrors(n=9, rel_l2_median=e) for name, e in (("in-range", 0.01), ("2x", 0.08))}
    tested = [Entry(entries[0].row.with_parts(sets=sets))]
    assert "Beyond the training loads, the median relative L2 error of pod is 8 % on 2x." in (
        limits_of(run, analyse(run), tested)
    )
    assert len(unmeasured(run, "beam-tiny", tested)) == 1
    untested = untested_of(analyse(run), entries)
    assert untested == {"pod": "0 degrees of freedom; it needs 1,000,000"}
    assert text.endswith("do not hold its random seed, `--seeds 3` measures it.")


def test_a_fresh_test_set_is_drawn_again_with_its_seed(tmp_path: Path) -> None:
    run = tiny(tmp_path / "run")
    run.settings.update(test_seed="fresh")
    add_row(run, "pod", {"n_modes": 20}, 0.008, 2.5)
    row = run.rows[0]
    run.put(row.with_parts(hidden=SetErrors(n=10, seed=77)))
    command = dict(facts_of(run, "beam-tiny", entries_of(run, "beam-tiny")))
    assert "--test-seed 77" in command["command that runs it all again"]


def test_a_configuration_tells_the_command_that_repeats_it() -> None:
    assert run_again(Entry(a_row("pod", {"n_modes": 5}))) == (
        "mor-bench run beam-tiny -m 'pod[n_modes=5]'"
    )
    trained = a_row("umesh", {"channels": 8}, training={"device": "cpu"})
    trained = trained.with_parts(parameters={"channels": 8, "iterations": 200})
    assert run_again(Entry(trained)).endswith("-m 'umesh[channels=8,iterations=200]' --train")


def test_the_page_gives_the_commit_date_and_processor_model_or_says_not_recorded() -> None:
    old = dict(machine_facts({"processor": "AMD EPYC", "memory_bytes": 25e9, "cores": 2}))
    assert old["commit of mor-bench"] == old["date"] == old["processor model"] == "not recorded"
    new = dict(machine_facts({**describe_machine(), "commit": "a" * 40, "date": "2026-11-24"}))
    assert new["commit of mor-bench"] == "a" * 40
    assert new["processor model"] not in ("", "not recorded")
    assert "GB" in new["memory"]


def test_a_run_records_its_commit_and_the_one_at_which_it_continues(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine: dict[str, object] = {}
    for commit in ("a1", "a1", "b2", "b2", None):
        monkeypatch.setattr("mor_bench.runs.run_folder.source_commit", lambda c=commit: c)
        record_commit(machine)
    assert machine["commit"] == (
        "a1, continued at b2, continued at none: the package is not in a git checkout"
    )


def test_the_size_of_a_network_stands_beside_that_of_the_paper(tmp_path: Path) -> None:
    made = synthetic_comparison(tmp_path, per_region=4)
    row = made.rows[0].with_parts(parameters={"channels": 16, "steps": 2}, told="equations")
    assert paper_size(row) == (
        "16 channels and 2 steps (the paper's network: 128 channels and 3 steps); "
    )
    command = f"mor-bench run beam-coarse --profile full -m '{row.method}[channels=128,steps=3]'"
    assert f"3 steps, trained by `{command}`); " in paper_size(row.with_parts(told="input"))
    assert paper_size(made.rows[0]) == ""
    text = interval_basis("beam-coarse", analyse(made, n_resamples=77))
    assert "(bootstrap of 77 resamples)" in text


def test_numbers_stay_beside_their_units() -> None:
    space = "\N{NO-BREAK SPACE}"
    assert joined_units("1.47 mm, 5 % of 3 modes") == f"1.47{space}mm, 5{space}% of 3 modes"
    assert joined_units("2 s. 3 steps, 7 N") == f"2{space}s. 3 steps, 7{space}N"


def test_intervals_stay_whole_on_the_page() -> None:
    joiner = "\N{WORD JOINER}"
    assert unbroken("0.51–0.56 % or 3–∞, pod–nn") == (
        f"0.51{joiner}–{joiner}0.56\N{NO-BREAK SPACE}% or 3{joiner}–{joiner}∞, pod–nn"
    )
