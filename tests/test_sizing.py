"""Hyperparameters chosen from the scene's need: the choice, its evidence, and its storage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, StoreError, UnsupportedSceneError
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.reduction import sizing
from mor_bench.reduction.sizing import MODES, Score, Trials, choose_sizes, validation_folds
from mor_bench.runs.cached_fit import CachedFit
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.handover import write_snapshots
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import load_method_spec
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pca_regression import PCARegression
from mor_bench.surrogates.pod import PODGalerkin
from tests.model_files import rewrite
from tests.relative_errors import median_error, relative_l2
from tests.small_runs import method_file


def needing(scene: Scene, error: float) -> Scene:
    """Return the scene with another need."""
    return replace(
        scene,
        spec=scene.spec.model_copy(
            update={"needs": scene.spec.needs.model_copy(update={"error": error})}
        ),
    )


@pytest.mark.slow
def test_the_smallest_number_of_modes_that_meets_the_need_is_chosen(coarse: Dataset) -> None:
    scene = needing(coarse.scene, 0.05)
    fitted = PODGalerkin("auto", 1e-3).fit(scene, coarse.train)
    n_modes = fitted.sizes_["n_modes"]
    trials = Trials(PODGalerkin("auto", 1e-3), scene, coarse.train)
    assert (
        trials.score({"n_modes": n_modes}).error
        <= 0.05
        < trials.score({"n_modes": MODES[MODES.index(n_modes) - 1]}).error
    )
    assert PODGalerkin("auto", 1e-3).fit(scene, coarse.train).sizes_ == {"n_modes": n_modes}
    # The model itself is fitted to all samples.
    np.testing.assert_array_equal(
        fitted.modes_, PODGalerkin(n_modes, 1e-3).fit(scene, coarse.train).modes_
    )
    assert (
        PODGalerkin("auto", 1e-3).fit(needing(coarse.scene, 0.2), coarse.train).sizes_["n_modes"]
        < n_modes
    )


@pytest.mark.slow
def test_the_score_comes_from_models_that_never_saw_the_load_region(coarse: Dataset) -> None:
    trials = Trials(PODGalerkin("auto", 1e-3), coarse.scene, coarse.train)
    score = trials.score({"n_modes": 24})
    errors = []
    for fitted, held in validation_folds(coarse.train):
        assert not set(coarse.train.regions[fitted]) & set(coarse.train.regions[held])
        model = PODGalerkin(24, 1e-3).fit(coarse.scene, coarse.train[fitted])
        few = coarse.train[held]
        errors += list(relative_l2(model.predict(few.forces), few.displacements))
    assert score.error == pytest.approx(np.median(errors), rel=1e-9)
    seen = PODGalerkin(24, 1e-3).fit(coarse.scene, coarse.train)
    assert median_error(seen, coarse.train[::4]) < 0.8 * score.error


@pytest.mark.parametrize("n_forces", [1, 2])
def test_every_load_region_is_held_out_once(n_forces: int, coarse: Dataset) -> None:
    rng = np.random.default_rng(0)
    patches = np.sort(rng.integers(40, size=(600, n_forces)), axis=1) * 3
    snapshots = replace(
        coarse.train[np.arange(600) % len(coarse.train)],
        loads=PatchLoads(patches, np.ones((600, n_forces, 3))),
    )
    folds = validation_folds(snapshots)
    held_regions = [set(patches[held].ravel()) for _, held in folds]
    assert len(folds) == sizing.N_FOLDS
    assert sorted(region for regions in held_regions for region in regions) == sorted(
        {*patches.ravel()}
    )
    for fitted, held in folds:
        assert not set(patches[fitted].ravel()) & set(patches[held].ravel())
        assert len(held) <= sizing.N_VALIDATION // sizing.N_FOLDS
    if n_forces == 1:
        assert all(
            len(fitted) + (~np.isin(np.arange(600), fitted)).sum() == 600 and len(fitted) > 400
            for fitted, _ in folds
        )


def test_samples_of_a_single_region_are_divided_among_the_folds(tiny: Dataset) -> None:
    forces = tiny.train.forces[:11]
    imported = replace(tiny.train[:11], loads=NodalLoads(forces, np.zeros((11, 1), dtype=np.int64)))
    folds = validation_folds(imported)
    assert sorted(np.concatenate([held for _, held in folds])) == list(range(11))
    for fitted, held in folds:
        assert sorted([*fitted, *held]) == list(range(11))
    with pytest.raises(InvalidInputError, match="at least two training samples"):
        PODGalerkin("auto").fit(tiny.scene, tiny.train[:1])


ERROR: dict[str, Callable[[float], float]] = {
    "n_modes": lambda n: 0.5 / n,
    "cubature_tolerance": lambda t: 0.3 * t,
    "tolerance": lambda t: 0.02 * t,
}
WORK: dict[str, Callable[[float], float]] = {
    "n_modes": lambda n: 50 + n**2,
    "cubature_tolerance": lambda t: 1 - 0.2 * np.log10(t),
    "tolerance": lambda t: 1 - 0.3 * np.log10(t),
}


@pytest.mark.parametrize("need", [0.4, 0.05, 0.02, 0.009])
def test_the_search_finds_the_least_work_with_few_trials(
    need: float, monkeypatch: pytest.MonkeyPatch, tiny: Dataset
) -> None:
    """With monotone error and work, the choice equals that of an exhaustive search."""
    tried: list[Mapping[str, Any]] = []

    def score(knobs: Mapping[str, Any]) -> Score:
        return Score(
            sum(ERROR[name](value) for name, value in knobs.items()),
            float(np.prod([WORK[name](value) for name, value in knobs.items()])),
        )

    def counted(self: Trials, knobs: Mapping[str, Any], hopeless: float = 4.0) -> Score:
        tried.append(knobs)
        return score(knobs)

    monkeypatch.setattr(Trials, "tried", counted)
    rungs = {
        "n_modes": MODES,
        "cubature_tolerance": (1e-1, 1e-2, 1e-3),
        "tolerance": (1e-1, 1e-2, 1e-3),
    }
    method = HyperReducedPOD("auto", "auto", tolerance="auto")
    chosen = choose_sizes(method, needing(tiny.scene, need), tiny.train, rungs)
    every = [dict(zip(rungs, values, strict=True)) for values in product(*rungs.values())]
    best = min(
        (knobs for knobs in every if score(knobs).error <= need),
        key=lambda knobs: score(knobs).work,
    )
    assert chosen == best
    assert len(tried) < 0.15 * len(every)


def test_given_hyperparameters_are_not_changed(tiny: Dataset) -> None:
    method = PODGalerkin(7, 1e-3)
    assert choose_sizes(method, tiny.scene, tiny.train, {"n_modes": MODES}) == {}
    assert method.fit(tiny.scene, tiny.train).sizes_ == {}
    sized = PODGalerkin("auto", 1e-3).fit(tiny.scene, tiny.train)
    sized.n_modes = 4
    assert sized.fit(tiny.scene, tiny.train).sizes_ == {}


def test_an_unreachable_need_gives_the_most_accurate_model_with_a_warning(tiny: Dataset) -> None:
    with pytest.warns(
        UserWarning,
        match=r"relative l2 error of 1e-12. The most accurate .*, n_modes = \d+, reaches 0\.0",
    ) as caught:
        fitted = PODGalerkin("auto", 1e-3).fit(needing(tiny.scene, 1e-12), tiny.train)
    reached = float(
        str(next(w.message for w in caught if "reaches" in str(w.message)))
        .split("reaches ")[1]
        .split()[0]
    )
    trials = Trials(PODGalerkin("auto", 1e-3), needing(tiny.scene, 1.0), tiny.train)
    assert trials.score(fitted.sizes_).error == pytest.approx(reached, rel=1e-2)
    assert reached < 0.5 * trials.score({"n_modes": 5}).error


def test_an_error_says_that_no_size_could_be_fitted(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any, **__: Any) -> None:
        raise InvalidInputError("nothing fits.")

    monkeypatch.setattr("mor_bench.surrogates.pod.pod", failing)
    with pytest.raises(
        InvalidInputError, match="no n_modes can be chosen automatically: nothing fits"
    ):
        PODGalerkin("auto").fit(tiny.scene, tiny.train)


@pytest.mark.slow
def test_both_hyperparameters_of_hyper_reduction_are_chosen(coarse: Dataset) -> None:
    scene = needing(coarse.scene, 0.05)
    fitted = HyperReducedPOD("auto", "auto", n_cubature_snapshots=60, tolerance=1e-3).fit(
        scene, coarse.train
    )
    trials = Trials(
        HyperReducedPOD("auto", "auto", n_cubature_snapshots=60, tolerance=1e-3),
        scene,
        coarse.train,
    )
    score = trials.score(fitted.sizes_)
    tight = (
        HyperReducedPOD("auto", 1e-3, n_cubature_snapshots=60, tolerance=1e-3)
        .fit(scene, coarse.train)
        .sizes_
    )
    assert score.error <= 0.05
    assert score.work <= trials.score({**tight, "cubature_tolerance": 1e-3}).work
    again = HyperReducedPOD(**{**fitted.parameters, **fitted.sizes_}).fit(scene, coarse.train)
    np.testing.assert_array_equal(again.weights_, fitted.weights_)


def test_chosen_sizes_are_saved_and_loaded(tiny: Dataset, tmp_path: Path) -> None:
    fitted = PODGalerkin("auto", "auto").fit(needing(tiny.scene, 0.2), tiny.train)
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    loaded = mor_bench.load_surrogate(path)
    assert isinstance(loaded, PODGalerkin)
    assert loaded.parameters == fitted.parameters
    assert loaded.sizes_ == fitted.sizes_
    assert {name: type(value) for name, value in loaded.sizes_.items()} == {
        "n_modes": int,
        "tolerance": float,
    }
    np.testing.assert_array_equal(
        loaded.predict(tiny.test.forces[:3]), fitted.predict(tiny.test.forces[:3])
    )
    plain = PODGalerkin(**{**fitted.parameters, **fitted.sizes_}).fit(tiny.scene, tiny.train)
    np.testing.assert_array_equal(
        plain.predict(tiny.test.forces[:3]), fitted.predict(tiny.test.forces[:3])
    )


@pytest.mark.parametrize(
    "forgery",
    [
        {"size.tolerance": None},
        {"size.tolerance": np.array([7.0])},
        {"size.n_modes": np.array([3])},
    ],
)
def test_forged_sizes_are_refused(forgery: dict[str, Any], tiny: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    PODGalerkin(5, "auto").fit(needing(tiny.scene, 0.5), tiny.train).save(path)
    rewrite(path, lambda arrays: _replace(arrays, forgery))
    with pytest.raises(StoreError, match=r"model\.safetensors"):
        mor_bench.load_surrogate(path)


def _replace(arrays: dict[str, Any], forgery: dict[str, Any]) -> None:
    """Replace arrays; None deletes."""
    for name, array in forgery.items():
        arrays[name] = array
        if array is None:
            del arrays[name]


@pytest.mark.slow
def test_the_record_of_a_fit_shows_the_chosen_sizes(tmp_path: Path, tiny: Dataset) -> None:
    write_snapshots(tmp_path / "train", tiny.train)
    session = MethodSession(tiny.scene)
    surrogate = "mor_bench.surrogates.pod:PODGalerkin"
    shown = []
    for knobs in ({"n_modes": "auto", "tolerance": 1e-3}, {"n_modes": 3}):
        request = FitRequest(
            surrogate, knobs, tmp_path / "train", tmp_path / "model.safetensors", 1, 60.0
        )
        answer = session.fit(request)
        assert answer["parameters"].items() >= knobs.items()
        shown.append(answer["sizes"])
    assert shown == [PODGalerkin("auto", 1e-3).fit(tiny.scene, tiny.train).sizes_, {}]


def test_a_cached_fit_depends_on_the_need_only_if_sizes_are_chosen(
    tmp_path: Path, tiny: Dataset
) -> None:
    pod = "mor_bench.surrogates.pod:PODGalerkin"
    path = method_file(tmp_path, "sized", pod, n_modes="auto", tolerance=1e-3)
    place: Any = SimpleNamespace(machine="here", fit_threads=1, cache=tmp_path)

    def key(need: float, **knobs: Any) -> str:
        job: Any = SimpleNamespace(
            method=load_method_spec(path),
            parameters=knobs,
            training=None,
            shipped=None,
        )
        data = TrainingData(needing(tiny.scene, need), tiny.train, tiny.validation, {}, tmp_path)
        return CachedFit(job, data, place).key

    assert key(0.1, n_modes="auto") != key(0.2, n_modes="auto")
    assert key(0.1, n_modes=3) == key(0.2, n_modes=3)


def test_a_method_that_needs_no_equations_is_sized_on_imported_samples(
    tiny: Dataset, cache: Path
) -> None:
    """Such samples have forces on all nodes and no material; load regions are optional."""
    imported = replace(tiny.train, loads=NodalLoads(tiny.train.forces, tiny.train.loads.patches))
    for (fitted, held), (same_fitted, same_held) in zip(
        validation_folds(imported), validation_folds(tiny.train), strict=True
    ):
        np.testing.assert_array_equal(fitted, same_fitted)
        np.testing.assert_array_equal(held, same_held)
    scene = replace(tiny.scene, material=None)
    with pytest.raises(UnsupportedSceneError):
        PODGalerkin("auto").fit(scene, imported)
    method: Any = PCARegression("force", n_input_modes=20, n_output_modes=20, degree=1)
    method.n_output_modes = "auto"
    chosen = choose_sizes(method, needing(scene, 1.5), imported, {"n_output_modes": MODES})
    assert chosen["n_output_modes"] in MODES


@pytest.mark.slow
def test_only_errors_of_the_requested_nodes_decide(tiny: Dataset) -> None:
    """A reduced method predicts nothing at other nodes, which is no error."""
    needs = tiny.scene.spec.needs.model_copy(update={"outputs": "x-max", "error": 0.1})
    scene = replace(tiny.scene, spec=tiny.scene.spec.model_copy(update={"needs": needs}))
    method = PODGalerkin("auto", 1e-4).fit(scene, replace(tiny.train, scene=scene))
    everywhere = PODGalerkin("auto", 1e-4).fit(needing(tiny.scene, 0.1), tiny.train)
    assert (
        1 <= method.sizes_["n_modes"] < everywhere.sizes_["n_modes"]
    )  # the loaded end moves as a whole
