"""Static correction: hyper-reduced, exact at small loads, refused where it inverts cells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.static_correction import MOST_POISSON, SOFTENED, softened
from mor_bench.scene.materials import NeoHookean
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.cubature_states import softened_if_locked
from mor_bench.surrogates.deim import InterpolatedPOD
from mor_bench.surrogates.ecm import EmpiricalCubaturePOD
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.linear_fem import LinearFEM
from mor_bench.surrogates.local_pod import LocalPOD
from mor_bench.surrogates.pod import PODGalerkin
from tests.verification.laws_and_elements import LAWS
from tests.verification.scenes import scene_of, solved

Array = NDArray[np.float64]


@pytest.mark.parametrize(
    ("law", "kind"), [("neo-hookean", ("hexahedron", True)), ("yeoh", ("tetrahedron", False))]
)
def test_static_correction_over_all_cells_is_that_of_a_single_local_basis(
    law: str, kind: tuple[str, bool]
) -> None:
    scene = scene_of(law, kind)
    train = solved(scene, 24)
    local = LocalPOD(n_clusters=1, n_modes=5).fit(scene, train).predict(train.forces)
    corrected = HyperReducedPOD(5, 0.0, static_correction=True).fit(scene, train)
    size = np.abs(local).max()
    assert np.abs(corrected.predict(train.forces) - local).max() <= 1e-9 * size
    small = 1e-6 * train.forces
    linear = LinearFEM().fit(scene, None).predict(small)
    methods: list[Any] = [
        HyperReducedPOD(5, 1e-2, static_correction=True),
        EmpiricalCubaturePOD(5, 1e-2, static_correction=True),
        *(
            InterpolatedPOD(5, 10, sampling=sampling, static_correction=True)
            for sampling in ("dofs", "cell-dofs", "cells")
        ),
    ]
    for few in methods:
        few.fit(scene, train)
        assert len(few.cells_) < scene.mesh.n_cells
        assert np.abs(few.predict(train.forces) - local).max() <= 0.03 * size
        assert np.abs(few.predict(small) - linear).max() <= 1e-5 * np.abs(linear).max()
    pod, plain = PODGalerkin(5).fit(scene, train), InterpolatedPOD(5, 10).fit(scene, train)
    expected = pod.predict(small)
    assert np.abs(plain.predict(small) - expected).max() <= 1e-5 * np.abs(expected).max()


def test_static_correction_needs_a_body_without_contact_and_sampled_parameters() -> None:
    for method in (
        HyperReducedPOD(5, static_correction=True),
        EmpiricalCubaturePOD(5, static_correction=True),
    ):
        for name in ("liver-pressed", "beam-stiffness"):
            assert "static correction" in str(method.supports(mor_bench.load_scene(name)))


@pytest.mark.parametrize(
    ("name", "knobs"),
    [
        ("modal-derivatives", {"n_linear": 5, "n_modes": 20}),
        ("quadratic-manifold", {"n_modes": 4}),
        ("local-pod", {"n_clusters": 2, "n_modes": 4}),
        ("hpod", {"n_modes": 4, "static_correction": True}),
        ("ecm", {"n_modes": 4, "static_correction": True}),
        ("deim", {"n_modes": 4, "static_correction": True}),
    ],
)
def test_a_body_that_the_static_correction_inverts_is_refused(
    name: str, knobs: dict[str, Any], tiny: Dataset
) -> None:
    method = mor_bench.load_method(name, **knobs).fit(tiny.scene, tiny.train)
    model, free, refused = FullOrderModel(tiny.scene), tiny.scene.free_dofs, 0
    for force in 100.0 * tiny.test.forces[:30]:
        try:
            u = method.predict(force)
        except SolverError:
            refused += 1
            continue
        assert model.force(u.ravel()[free]).min_det_f > 0
    assert refused > 0


@pytest.mark.parametrize("law", LAWS)
def test_another_poissons_ratio_leaves_the_shear_modulus(law: str) -> None:
    material = LAWS[law]
    changed = material.with_poisson(0.48)
    assert changed.poisson_at_rest == pytest.approx(0.48, rel=1e-12)
    assert changed.shape_parameters == pytest.approx(material.shape_parameters, rel=1e-12)
    back = changed.with_poisson(material.poisson_at_rest)
    assert back.parameters == pytest.approx(material.parameters, rel=1e-12)


def errors_of(method: mor_bench.Surrogate, data: Dataset) -> Array:
    """Return relative l2 errors of the test samples (n,)."""
    apart = method.predict(data.test.forces) - data.test.displacements
    sizes = np.linalg.norm(data.test.displacements, axis=(1, 2))
    return np.asarray(np.linalg.norm(apart, axis=(1, 2)) / sizes)


def test_a_cluster_without_displacements_keeps_its_law() -> None:
    data = mor_bench.load_dataset("beam-nearly-incompressible", limit=40)
    train = data.train
    still = replace(train, free_displacements=np.zeros_like(train.free_displacements))
    assert (
        softened_if_locked(FullOrderModel(data.scene), still, np.eye(len(data.scene.free_dofs), 3))
        is data.scene
    )


def test_only_nearly_incompressible_bodies_that_do_not_lock_are_softened() -> None:
    scene = mor_bench.load_scene("beam-nearly-incompressible")
    soft = softened(scene).material
    assert scene.material is not None
    assert soft is not None
    assert soft.poisson_at_rest == pytest.approx(MOST_POISSON)
    assert soft.shear_at_rest == pytest.approx(scene.material.shear_at_rest)
    for name in ("beam-coarse", "liver-hex", "soft-arm"):
        unchanged = mor_bench.load_scene(name)
        assert softened(unchanged) is unchanged
    locking = replace(mor_bench.load_scene("beam-coarse"), material=NeoHookean(500.0, 0.499))
    assert softened(locking) is locking


def test_a_body_whose_modes_keep_the_volume_is_not_softened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = mor_bench.load_dataset("artery-pressure", limit=120)
    assert softened(data.scene) is not data.scene
    for name, knobs in {
        "hpod": {"n_modes": 4, "static_correction": True},
        "local-pod": {"n_clusters": 2, "n_modes": 3},
    }.items():
        method = mor_bench.load_method(name, **knobs).fit(data.scene, data.train)
        assert not any(array.startswith(SOFTENED) for array in method.arrays_)
        true = errors_of(method, data)
        with monkeypatch.context() as forced:
            forced.setattr("mor_bench.surrogates.cubature_states.LOCKED", 0.0)
            softer = mor_bench.load_method(name, **knobs).fit(data.scene, data.train)
        assert any(array.startswith(SOFTENED) for array in softer.arrays_)
        assert np.median(true) < 0.7 * np.median(errors_of(softer, data))


HPOD = {"n_modes": 20, "static_correction": True}
NEARER = {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4999}
POLYNOMIAL = {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": 0.499}
RESTING = {
    "gravity": {"density_kg_m3": 0.005},
    "springs": [{"region": "z-min", "stiffness_n_m3": 1.0}],
}


@pytest.mark.parametrize(
    ("name", "knobs", "changes"),
    [
        ("hpod", HPOD, {}),
        ("hpod", HPOD, {"material": NEARER}),
        ("hpod", HPOD, RESTING),
        ("ecm", HPOD, {}),
        ("deim", HPOD | {"sampling": "cells", "n_force_modes": 80}, {}),
        ("local-pod", {"n_clusters": 1, "n_modes": 20}, {}),
        ("local-pod", {"n_clusters": 2, "n_modes": 10}, {"material": POLYNOMIAL}),
        ("quadratic-manifold-pod", {"n_latent": 20, "n_secondary": 40}, {}),
        ("modal-derivatives", {"n_linear": 5, "n_modes": 20}, {}),
        ("quadratic-manifold", {"n_modes": 5}, {}),
    ],
)
def test_softer_volume_lowers_the_errors_of_a_nearly_incompressible_body(
    name: str,
    knobs: dict[str, Any],
    changes: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = mor_bench.load_scene("beam-nearly-incompressible").spec.model_dump(mode="json")
    data = mor_bench.load_dataset(spec | changes, limit=160)
    method = mor_bench.load_method(name, **knobs).fit(data.scene, data.train)
    soft = errors_of(method, data)
    again = mor_bench.load_method(name, **knobs)
    again.restore(data.scene, method.arrays_, method.sizes_)
    assert np.array_equal(errors_of(again, data), soft)
    monkeypatch.setattr("mor_bench.reduction.static_correction.MOST_POISSON", 0.5)
    true = errors_of(mor_bench.load_method(name, **knobs).fit(data.scene, data.train), data)
    assert soft.max() < 0.6 * true.max()
    assert np.median(soft) < 0.7 * np.median(true)
