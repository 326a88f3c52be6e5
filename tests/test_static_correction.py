"""Static correction: hyper-reduced, exact at small loads, refused where it inverts cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.linear_fem import LinearFEM
from mor_bench.surrogates.local_pod import LocalPOD
from tests.verification.scenes import scene_of, solved


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
    few = HyperReducedPOD(5, 1e-2, static_correction=True).fit(scene, train)
    assert len(few.cells_) < scene.mesh.n_cells
    assert np.abs(few.predict(train.forces) - local).max() <= 0.03 * size
    small = 1e-6 * train.forces
    linear = LinearFEM().fit(scene, None).predict(small)
    assert np.abs(few.predict(small) - linear).max() <= 1e-5 * np.abs(linear).max()


def test_static_correction_needs_a_body_without_contact_and_sampled_parameters() -> None:
    method = HyperReducedPOD(5, static_correction=True)
    for name in ("liver-pressed", "beam-stiffness"):
        assert "static correction" in str(method.supports(mor_bench.load_scene(name)))


@pytest.mark.parametrize(
    ("name", "knobs"),
    [
        ("modal-derivatives", {"n_linear": 5, "n_modes": 20}),
        ("quadratic-manifold", {"n_modes": 4}),
        ("local-pod", {"n_clusters": 2, "n_modes": 4}),
        ("hpod", {"n_modes": 4, "static_correction": True}),
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
