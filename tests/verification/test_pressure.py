"""Dead pressures: closed forms, resultants, balance with the supports, and convergence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import RankDeficientWarning, SpecError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.discretisation_error import RefinementPlan, refine
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.test_sets import available_sets, spec_of_set
from mor_bench.specs import load_generated_spec
from mor_bench.specs.load_ranges import largest_of

from .scenes import reactions

YOUNG_PA = 500.0
TIGHT = NewtonOptions(1e-12)
PLANES = [{"region": f"{axis}-min", "components": [axis]} for axis in "xyz"]


TUBE = {"shape": "tube", "radii_m": [1.0, 2.0], "length_m": 0.5, "cells": [1, 4, 1]}
LOADS: dict[str, Any] = {
    "kind": "pressure",
    "regions": ["x-max"],
    "magnitude_pa": [0.0, 50.0],
    "samples": 40,
}


def content(**changed: Any) -> dict[str, Any]:
    """Return a bar of 2 x 1 x 1 m on planes of symmetry, pressed at its end, as a dict."""
    return {
        "name": "bar",
        "title": "Bar under pressure",
        "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]},
        "material": material_table("saint-venant-kirchhoff", YOUNG_PA, 0.3),
        "supports": PLANES,
        "loads": LOADS,
        "split": {"by": "sample"},
        **changed,
    }


def pressed(**changed: Any) -> Scene:
    """Return the bar as a scene."""
    return load_scene(content(**changed))


def tube(n: int, young_pa: float, angle_deg: float = 90.0) -> Scene:
    """Return a tube in plane strain with n cells across its wall, or a quarter of it."""
    quarter = angle_deg == 90.0
    rollers = [*PLANES, {"region": "z-max", "components": ["z"]}]
    return pressed(
        geometry={
            **TUBE,
            "angle_deg": angle_deg,
            "cells": [n, 2 * n if quarter else 8 * n, 1],
        },
        material=material_table("saint-venant-kirchhoff", young_pa, 0.3),
        supports=rollers if quarter else rollers[2:],
        loads={**LOADS, "regions": [{"point_set": "inner"}]},
    )


def forces_of(scene: Scene, *pressures: float) -> NDArray[np.float64]:
    """Return the nodal forces (n_nodes, 3), N, of pressures on the regions, Pa."""
    vectors = np.concatenate([-p * np.eye(3) for p in pressures])
    loads = PatchLoads(np.arange(len(vectors))[None], vectors[None])
    forces: NDArray[np.float64] = loads.nodal_forces(scene.patch_weights)[0]
    return forces


def solved(scene: Scene, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the equilibrium (n_nodes, 3), m."""
    u = np.zeros(scene.mesh.n_dofs)
    free = scene.free_dofs
    u[free] = FullOrderModel(scene).solve(forces.ravel()[free], options=TIGHT).displacement
    return u.reshape(-1, 3)


@pytest.mark.parametrize("pressure", [5.0, 40.0, -60.0])
def test_a_pressed_bar_has_its_closed_form(pressure: float) -> None:
    scene = pressed()
    u = solved(scene, forces_of(scene, pressure))
    # Uniaxial stress: E λ (λ² - 1) / 2 = -p, and the squares of the other stretches follow.
    roots = np.roots([YOUNG_PA / 2, 0.0, -YOUNG_PA / 2, pressure])
    stretch = max(root.real for root in roots if abs(root.imag) < 1e-9)
    across = np.sqrt(1 - 0.3 * (stretch**2 - 1))
    exact = scene.mesh.points * [stretch - 1, across - 1, across - 1]
    np.testing.assert_allclose(u, exact, atol=1e-9)


def test_a_uniform_pressure_on_a_closed_surface_has_no_resultant() -> None:
    for scene in (
        pressed(loads={**LOADS, "regions": ["surface"]}),
        load_scene({**load_generated_spec("liver-hex").model_dump(), **_on_liver()}),
    ):
        forces = forces_of(scene, 3.0)
        size = np.abs(forces).sum()
        assert np.abs(forces.sum(axis=0)).max() < 1e-10 * size
        moment = np.cross(scene.mesh.points, forces).sum(axis=0)
        extent = np.ptp(scene.mesh.points, axis=0).max()
        assert np.abs(moment).max() < 1e-9 * size * extent


def _on_liver() -> dict[str, Any]:
    return {"loads": {**LOADS, "regions": ["surface"]}, "split": {"by": "sample"}, "tests": {}}


def test_the_supports_carry_the_pressure() -> None:
    scene = pressed(
        material=material_table("neo-hookean", YOUNG_PA, 0.4),
        supports=[{"region": "x-min"}],
        loads={**LOADS, "regions": ["x-max", "z-max"]},
    )
    forces = forces_of(scene, 20.0, 5.0)
    np.testing.assert_allclose(forces.sum(axis=0), [-20.0, 0.0, -10.0], atol=1e-12)
    found = reactions(scene, forces, solved(scene, forces))
    held = found[scene.fixed_nodes].sum(axis=0)
    np.testing.assert_allclose(held, -forces.sum(axis=0), atol=1e-8)


def test_a_thick_tube_converges_to_the_solution_of_lame() -> None:
    pressure, young, poisson, inner, outer = 1.0, 1e5, 0.3, 1.0, 2.0
    errors = []
    for n in (4, 8, 16):
        scene = tube(n, young)
        u = solved(scene, forces_of(scene, pressure))
        radius = np.linalg.norm(scene.mesh.points[:, :2], axis=1)
        size = pressure * inner**2 / (outer**2 - inner**2) * (1 + poisson) / young
        exact = size * ((1 - 2 * poisson) * radius + outer**2 / radius)
        radial = np.sum(u[:, :2] * scene.mesh.points[:, :2], axis=1) / radius
        errors.append(np.linalg.norm(radial - exact) / np.linalg.norm(exact))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 1e-3
    np.testing.assert_allclose(orders, 2.0, atol=0.2)


def test_a_whole_tube_moves_as_its_quarter() -> None:
    quarter, whole = tube(3, 1e3), tube(3, 1e3, 360.0)
    springs = {"springs": [{"region": {"point_set": "outer"}, "stiffness_n_m3": 1e-3}]}
    whole = load_scene({**whole.spec.model_dump(), **springs})
    fields = [solved(scene, forces_of(scene, 30.0)) for scene in (quarter, whole)]
    sizes = [np.unique(np.round(np.linalg.norm(u[:, :2], axis=1), 5)) for u in fields]
    np.testing.assert_allclose(sizes[0], sizes[1], atol=2e-5)


@pytest.mark.parametrize("sampling", ["random", "sobol", "latin-hypercube"])
def test_every_sample_presses_each_region_with_a_pressure_in_range(sampling: str) -> None:
    loads = {**LOADS, "regions": ["x-max", "z-max"]}
    scene = pressed(loads={**loads, "magnitude_pa": [10.0, 50.0], "sampling": sampling})
    drawn = draw_loads(scene, 0, 40)
    pressures = -drawn.vectors.reshape(40, 2, 3, 3)[:, :, 0, 0]
    assert ((pressures >= 10.0) & (pressures <= 50.0)).all()
    assert np.ptp(pressures, axis=0).min() > 25.0
    np.testing.assert_array_equal(
        drawn.vectors.reshape(40, 2, 3, 3), -pressures[:, :, None, None] * np.eye(3)
    )
    later = draw_loads(scene, 25, 40)
    np.testing.assert_array_equal(later.vectors, drawn.vectors[25:])


def test_sampled_pressures_may_pull() -> None:
    """Suction stretches the bar as the opposite pressure compresses it in linear elasticity."""
    scene = pressed(loads={**LOADS, "magnitude_pa": [-20.0, 0.0], "sampling": "sobol"})
    drawn = draw_loads(scene, 0, 40)
    pressures = -drawn.vectors[:, 0, 0]
    assert -20.0 <= pressures.min() < -19.0
    assert -1.0 < pressures.max() <= 0.0
    assert spec_of_set(scene.generated, "2x").load_plan.magnitude == (-40.0, 0.0)
    assert largest_of(scene.generated.load_plan.magnitude) == 20.0
    linear = mor_bench.load_method("linear-fem").fit(scene)
    pulled = linear.predict(forces_of(scene, -20.0))
    np.testing.assert_allclose(pulled, -linear.predict(forces_of(scene, 20.0)), rtol=1e-9)
    assert pulled[:, 0].max() > 0
    stretched = solved(scene, forces_of(scene, -20.0))
    np.testing.assert_allclose(stretched, pulled, atol=0.1 * np.abs(pulled).max())
    for wrong in ([-2e12, 0.0], [0.0, 0.0], [1.0, -1.0]):
        with pytest.raises(SpecError, match="magnitude_pa"):
            pressed(loads={**LOADS, "magnitude_pa": wrong})


def test_named_sets_and_the_discretisation_error_exist(tmp_path: Path) -> None:
    spec = pressed().generated
    assert available_sets(spec) == ["in-range", "2x", "4x"]
    assert spec_of_set(spec, "4x").load_plan.magnitude == (0.0, 200.0)
    below_buckling = {**LOADS, "magnitude_pa": [1.0, 10.0]}
    held = pressed(supports=[{"region": "x-min"}], loads=below_buckling).generated
    record = refine(held, RefinementPlan(2, 1), cache=tmp_path)
    assert 0.0 < record["relative_l2"] < 0.3


@pytest.mark.parametrize("discretisation", [None, {"element": "tetrahedron"}])
def test_a_pressure_on_divided_cells_is_their_own_consistent_load(discretisation: Any) -> None:
    """Forces at few points of a facet would dent the divided one."""
    scene = pressed(discretisation=discretisation) if discretisation else tube(2, YOUNG_PA)
    finer = refined(refined(scene))
    points, shares = scene.patch_points(np.arange(len(scene.patch_nodes)))
    found = (shares @ interpolation_matrix(finer.mesh, points)).toarray()
    wanted = finer.patch_weights.toarray()
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.02 * np.abs(wanted).max())


def test_a_curved_manifold_leaves_out_modes_that_hold_the_error_of_the_solver(
    tmp_path: Path,
) -> None:
    """One pressure determines few modes; a cubature would leave the others without stiffness."""
    clamped = content(
        geometry={"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [6, 2, 2]},
        supports=[{"region": "x-min"}],
        loads={**LOADS, "regions": ["z-max"], "magnitude_pa": [0.0, 6.0], "samples": 150},
    )
    data = mor_bench.load_dataset(clamped, cache=tmp_path, workers=1)
    method = mor_bench.load_method("quadratic-manifold-pod")
    with pytest.warns(RankDeficientWarning, match="the samples determine"):
        method.fit(data.scene, data.train)
    predicted, wanted = method.predict(data.test.forces), data.test.displacements
    errors = np.linalg.norm(predicted - wanted, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    assert errors.max() < 0.01


@pytest.mark.slow
def test_methods_learn_pressures(tmp_path: Path) -> None:
    methods = [
        "fem",
        "linear-fem",
        "pod[n_modes=2]",
        "pod-tensor[n_modes=2]",
        "pca-regression-linear",
    ]
    comparison = mor_bench.run([content()], methods, out=tmp_path / "out", cache=tmp_path)
    errors = {row.method: row.error.rel_l2_median for row in comparison.rows if row.error}
    assert set(errors) == {"fem", "linear-fem", "pod", "pod-tensor", "pca-regression-linear"}
    assert max(errors[name] for name in ("pod", "pod-tensor", "pca-regression-linear")) < 1e-3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"split": {"by": "region"}}, "`split.by` must be 'sample' where"),
        (
            {"loads": {**LOADS, "regions": ["x-max", "x-min"]}, "supports": [{"region": "x-min"}]},
            r"`loads.regions\[1\]` holds fixed nodes only",
        ),
        ({"tests": {"paper_magnitude_n": [0.0, 1.0]}}, "`tests.paper_magnitude_n` must be absent"),
        (
            {"geometry": {**TUBE, "radii_m": [2.0, 1.0]}},
            "the inner radius of `radii_m` must be less",
        ),
        (
            {"geometry": {**TUBE, "cells": [1, 2, 1]}},
            "at most 120 degrees each",
        ),
    ],
)
def test_a_bad_scene_is_refused_in_one_line(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        pressed(**changed)
