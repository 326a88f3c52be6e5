"""The hard cases: each method meets the relevant ones, and each case notices its errors."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from mor_bench import surrogate
from mor_bench.errors import InvalidInputError, MissingDependencyError, SpecError, StoreError
from mor_bench.hard_cases import mechanics_cases, reduction_cases, setups
from mor_bench.hard_cases.case import LONGEST, Scenes, Subject
from mor_bench.hard_cases.catalogue import CASES, CaseResult, attempt, cases_for
from mor_bench.hard_cases.suite import StressResults, stress
from mor_bench.mechanics import locking
from mor_bench.mechanics import model as model_module
from mor_bench.report.hard_case_table import print_stress, stress_table
from mor_bench.scene import soundness
from mor_bench.specs import MethodSpec
from mor_bench.surrogates import pod as pod_module
from mor_bench.surrogates.fem import FullFEM
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pod import PODGalerkin
from tests.commands import invoke
from tests.small_runs import method_file
from tests.suite_methods import SPECS
from tests.wrong_replacements import (
    all_weights_one,
    pod_without_warning,
    shifted,
    solved,
    too_high_a_limit,
    unevenly_weighted,
)

ANY_SOLVER = ("near-incompressible", "slender", "huge-step")
ONE_SOLVER = ("inversion", "snap-through", "distortion", "stiffness-contrast", "unconstrained")
FULL_ORDER: dict[str, set[str]] = {case: {""} for case in (*ANY_SOLVER, *ONE_SOLVER, "bad-mesh")}
LEARNERS = {"bad-snapshots": {""}, "poor-snapshots": {""}}
CUBATURE = {
    "nnls": {"duplicated and badly scaled columns", "one iteration only"},
    "ecsw-all-cells": {""},
}
UNSEEN = {"2x", "4x", "unseen-regions", "unseen-directions", "several-forces"}
ANY: dict[str, set[str]] = {
    "bad-forces": {""},
    "out-of-distribution": UNSEEN,
    "zero-force": {""},
    "symmetry": {""},
    "determinism": {"two runs", "batch of 1 and of 8"},
    "low-precision": {"float32 forces", "bfloat16 inference"},
}


@pytest.fixture(scope="module", autouse=True)
def short_trainings() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LONGEST, "quick", 20)
        patch.setattr("mor_bench.hard_cases.case.BRIEF", 3)
        yield


@pytest.fixture(scope="module")
def scenes(cache: Path) -> Scenes:
    return Scenes(cache)


@pytest.fixture(scope="module")
def everything(cache: Path) -> StressResults:
    return stress(cache=cache)


def tried(scenes: Scenes, spec: MethodSpec, names: Sequence[str] = ()) -> list[CaseResult]:
    """Return the results of a method's cases, run in this process."""
    subject = Subject(spec, "quick", scenes)
    found = cases_for(subject, names or [case.name for case in CASES])
    return [attempt(case, subject, obstacle) for case, obstacle in found]


def flawed(name: str) -> MethodSpec:
    path = f"tests.flawed_methods:{name.capitalize()}"
    return MethodSpec(name=name, title="t", source="s", surrogate=path)


def short_of(rows: Sequence[CaseResult]) -> set[tuple[str, str]]:
    return {(row.case, row.part) for row in rows if row.verdict == "fall short"}


def pairs(*groups: dict[str, set[str]]) -> set[tuple[str, str]]:
    return {(name, part) for group in groups for name, parts in group.items() for part in parts}


def test_every_documented_hard_case_exists() -> None:
    found = [(case.name, case.part) for case in CASES]
    assert sorted(found) == sorted(pairs(FULL_ORDER, LEARNERS, CUBATURE, ANY))


def test_a_method_meets_exactly_the_cases_that_concern_its_kind(scenes: Scenes) -> None:
    for name, spec in SPECS.items():
        subject = Subject(spec, "quick", scenes)
        found = cases_for(subject, [case.name for case in CASES])
        if any(obstacle for _, obstacle in found):
            continue
        method = subject.fresh()
        expected = pairs(ANY, LEARNERS if method.needs_snapshots else {})
        if isinstance(method, HyperReducedPOD):
            expected |= pairs(CUBATURE)
        if isinstance(method, FullFEM):
            own = method.solver is None
            expected |= {(case, "") for case in (FULL_ORDER if own else ANY_SOLVER)}
        assert {(case.name, case.part) for case, _ in found} == expected, name


@pytest.mark.slow
def test_methods_fall_short_only_as_their_files_declare(everything: StressResults) -> None:
    short = defaultdict(set)
    for row in everything.rows:
        if row.verdict == "fall short":
            short[row.method].add(row.case)
    known = {name: set(spec.battery.falls_short) for name, spec in SPECS.items()}
    assert short == {name: cases for name, cases in known.items() if cases}
    applicable = {row.method for row in everything.rows if row.verdict != "not applicable"}
    assert {
        (row.case, row.part)
        for row in everything.rows
        if row.verdict == "not applicable" and row.method in applicable
    } == {("low-precision", "bfloat16 inference")}


@pytest.mark.slow
def test_errors_out_of_distribution_are_published_and_flagged(
    everything: StressResults, scenes: Scenes
) -> None:
    for row in everything.rows:
        if row.case == "out-of-distribution" and row.verdict != "not applicable":
            errors = [row.measured[f"rel_l2_{name}"] for name in ("median", "p95", "max")]
            median, p95, most = (np.inf if error is None else error for error in errors)
            assert 0 <= median <= p95 <= most
            assert (most == np.inf) == (row.measured["n_failed"] > 0)
            assert row.measured["n"] >= 50
            method = Subject(SPECS[row.method], "quick", scenes).fresh()
            prepared = row.method == "pgd-weak-form" and row.part != "unseen-directions"
            assert ("flagged" in row.measured) == (method.needs_snapshots or prepared)


def test_the_table_has_every_row_and_the_counts(scenes: Scenes) -> None:
    rows = [*tried(scenes, flawed("bad"), ["zero-force"]), *tried(scenes, flawed("good"))]
    console = Console(width=160, record=True, file=StringIO())
    print_stress(StressResults(rows, "quick", {}, {"good": "force only"}), console)
    text = console.export_text()
    assert "Told (force only): good." in text
    skipped = sum(row.verdict == "not applicable" for row in rows)
    counts = f"{len(rows) - 1 - skipped} pass, 1 fall short, {skipped} not applicable"
    assert f"{len(rows)} tried: {counts}" in text
    assert "Fall short: zero-force of bad" in text
    assert text.count(" good ") == len(rows) - 1


OUT = pairs({"out-of-distribution": UNSEEN})
FLAWS: dict[str, set[tuple[str, str]]] = {
    "good": set(),
    "bad": pairs({"zero-force": {""}, "bad-forces": {""}, "determinism": ANY["determinism"]}),
    "crashing": pairs({"zero-force": {""}, "poor-snapshots": {""}}),
    "rounding": {("low-precision", "float32 forces")},
    "unchecked": {*OUT, ("bad-snapshots", ""), ("poor-snapshots", "")},
    "alarmed": OUT,
    "careless": OUT,
    "elsewhere": set(),
}
"""Methods of `tests.flawed_methods`, and the cases of which each falls short."""


@pytest.mark.parametrize("name", list(FLAWS))
def test_a_flawed_method_falls_short_exactly_in_the_cases_of_its_flaw(
    name: str, scenes: Scenes
) -> None:
    rows = tried(scenes, flawed(name))
    assert short_of(rows) == FLAWS[name]
    happened = {(row.case, row.part): row.happened for row in rows}
    assert set(happened) == pairs(ANY, LEARNERS)
    if name == "elsewhere":
        assert {row.verdict for row in rows} == {"not applicable"}
        assert set(happened.values()) == {"it is for other scenes"}
    if name == "crashing":
        assert happened["zero-force", ""] == "crashed with ZeroDivisionError: on purpose"
    if name == "unchecked":
        assert "not known" in happened["out-of-distribution", "2x"]


@pytest.mark.slow
def test_a_third_party_s_failure_costs_its_own_rows_only(tmp_path: Path, cache: Path) -> None:
    methods = [
        method_file(tmp_path, name, f"tests.flawed_methods:{name.capitalize()}")
        for name in ("ending", "unfit", "good")
    ]
    found = stress(methods, ["zero-force", "symmetry"], cache=cache)
    assert [(row.method, row.case, row.verdict) for row in found.rows] == [
        ("ending", "zero-force", "fall short"),
        ("ending", "symmetry", "pass"),
        ("unfit", "zero-force", "fall short"),
        ("unfit", "symmetry", "fall short"),
        ("good", "zero-force", "pass"),
        ("good", "symmetry", "pass"),
    ]
    assert "ended with code 7" in found.rows[0].happened


COLUMNS = "duplicated and badly scaled columns"


@dataclass(frozen=True)
class Plant:
    """A bug: a replaced name of a module, and the method and case that must notice it."""

    method: str
    case: str
    module: Any
    name: str
    replacement: Any
    part: str = ""


PLANTS = {
    "a load beyond the limit is solved": Plant(
        "fem", "inversion", mechanics_cases, "solve_equilibrium", solved
    ),
    "the limit load is too high": Plant(
        "fem", "snap-through", mechanics_cases, "limit_load", too_high_a_limit
    ),
    "no limit load is found": Plant(
        "fem", "snap-through", mechanics_cases, "limit_load", lambda *_: None
    ),
    "the path goes on beyond its limit": Plant(
        "fem", "snap-through", mechanics_cases, "solve_on_path", lambda *_: None
    ),
    "locking gives no warning": Plant(
        "fem", "near-incompressible", model_module, "warn_of_locking", lambda _: None
    ),
    "shear locking is not reported": Plant(
        "fem", "slender", mechanics_cases, "limit_of", lambda ends: (ends[0], None, "finest")
    ),
    "cut-backs are not counted": Plant(
        "fem", "huge-step", mechanics_cases, "solve_equilibrium", solved
    ),
    "the patch test fails": Plant("fem", "distortion", setups, "free_assembler", unevenly_weighted),
    "the condition number is too small": Plant(
        "fem", "stiffness-contrast", mechanics_cases, "condition_number", lambda *_: 1.0
    ),
    "ill-conditioning gives no warning": Plant(
        "fem", "stiffness-contrast", locking, "ILL_CONDITIONED", np.inf
    ),
    "supports are not checked": Plant(
        "fem", "unconstrained", model_module, "check_supports", lambda _: None
    ),
    "meshes are not checked": Plant("fem", "bad-mesh", soundness, "check_numbers", lambda *_: None),
    "modes are cut without a warning": Plant(
        "pod", "poor-snapshots", pod_module, "pod", pod_without_warning
    ),
    "cubature weights miss the target": Plant(
        "hpod", "nnls", reduction_cases, "sparse_nnls", all_weights_one, COLUMNS
    ),
    "too few iterations go unreported": Plant(
        "hpod", "nnls", reduction_cases, "sparse_nnls", all_weights_one, "one iteration only"
    ),
    "all cells differ from POD": Plant(
        "hpod",
        "ecsw-all-cells",
        reduction_cases,
        "PODGalerkin",
        lambda n, tol: PODGalerkin(n - 1, tol),
    ),
    "snapshots are not checked": Plant(
        "pod", "bad-snapshots", surrogate, "checked_samples", lambda *arguments: arguments[-1]
    ),
    "the model is asymmetric": Plant("fem", "symmetry", FullFEM, "predict", shifted),
}


def verdict_on(plant: Plant, scenes: Scenes) -> str:
    rows = tried(scenes, SPECS[plant.method], [plant.case])
    return next(row.verdict for row in rows if row.part == plant.part)


@pytest.fixture(scope="module")
def sound() -> dict[tuple[str, str, str], str]:
    """Known verdicts without any bug, by method, case and part."""
    return {}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if plant.case == "snap-through" else [])
        for name, plant in PLANTS.items()
    ],
)
def test_a_case_notices_its_planted_bug(
    name: str,
    scenes: Scenes,
    sound: dict[tuple[str, str, str], str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant = PLANTS[name]
    key = (plant.method, plant.case, plant.part)
    sound[key] = sound.get(key) or verdict_on(plant, scenes)
    assert sound[key] == "pass"
    monkeypatch.setattr(plant.module, plant.name, plant.replacement)
    assert verdict_on(plant, scenes) == "fall short"


def test_a_method_whose_library_is_missing_is_not_applicable(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(self: MethodSpec) -> type[Any]:
        raise MissingDependencyError("umesh needs torch")

    monkeypatch.setattr(MethodSpec, "load_class", missing)
    found = stress(["umesh"], ["zero-force", "poor-snapshots"], cache=cache)
    assert [(row.case, row.verdict, row.happened) for row in found.rows] == [
        ("zero-force", "not applicable", "umesh needs torch")
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"profile": "slow"}, "`profile` must be quick or full; got 'slow'"),
        ({"cases": ["zero-forces"]}, "got 'zero-forces'; did you mean 'zero-force'?"),
        ({"methods": ["podd"]}, "unknown method 'podd'"),
        ({"methods": "pod"}, "`methods` must be a non-empty list"),
        ({"methods": ["fem"], "cases": ["nnls"]}, "none of the cases nnls concerns fem"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str, cache: Path) -> None:
    with pytest.raises((InvalidInputError, SpecError)) as caught:
        stress(cache=cache, **arguments)
    assert message in str(caught.value)


def test_numbers_that_are_not_finite_are_written_as_null(tmp_path: Path) -> None:
    rows = [CaseResult("zero-force", "", "m", "e", "h", "pass", {"ratio": None}, 0.1)]
    StressResults(rows, "quick", {}).write(tmp_path / "new" / "stress.json")
    written = json.loads((tmp_path / "new" / "stress.json").read_text())
    assert written["rows"][0]["measured"] == {"ratio": None}


@pytest.mark.slow
def test_the_command_prints_and_writes_the_same_results(tmp_path: Path, cache: Path) -> None:
    out = tmp_path / "stress.json"
    options = ["-m", "pod", "-m", "linear-fem", "--case", "zero-force", "--case", "symmetry"]
    written = ["--cache", str(cache), "--json", "--out", str(out)]
    done = invoke("stress", *options, *written)
    assert done.exit_code == 0, done.stderr
    printed = json.loads(done.stdout)
    assert [(row["method"], row["case"]) for row in printed["rows"]] == [
        (m, c) for m in ("pod", "linear-fem") for c in ("zero-force", "symmetry")
    ]
    assert json.loads(out.read_text(encoding="utf-8")) == printed
    told = {"pod": "equations, snapshots", "linear-fem": "force and linear response, no snapshots"}
    assert printed["told"] == told
    assert "4 tried: 4 pass, 0 fall short" in done.stderr
    assert "1 of 4: zero-force, pod" in done.stderr


def test_training_loads_of_the_unseen_directions_are_normal_forces(scenes: Scenes) -> None:
    test = scenes.pressed.tests["unseen-directions"]
    for snapshots, along in ((scenes.pressed.train, 1.0), (test, 0.0)):
        vectors = snapshots.loads.vectors[:, 0]
        share = np.abs(vectors[:, 2]) / np.linalg.norm(vectors, axis=1)
        np.testing.assert_allclose(share, along, atol=1e-12)


def test_results_are_read_back_and_damaged_ones_refused(tmp_path: Path) -> None:
    row = CaseResult("zero-force", "", "pod", "zero", "zero", "pass", {"largest": 0.0}, 0.1)
    told = {"pod": "equations, snapshots"}
    found, path = StressResults([row], "quick", {"cores": 2}, told), tmp_path / "stress.json"
    found.write(path)
    assert StressResults.read(path) == found
    assert stress_table(found, ["pod", "fem"]).rows[0][:2] == ["pod", "equations, snapshots"]
    assert "The method is told: equations, snapshots." in stress_table(found, ["pod"]).note
    content = json.loads(path.read_text())
    del content["told"]
    path.write_text(json.dumps(content))
    assert StressResults.read(path).told == {}
    path.write_text(path.read_text().replace('"pass"', '"perhaps"'))
    with pytest.raises(StoreError, match="not written by `mor-bench stress --out`"):
        StressResults.read(path)
