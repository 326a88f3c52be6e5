"""Dynamic relaxation against the full-order solve, and against eigenvalues by LAPACK."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import InvertedElementError, NoEquilibriumError, SolverError
from mor_bench.mechanics import kernels, relaxation
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.relaxation import DynamicRelaxation
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.explicit_dynamics import ExplicitDynamics

LAWS: dict[str, dict[str, Any]] = {
    "saint-venant-kirchhoff": {"young_pa": 500.0, "poisson": 0.4},
    "neo-hookean": {"young_pa": 500.0, "poisson": 0.4},
    "mooney-rivlin": {"c10_pa": 60.0, "c01_pa": 29.0, "bulk_pa": 833.0},
    "ogden": {"mu_pa": [178.0], "alpha": [2.5], "bulk_pa": 833.0},
    "corotational": {"young_pa": 500.0, "poisson": 0.4},
    "holzapfel-gasser-ogden": {
        "c10_pa": 89.0,
        "k1_pa": 50.0,
        "k2": 0.8,
        "dispersion": 0.1,
        "fibres": [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]],
        "bulk_pa": 833.0,
    },
    "yeoh": {"c10_pa": 89.0, "c20_pa": -20.0, "c30_pa": 15.0, "bulk_pa": 833.0},
}
ELEMENTS: dict[str, tuple[Any, ...]] = {
    "H8": ("hexahedron", "full"),
    "H8 selective": ("hexahedron", "selective"),
    "T4": ("tetrahedron", "full"),
    "T10": ("tetrahedron", "full", 2),
}


def model(law: str = "saint-venant-kirchhoff", element: str = "H8") -> FullOrderModel:
    """beam-tiny of another law and element."""
    spec = load_generated_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    kind, integration, *order = ELEMENTS[element]
    spec |= {
        "material": {"law": law, **LAWS[law]},
        "discretisation": {
            "element": kind,
            "integration": integration,
            **({"order": order[0]} if order else {}),
        },
    }
    return FullOrderModel(load_scene(spec))


def loads(of: FullOrderModel, numbers: list[int], factor: float = 1.0) -> NDArray[np.float64]:
    drawn = draw_loads(of.scene, 0, 200)[np.array(numbers)]
    forces = drawn.nodal_forces(of.scene.patch_weights).reshape(len(numbers), -1)
    return factor * forces[:, of.scene.free_dofs]


@pytest.mark.parametrize(
    ("law", "element"),
    [
        pytest.param(law, element, marks=() if law != "ogden" else pytest.mark.slow)
        for law in LAWS
        for element in ELEMENTS
    ],
)
def test_relaxation_ends_at_the_full_order_solution(law: str, element: str) -> None:
    full = model(law, element)
    relaxed = DynamicRelaxation(full)
    for load in loads(full, [14, 133], 3.0):
        exact, found = full.solve(load).displacement, relaxed.solve(load, 1e-7, 5000)
        residual = np.linalg.norm(load - full.force(found.displacement).force)
        assert residual <= 1.001e-7 * np.linalg.norm(load)
        assert found.min_det_f == pytest.approx(full.force(found.displacement).min_det_f, rel=1e-12)
        most = 1e-5 if element == "T10" else 2e-6  # the finer nodes hide long waves in the residual
        assert np.linalg.norm(found.displacement - exact) <= most * np.linalg.norm(exact)
        assert found.cuts == 0


def test_mass_and_frequencies_at_rest_match_lapack() -> None:
    full = model()
    relaxed, pattern = DynamicRelaxation(full), full.assembler.pattern
    stiffness = pattern.symmetric(full.rest_tangent).toarray()
    values = scipy.linalg.eigh(stiffness, np.diag(relaxed.mass), eigvals_only=True)
    assert 1.0 <= values[-1] <= 0.5 * (1 + relaxation.MARGIN)
    assert relaxed.lowest == pytest.approx(values[0], rel=1e-6)
    assert (relaxed.mass.reshape(-1, 3) == relaxed.mass[::3, None]).all()
    rows = np.abs(stiffness).sum(axis=1).reshape(-1, 3).max(axis=1)
    np.testing.assert_allclose(relaxed.mass[::3] / rows, relaxed.mass[0] / rows[0], rtol=1e-12)


def test_steps_are_counted_and_exceeding_their_limit_raises() -> None:
    full = model()
    relaxed, load = DynamicRelaxation(full), loads(full, [14])[0]
    with counted() as cost:
        steps = relaxed.solve(load, 1e-4, 5000).iterations
    assert cost.element_evaluations == steps * 24
    assert cost.multiply_adds == steps * (
        24 * 8 * kernels.FORCE_MULTIPLY_ADDS + kernels.ADVANCE_MULTIPLY_ADDS * full.n_unknowns
    )
    assert relaxed.solve(load, 1e-4, steps).iterations == steps
    with pytest.raises(NoEquilibriumError, match=f"after {steps - 1} steps the residual is"):
        relaxed.solve(load, 1e-4, steps - 1)


def test_an_inverted_body_is_never_returned() -> None:
    full = model()
    relaxed, refused = DynamicRelaxation(full), []
    for load in loads(full, list(range(0, 200, 17)), 20.0):
        try:
            found = relaxed.solve(load, 1e-5, 20_000)
        except SolverError as error:
            refused.append(type(error))
        else:
            assert full.force(found.displacement).min_det_f > 0
    assert InvertedElementError in refused
    assert len(refused) < 12


def test_a_body_that_comes_to_rest_inverted_is_released_again() -> None:
    full = model("mooney-rivlin")
    relaxed = DynamicRelaxation(full)
    for load in loads(full, [20, 27, 38], 20.0):
        found, exact = relaxed.solve(load, 1e-6, 5000), full.solve(load).displacement
        assert found.cuts == 1
        assert np.linalg.norm(found.displacement - exact) <= 2e-5 * np.linalg.norm(exact)


def test_a_step_beyond_the_limit_of_stability_is_shortened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    full = model()
    relaxed, load = DynamicRelaxation(full), loads(full, [14])[0]
    exact = full.solve(load).displacement
    monkeypatch.setattr(relaxation, "MARGIN", 0.8)
    found = relaxed.solve(load, 1e-7, 5000)
    assert found.cuts == 0
    assert np.linalg.norm(found.displacement - exact) <= 2e-6 * np.linalg.norm(exact)


def test_a_linear_start_leads_to_the_same_equilibrium(tiny_scene: mor_bench.Scene) -> None:
    drawn = draw_loads(tiny_scene, 14, 15).nodal_forces(tiny_scene.patch_weights)
    near, far = (
        ExplicitDynamics(1e-7, start).fit(tiny_scene, None) for start in ("linear-response", "rest")
    )
    assert np.linalg.norm(near.predict(drawn) - far.predict(drawn)) <= 4e-6 * np.linalg.norm(
        far.predict(drawn)
    )
    with counted() as without:
        far.predict(drawn)
    with counted() as cost:
        near.predict(drawn)
    assert (without.back_solves, cost.back_solves) == (0, 1)
    assert cost.element_evaluations < without.element_evaluations
