"""The hard cases: all are there, good methods pass them, bad ones fall short where they are bad, and nothing passes by itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from rich.console import Console

import mor_bench
from mor_bench import surrogate
from mor_bench.errors import InvalidInputError, MissingDependencyError, SpecError
from mor_bench.hard_cases import case as case_module
from mor_bench.hard_cases import mechanics_cases as mechanics
from mor_bench.hard_cases import reduction_cases as reduction
from mor_bench.hard_cases import setups
from mor_bench.hard_cases.catalogue import CASES, CaseResult
from mor_bench.hard_cases.suite import StressResults, stress
from mor_bench.mechanics import model as model_module
from mor_bench.mechanics.assembly import Assembler, Discretisation
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.stability import limit_load
from mor_bench.reduction.basis import Basis, pod
from mor_bench.reduction.cubature import SparseWeights
from mor_bench.report.hard_case_table import print_stress
from mor_bench.scene import soundness
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import MethodSpec, list_suite
from mor_bench.surrogates import pod as pod_module
from mor_bench.surrogates.fem import FullFEM
from mor_bench.surrogates.pod import PODGalerkin

SECTION: dict[str, list[tuple[str, ...]]] = {
    "inversion": [("inversion", "")],
    "snap-through": [("snap-through", "")],
    "near-incompressible": [("near-incompressible", "")],
    "slender 100:1": [("slender", "")],
    "one huge step": [("huge-step", "")],
    "distortion; stiffness contrast": [("distortion", ""), ("stiffness-contrast", "")],
    "unconstrained body": [("unconstrained", "")],
    "NaN, infinity, wrong shape, wrong dtype": [
        ("bad-forces", ""),
        ("bad-mesh", ""),
        ("bad-snapshots", ""),
    ],
    "poor snapshots": [("poor-snapshots", "")],
    "NNLS": [("nnls", "duplicated and badly scaled columns"), ("nnls", "one iteration only")],
    "ECSW with every element kept": [("ecsw-all-cells", "")],
    "out of distribution": [
        ("out-of-distribution", part)
        for part in ("2x", "4x", "unseen-regions", "unseen-directions", "several-forces")
    ],
    "zero force": [("zero-force", "")],
    "symmetry": [("symmetry", "")],
    "determinism": [("determinism", "two runs"), ("determinism", "batch of 1 and of 8")],
    "low precision": [("low-precision", "float32 forces"), ("low-precision", "bfloat16 inference")],
}
"""The hard cases that a simulation meets, and the cases that try them."""

ANY = {
    "bad-forces",
    "out-of-distribution",
    "zero-force",
    "symmetry",
    "determinism",
    "low-precision",
}
LEARNERS = {"bad-snapshots", "poor-snapshots"}
ANY_SOLVER = {"near-incompressible", "slender", "huge-step"}
FULL_ORDER = ANY_SOLVER | {
    "inversion",
    "snap-through",
    "distortion",
    "stiffness-contrast",
    "unconstrained",
    "bad-mesh",
}
CUBATURE = {"nnls", "ecsw-all-cells"}
CONCERNED = {
    "fem": ANY | FULL_ORDER,
    "fem-jacobi-pcg": ANY | ANY_SOLVER,
    "fem-pardiso": ANY | ANY_SOLVER,
    "fem-coarse": ANY,
    "linear-fem": ANY,
    "fem-warm": ANY | LEARNERS,
    "pod": ANY | LEARNERS,
    "hpod": ANY | LEARNERS | CUBATURE,
    "hybrid": ANY | LEARNERS,
    "pod-tensor": ANY | LEARNERS,
    "local-pod": ANY | LEARNERS,
    "autoencoder": ANY | LEARNERS,
    "modal-derivatives": ANY,
    "quadratic-manifold": ANY,
    "ecm": ANY | LEARNERS,
    "deim": ANY | LEARNERS,
    "pca-regression": ANY | LEARNERS,
    "pca-regression-force": ANY | LEARNERS,
    "umesh": ANY | LEARNERS,
    "explicit-dynamics": ANY,
    "pgd": ANY | LEARNERS,
    "pgd-force": ANY | LEARNERS,
    "umesh-small": ANY | LEARNERS,
    "umesh-linear": ANY | LEARNERS,
    "pca-ridge": ANY | LEARNERS,
    "pca-kernel-ridge": ANY | LEARNERS,
    "pca-gaussian-process": ANY | LEARNERS,
    "pca-random-forest": ANY | LEARNERS,
    "pca-extra-trees": ANY | LEARNERS,
    "pca-polynomial-force": ANY | LEARNERS,
    "pod-nn-force": ANY | LEARNERS,
    "sparse-polynomial-force": ANY | LEARNERS,
    "pod-nn": ANY | LEARNERS,
    "pod-nn-derivative": ANY | LEARNERS,
    "sparse-polynomial": ANY | LEARNERS,
    "sparse-polynomial-derivative": ANY | LEARNERS,
    "deeponet": ANY | LEARNERS,
    "pod-deeponet": ANY | LEARNERS,
    "fno": ANY | LEARNERS,
    "mesh-graph-net": ANY | LEARNERS,
    "gappy-pod": ANY | LEARNERS,
}


@pytest.fixture(scope="module", autouse=True)
def brief() -> Iterator[None]:
    """Trainings of a few iterations: nothing here depends on how good a method is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(case_module.LONGEST, "quick", 20)
        patch.setattr(case_module, "BRIEF", 3)
        yield


@pytest.fixture(scope="module")
def everything(cache: Path) -> StressResults:
    return stress(cache=cache)


def test_every_hard_case_is_there() -> None:
    assert {(case.name, case.part) for case in CASES} == {
        pair for pairs in SECTION.values() for pair in pairs
    }


def test_every_case_is_tried_on_every_method_that_it_concerns(everything: StressResults) -> None:
    """A new method file must be added here, with what concerns it."""
    assert set(CONCERNED) == set(list_suite("methods"))
    expected = {
        (case.name, case.part, name)
        for case in CASES
        for name, concerned in CONCERNED.items()
        if case.name in concerned
    }
    assert sorted((row.case, row.part, row.method) for row in everything.rows) == sorted(expected)


def test_the_suite_falls_short_where_its_limits_say_so_only(everything: StressResults) -> None:
    short = {
        (row.case, row.part, row.method, row.happened)
        for row in everything.rows
        if row.verdict == "fall short"
    }
    assert {(name, part, method) for name, part, method, _ in short} == {
        ("zero-force", "", "umesh"),
        ("zero-force", "", "umesh-small"),
    }
    skipped = {
        (row.case, row.part)
        for row in everything.rows
        if row.verdict == "not applicable" and row.method not in ("fem-pardiso", "gappy-pod")
    }
    assert skipped == {("low-precision", "bfloat16 inference")}


def test_errors_out_of_distribution_are_published_and_flagged(everything: StressResults) -> None:
    for row in everything.rows:
        if row.case == "out-of-distribution" and row.verdict != "not applicable":
            measured = row.measured
            worst = [
                np.inf if measured[key] is None else measured[key]
                for key in ("rel_l2_median", "rel_l2_p95", "rel_l2_max")
            ]
            assert 0 <= worst[0] <= worst[1] <= worst[2]
            assert (
                worst[2] < np.inf or row.method == "deim"
            )  # which has no answer to a few loads, as its limits say
            assert measured["n"] >= 50
            assert ("flagged" in measured) == (CONCERNED[row.method] >= LEARNERS)


def test_the_table_has_every_row_and_the_count(everything: StressResults, tmp_path: Path) -> None:
    console = Console(width=160, record=True, file=(tmp_path / "out").open("w"))
    print_stress(everything, console)
    text = console.export_text()
    assert f"{len(everything.rows)} tried: {everything.count('pass')} pass, 2 fall short" in text
    assert "Fall short: zero-force of umesh" in text
    for name in list_suite("methods"):
        assert text.count(f" {name} ") == sum(row.method == name for row in everything.rows)


def method_file(folder: Path, name: str, surrogate: str = "", parameters: str = "") -> Path:
    path = folder / f"{name}.toml"
    target = surrogate or f"tests.test_stress:{name.capitalize()}"
    path.write_text(
        f'title = "t"\nsource = "s"\nsurrogate = "{target}"\n[parameters]\n{parameters}',
        encoding="utf-8",
    )
    return path


def tried(found: StressResults) -> dict[tuple[str, str], CaseResult]:
    return {(row.case, row.part): row for row in found.rows}


def short_of(found: StressResults) -> set[tuple[str, str]]:
    return {key for key, row in tried(found).items() if row.verdict == "fall short"}


class Good(PODGalerkin):
    """A third party's method with nothing wrong."""


class Bad(PODGalerkin):
    """Answers no force with a displacement, never twice the same, and takes NaN for zero."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        answer = super().predict(np.nan_to_num(np.asarray(forces)))
        return answer + 0.01 + 1e-5 * np.random.default_rng().normal(size=answer.shape)


class Crashing(PODGalerkin):
    """Divides by zero where there is no force, as in some poor snapshots."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        answer = super().predict(forces)
        if answer.size and not np.any(np.asarray(forces)):
            raise ZeroDivisionError("on purpose")
        return answer


class Rounding(PODGalerkin):
    """Loses a fifth of the answer in single precision."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        return super().predict(forces) * (0.8 if np.asarray(forces).dtype == np.float32 else 1.0)


class Unchecked(PODGalerkin):
    """Learns whatever it is given, and does not know its range."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        assert snapshots is not None
        known = np.nan_to_num(snapshots.free_displacements)
        modes = np.linalg.svd(known, full_matrices=False)[2][:5].T
        return self.restore(scene, {"modes": np.nan_to_num(modes)})


class Unfit(PODGalerkin):
    """Cannot be fitted."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        raise ZeroDivisionError("on purpose")


class Ending(PODGalerkin):
    """Ends Python where there is no force."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        if not np.asarray(forces).any():
            os._exit(7)
        return super().predict(forces)


class Alarmed(PODGalerkin):
    """Flags every load."""

    def out_of_range(self, forces: ArrayLike) -> NDArray[np.bool_]:
        return np.ones(np.shape(forces)[:-2], dtype=bool)


class Careless(PODGalerkin):
    """Flags none."""

    def out_of_range(self, forces: ArrayLike) -> NDArray[np.bool_]:
        return np.zeros(np.shape(forces)[:-2], dtype=bool)


class Elsewhere(PODGalerkin):
    """Supports no scene."""

    def supports(self, scene: Scene) -> str | None:
        return "it is for other scenes"


OUT = set(SECTION["out of distribution"])

FLAWS: dict[str, set[tuple[str, ...]]] = {
    "good": set(),
    "bad": {("zero-force", ""), ("bad-forces", ""), *SECTION["determinism"]},
    "crashing": {("zero-force", ""), ("poor-snapshots", "")},
    "rounding": {("low-precision", "float32 forces")},
    "alarmed": OUT,
    "careless": OUT,
    "elsewhere": set(),
}
"""Methods of this file, and where each falls short."""


@pytest.mark.parametrize("name", list(FLAWS))
def test_a_method_falls_short_exactly_where_it_is_bad(
    name: str, tmp_path: Path, cache: Path
) -> None:
    found = stress([method_file(tmp_path, name)], cache=cache)
    assert short_of(found) == FLAWS[name]
    assert {row.case for row in found.rows} == ANY | LEARNERS
    if name == "elsewhere":
        assert {(row.verdict, row.happened) for row in found.rows} == {
            ("not applicable", "it is for other scenes")
        }
    if name == "crashing":
        assert (
            tried(found)["zero-force", ""].happened == "crashed with ZeroDivisionError: on purpose"
        )


def test_a_learner_that_does_not_check_its_samples_falls_short(tmp_path: Path, cache: Path) -> None:
    found = stress(
        [method_file(tmp_path, "unchecked")], ["out-of-distribution", "bad-snapshots"], cache=cache
    )
    assert short_of(found) == {*OUT, ("bad-snapshots", "")}
    assert "not known" in tried(found)["out-of-distribution", "2x"].happened


def test_a_fit_that_fails_costs_its_own_method_only(tmp_path: Path, cache: Path) -> None:
    broken = method_file(tmp_path, "broken", "tests.test_stress:Unfit", "n_modes = 3")
    good = method_file(tmp_path, "good")
    found = stress([broken, good], ["zero-force", "symmetry"], cache=cache)
    assert [(row.method, row.verdict) for row in found.rows] == [("broken", "fall short")] * 2 + [
        ("good", "pass")
    ] * 2


def test_a_method_that_ends_its_process_costs_its_own_rows_only(
    tmp_path: Path, cache: Path
) -> None:
    methods = [
        method_file(tmp_path, "ending", "tests.test_stress:Ending", "n_modes = 3"),
        method_file(tmp_path, "good"),
    ]
    found = stress(methods, ["zero-force", "symmetry"], cache=cache)
    assert [(row.method, row.case, row.verdict) for row in found.rows[:2]] == [
        ("ending", "zero-force", "fall short"),
        ("ending", "symmetry", "pass"),
    ]
    assert "ended with code 7" in found.rows[0].happened
    assert {row.verdict for row in found.rows[2:]} == {"pass"}


def test_nothing_to_try_is_an_error(cache: Path) -> None:
    with pytest.raises(InvalidInputError, match="none of the cases nnls concerns fem"):
        stress(["fem"], ["nnls"], cache=cache)
    with pytest.raises(InvalidInputError, match="`methods` must be a list"):
        stress("pod", cache=cache)


def answered(*_: Any, **__: Any) -> Solution:
    return Solution(np.array([-0.5]), 0.5, 1, 0)


def silently(snapshots: NDArray[np.float64], n_modes: int | None = None, **_: Any) -> Basis:
    basis = pod(snapshots)
    return Basis(basis.modes[:, :n_modes], basis.singular_values)


def lopsided(mesh: Any, law: Any = setups.LAW, selective: bool = False) -> Assembler:
    dofs = np.arange(mesh.n_dofs).reshape(-1, 3)
    weights = 1 + 0.1 * np.arange(mesh.n_cells)
    return Assembler(
        Discretisation(mesh.points, mesh.cells, law, selective), dofs, mesh.n_dofs, weights
    )


def optimistic(
    matrix: NDArray[np.float64],
    target: NDArray[np.float64],
    tolerance: float,
    max_iterations: int | None = None,
) -> SparseWeights:
    return SparseWeights(np.ones(matrix.shape[1]), 0.0, 0.0, 0.0, 1)


def askew(self: FullFEM, forces: ArrayLike) -> NDArray[np.float64]:
    answer = _predict(self, forces)
    answer[..., -1, 1] += 1e-9
    return answer


_predict = FullFEM.predict

PLANTS: dict[str, tuple[str, str, str, Any, str, Any]] = {
    "inversion": ("fem", "inversion", "", mechanics, "solve_equilibrium", answered),
    "a limit that is too high": (
        "fem",
        "snap-through",
        "",
        mechanics,
        "limit_load",
        lambda *a: replace(limit_load(*a), factor=0.2),
    ),  # type: ignore[type-var]
    "no limit": ("fem", "snap-through", "", mechanics, "limit_load", lambda *_: None),
    "a path beyond its limit": (
        "fem",
        "snap-through",
        "",
        mechanics,
        "solve_on_path",
        lambda *_: None,
    ),
    "locking not said": (
        "fem",
        "near-incompressible",
        "",
        model_module,
        "warn_of_locking",
        lambda _: None,
    ),
    "shear locking not reported": (
        "fem",
        "slender",
        "",
        mechanics,
        "limit_of",
        lambda ends: (ends[0], None, "finest"),
    ),
    "cut-backs not counted": ("fem", "huge-step", "", mechanics, "solve_equilibrium", answered),
    "a patch test that fails": ("fem", "distortion", "", setups, "free_assembler", lopsided),
    "condition told too small": (
        "fem",
        "stiffness-contrast",
        "",
        mechanics,
        "condition_number",
        lambda *_: 1.0,
    ),
    "ill-conditioning not said": (
        "fem",
        "stiffness-contrast",
        "",
        model_module,
        "ILL_CONDITIONED",
        np.inf,
    ),
    "supports not checked": (
        "fem",
        "unconstrained",
        "",
        model_module,
        "check_supports",
        lambda _: None,
    ),
    "meshes not checked": ("fem", "bad-mesh", "", soundness, "check_numbers", lambda *_: None),
    "modes cut without a word": ("pod", "poor-snapshots", "", pod_module, "pod", silently),
    "weights that miss": (
        "hpod",
        "nnls",
        "duplicated and badly scaled columns",
        reduction,
        "sparse_nnls",
        optimistic,
    ),
    "a cap not told of": (
        "hpod",
        "nnls",
        "one iteration only",
        reduction,
        "sparse_nnls",
        optimistic,
    ),
    "ECSW unlike POD": (
        "hpod",
        "ecsw-all-cells",
        "",
        reduction,
        "PODGalerkin",
        lambda n, tolerance: PODGalerkin(n - 1, tolerance),
    ),
    "snapshots not checked": (
        "pod",
        "bad-snapshots",
        "",
        surrogate,
        "checked_samples",
        lambda owner, scene, snapshots: snapshots,
    ),
    "a model askew": ("fem", "symmetry", "", FullFEM, "predict", askew),
}
"""Method, case and part; and what is put in the place of what, so that it falls short."""


@pytest.mark.parametrize("plant", list(PLANTS))
def test_what_goes_wrong_is_seen(
    plant: str, everything: StressResults, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, name, part, where, what, wrong = PLANTS[plant]
    assert [
        row.verdict
        for row in everything.rows
        if (row.method, row.case, row.part) == (method, name, part)
    ] == ["pass"]
    monkeypatch.setattr(where, what, wrong)
    assert tried(stress([method], [name], cache=cache))[name, part].verdict == "fall short"


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


BAD_ARGUMENTS: dict[str, tuple[dict[str, Any], str]] = {
    "profile": ({"profile": "slow"}, "`profile` must be quick or full; got 'slow'"),
    "case": ({"cases": ["zero-forces"]}, "got 'zero-forces'; did you mean 'zero-force'?"),
    "method": ({"methods": ["podd"]}, "unknown method 'podd'"),
}


@pytest.mark.parametrize("bad", list(BAD_ARGUMENTS))
def test_bad_arguments_are_refused(bad: str, cache: Path) -> None:
    arguments, message = BAD_ARGUMENTS[bad]
    with pytest.raises((InvalidInputError, SpecError)) as caught:
        stress(cache=cache, **arguments)
    assert message in str(caught.value)


def test_numbers_that_are_not_finite_can_be_written(tmp_path: Path) -> None:
    rows = [CaseResult("zero-force", "", "m", "e", "h", "pass", {"ratio": None}, 0.1)]
    StressResults(rows, "quick", {}).write(tmp_path / "new" / "stress.json")
    assert json.loads((tmp_path / "new" / "stress.json").read_text())["rows"][0]["measured"] == {
        "ratio": None
    }


def test_the_command_line(tmp_path: Path, cache: Path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "mor_bench", "stress", "--cache", str(cache), *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    options = ["-m", "umesh", "-m", "linear-fem", "--case", "zero-force", "--case", "symmetry"]
    done = run(*options, "--json", "--out", "stress.json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert [(row["method"], row["case"]) for row in printed["rows"]] == [
        (m, c) for m in ("umesh", "linear-fem") for c in ("zero-force", "symmetry")
    ]
    written = json.loads((tmp_path / "stress.json").read_text(encoding="utf-8"))
    assert written == printed
    assert "4 tried: 3 pass, 1 fall short" in done.stderr
    wrong = run("--case", "zero")
    assert wrong.returncode == 2
    assert "`cases` must be of" in wrong.stderr


def test_inputs_are_those_of_the_dataset(cache: Path) -> None:
    scenes = case_module.Scenes(cache)
    assert scenes.tiny.scene.name == "beam-tiny"
    for part, along in (
        (scenes.pressed.train, 1.0),
        (scenes.pressed.tests["unseen-directions"], 0.0),
    ):
        vectors = part.loads.vectors[:, 0]
        np.testing.assert_allclose(
            np.abs(vectors[:, 2]) / np.linalg.norm(vectors, axis=1), along, atol=1e-12
        )
    assert (
        mor_bench.load_dataset("beam-tiny", cache=cache).train.forces.shape
        == scenes.tiny.train.forces.shape
    )
