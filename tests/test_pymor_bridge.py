"""A scene as a model of pyMOR gives this package's solutions, and pyMOR's reduction works on it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.adapters import pymor_model as doors
from mor_bench.errors import (
    InvalidInputError,
    MissingDependencyError,
    SolverError,
    SpecError,
    UnsupportedSceneError,
)
from mor_bench.method_loading import make_surrogate
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import load_class
from tests.small_runs import method_file, run_small

pytest.importorskip("pymor", reason="needs the extra `pymor`")

from pymor.algorithms.pod import pod
from pymor.core.exceptions import InversionError
from pymor.reductors.basic import StationaryRBReductor
from pymor.reductors.coercive import CoerciveRBReductor
from pymor.solvers.newton import NewtonSolver

from mor_bench.adapters.pymor_pod import PymorPOD, quiet

CLASS = "mor_bench.adapters.pymor_pod:PymorPOD"


def relative(found: Any, expected: Any) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def patch_factors(data: Dataset, sample: int) -> Any:
    """Return the parameter of `patch_loads` for a test sample."""
    loads = data.test.loads
    assert isinstance(loads, PatchLoads)
    factors = np.zeros((len(data.scene.patch_nodes), 3))
    factors[loads.patches[sample]] = loads.vectors[sample]
    return factors.ravel()


def test_pymor_finds_the_solution_of_the_full_order_model(tiny: Dataset) -> None:
    """By this package's solver, and by pyMOR's own Newton iteration on operator and Jacobian."""
    scene, expected = tiny.scene, tiny.test.displacements[3]
    by_patch = doors.pymor_model(scene, doors.patch_loads(scene), tolerance=1e-10)
    by_force = doors.pymor_model(scene, tolerance=1e-10)
    newton = NewtonSolver(rtol=1e-12, error_measure="residual")
    own = by_force.with_(operator=by_force.operator.with_(solver=newton))
    parameters = {"load": patch_factors(tiny, 3)}, {"load": tiny.test.free_forces[3]}
    with quiet():
        for model, mu in zip((by_patch, by_force, own), (*parameters, parameters[1]), strict=True):
            found = doors.from_vector_array(scene, model.solve(mu))[0]
            assert relative(found, expected) < 1e-7


def test_the_jacobian_is_the_derivative_of_the_operator(tiny: Dataset) -> None:
    model = doors.pymor_model(tiny.scene)
    fields = tiny.test.displacements[:2]
    u, v = (
        doors.to_vector_array(tiny.scene, fields[:1]),
        doors.to_vector_array(tiny.scene, fields[1:]),
    )
    h = 1e-6
    change = (model.operator.apply(u + v * h) - model.operator.apply(u - v * h)) * (0.5 / h)
    exact = model.operator.jacobian(u).apply(v)
    assert relative(change.to_numpy(), exact.to_numpy()) < 1e-8
    both = model.operator.apply(doors.to_vector_array(tiny.scene, fields)).to_numpy()
    np.testing.assert_array_equal(both[:, 0], model.operator.apply(u).to_numpy()[:, 0])
    rest = model.operator.jacobian(model.solution_space.zeros())
    np.testing.assert_array_equal(rest.matrix.toarray(), model.stiffness_product.matrix.toarray())


def test_fields_survive_the_way_to_vector_arrays_and_back(tiny: Dataset) -> None:
    fields = tiny.test.displacements
    vectors = doors.to_vector_array(tiny.scene, fields)
    assert (len(vectors), vectors.dim) == (len(fields), len(tiny.scene.free_dofs))
    np.testing.assert_array_equal(doors.from_vector_array(tiny.scene, vectors), fields)


def test_pymor_reduces_the_model_as_this_package_does(tiny: Dataset) -> None:
    """With 8 modes of the energy norm, by both kinds of load."""
    scene = tiny.scene
    factors = patch_factors(tiny, 5)
    ours = mor_bench.load_method("pod", n_modes=8, tolerance=1e-9, inner_product="stiffness")
    expected = ours.fit(scene, tiny.train).predict(tiny.test.forces[5])
    parameters = (doors.patch_loads(scene), factors), (None, tiny.test.free_forces[5])
    for loads, mu in parameters:
        model = doors.pymor_model(scene, loads)
        with quiet():
            snapshots = doors.to_vector_array(scene, tiny.train.displacements)
            modes, _ = pod(snapshots, product=model.stiffness_product, modes=8)
            reductor = StationaryRBReductor(model, modes, product=model.stiffness_product)
            reduced = reductor.reduce()
            solution = reductor.reconstruct(reduced.solve({"load": mu}))
        assert reduced.solution_space.dim == 8
        assert relative(doors.from_vector_array(scene, solution)[0], expected) < 1e-6


@pytest.mark.parametrize("n_modes", [4, 12])
def test_the_method_errs_as_much_as_pod_with_equal_modes(n_modes: int, tiny: Dataset) -> None:
    theirs = PymorPOD(n_modes=n_modes).fit(tiny.scene, tiny.train)
    ours = mor_bench.load_method("pod", n_modes=n_modes, tolerance=1e-8)
    ours.fit(tiny.scene, tiny.train)
    forces, exact = tiny.test.forces[:10], tiny.test.displacements[:10]
    found, expected = theirs.predict(forces), ours.predict(forces)
    assert relative(found, expected) < 1e-6
    errors = [np.linalg.norm(u - exact, axis=(1, 2)) for u in (found, expected)]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-4)
    assert errors[0].min() > 0


COERCIVE = "pymor.reductors.coercive:CoerciveRBReductor"


def test_a_reductor_is_named_by_its_import_path(tiny: Dataset) -> None:
    method: Any = make_surrogate(PymorPOD, {"n_modes": 3, "reductor": COERCIVE})
    method.fit(tiny.scene, tiny.train)
    assert type(method.reductor_) is CoerciveRBReductor
    usual = PymorPOD(n_modes=3).fit(tiny.scene, tiny.train)
    assert type(usual.reductor_) is StationaryRBReductor
    force = tiny.test.forces[0]
    assert relative(method.predict(force), usual.predict(force)) < 1e-6


def test_a_reductor_that_cannot_reduce_the_model_gives_one_error(tiny: Dataset) -> None:
    other = COERCIVE.replace("Coercive", "SimpleCoercive")
    method = PymorPOD(n_modes=3, reductor=other)
    with pytest.raises(InvalidInputError, match=r"SimpleCoer.* cannot reduce beam-tiny: Assertion"):
        method.fit(tiny.scene, tiny.train)


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("os:System", "it must name a reductor as"),
        ("pymor.reductors.basic:StationaryRBReductor()", "it must name a reductor as"),
        ("pymor.reductors.basics:StationaryRBReductor", "there is no module 'pymor.reductors.basi"),
        ("pymor.reductors.basic:StationaryRBReducto", "did you mean 'StationaryRBReductor'"),
        ("pymor.reductors.basic:InstationaryRBReductor", "is no StationaryRBReductor or subclass"),
        ("pymor.reductors.basic:StationaryModel", "is no StationaryRBReductor or subclass"),
    ],
)
def test_other_reductors_are_refused(target: str, reason: str) -> None:
    with pytest.raises(SpecError, match=f"`reductor`.*{reason}"):
        make_surrogate(PymorPOD, {"reductor": target})


def test_a_fitted_method_survives_its_file(tiny: Dataset, tmp_path: Path) -> None:
    from mor_bench.method_loading import load_fitted

    method = PymorPOD(n_modes=3).fit(tiny.scene, tiny.train)
    method.save(tmp_path / "model.safetensors")
    again = load_fitted(tmp_path / "model.safetensors", PymorPOD, tiny.scene)
    force = tiny.test.forces[0]
    np.testing.assert_array_equal(again.predict(force), method.predict(force))


def test_a_load_without_equilibrium_is_an_error_of_each_side(tiny: Dataset) -> None:
    force = 1e6 * tiny.test.free_forces[0]
    model = doors.pymor_model(tiny.scene)
    model.disable_logging()
    with pytest.raises(InversionError, match="elements invert: stopped at"):
        model.solve({"load": force})
    method = PymorPOD(n_modes=3, tolerance=1e-40).fit(tiny.scene, tiny.train)
    with pytest.raises(SolverError, match="pyMOR's Newton iteration failed: Failed to converge"):
        method.predict(tiny.test.forces[0])


@pytest.mark.slow
def test_the_method_competes_in_a_run(tiny: Dataset, cache: Path, tmp_path: Path) -> None:
    path = method_file(tmp_path, "pymor-pod", CLASS, n_modes=3)
    ours = method_file(tmp_path, "our-pod", "mor_bench.surrogates.pod:PODGalerkin", n_modes=3)
    rows = run_small([path, ours], tmp_path / "out", cache).rows
    assert [row.status for row in rows] == ["ok", "ok"]
    theirs, mine = (row.error.rel_l2_median for row in rows if row.error)
    assert theirs == pytest.approx(mine, rel=1e-3)


ZERO = np.zeros((1, 63, 3))

REFUSED: list[tuple[Callable[[Scene], object], str]] = [
    (lambda s: doors.pymor_model(s, np.zeros((2, 5, 3))), r"`loads` .* \(n, 63, 3\); got float64"),
    (lambda s: doors.pymor_model(s, np.zeros((0, 63, 3))), "at least one field of forces"),
    (lambda s: doors.pymor_model(s, np.full((1, 63, 3), np.nan)), "`loads` must be finite"),
    (lambda s: doors.pymor_model(s, tolerance=2.0), r"`tolerance` must be in \(0, 1\]; got 2.0"),
    (lambda s: doors.to_vector_array(s, np.zeros((1, 63))), "`fields` must be real numbers"),
    (lambda s: doors.from_vector_array(s, ZERO), "must be a vector array of pyMOR; got ndarray"),
    (
        lambda s: doors.from_vector_array(
            replace(s, fixed_nodes=s.fixed_nodes[:1]), doors.to_vector_array(s, ZERO)
        ),
        "`vectors` must have 186 components, the free dofs of beam-tiny; got 162",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_wrong_input_is_refused(
    call: Callable[[Scene], object], message: str, tiny_scene: Scene
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        call(tiny_scene)


def test_a_scene_that_cannot_be_a_model_is_refused_with_its_reason(tiny: Dataset) -> None:
    unknown = replace(tiny.scene, material=None)
    with pytest.raises(UnsupportedSceneError, match="beam-tiny cannot be a model of pyMOR: its sn"):
        doors.pymor_model(unknown)
    stiffness = mor_bench.load_scene("beam-stiffness")
    with pytest.raises(UnsupportedSceneError, match="it does not take sampled parameters"):
        doors.pymor_model(stiffness)
    assert PymorPOD().supports(stiffness) == "it does not take sampled parameters"


def test_without_pymor_the_message_names_the_extra(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("mor_bench.adapters.pymor_")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.partition(".")[0] == "pymor"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pymor", None)
    message = r"pip install 'mor-bench\[pymor\]'"
    with pytest.raises(MissingDependencyError, match=message):
        doors.pymor_model(tiny_scene)
    with pytest.raises(MissingDependencyError, match=message):
        doors.to_vector_array(tiny_scene, np.zeros((1, 63, 3)))
    with pytest.raises(MissingDependencyError, match=message):
        load_class(CLASS)


def test_the_package_alone_imports_no_door() -> None:
    code = (
        "import sys, mor_bench; mor_bench.load_scene('beam-tiny'); "
        "print([m for m in sys.modules if m.startswith(('mor_bench.adapters', 'pymor'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
