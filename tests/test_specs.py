"""Dataset and method files: what is shipped is valid, what is wrong is named in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mor_bench
from mor_bench.errors import MissingDependencyError, MorBenchError, SpecError
from mor_bench.runs.file_check import check_file
from mor_bench.specs import list_suite, load_generated_spec, load_method_spec

SHIPPED = {
    "l-shape": (335, 540, 60, 6000),
    "beam-coarse": (135, 256, 64, 6400),
    "beam-fine": (3267, 4032, 336, 33600),
    "beam-tiny": (24, 63, 21, 210),
    "beam-coarse-3-forces": (135, 256, 64, 12360),
    "beam-nearly-incompressible": (135, 256, 64, 3200),
    "block-compression": (216, 343, 49, 1960),
    "liver-hex": (726, 1118, 200, 2000),
    "liver-hex-observed": (726, 1118, 200, 2000),
    "liver-tet": (4567, 1118, 200, 2000),
}


def test_every_shipped_dataset_is_pinned_to_its_counts() -> None:
    assert set(list_suite("datasets")) == set(SHIPPED)
    for name, (cells, nodes, patches, samples) in SHIPPED.items():
        said, _, warning = check_file(list_suite("datasets")[name]).partition("; warning: ")
        assert (
            said
            == f"dataset, {cells} cells, {nodes} nodes, {patches} load patches, {samples} samples"
        )
        assert ("lock" in warning) == name.startswith("liver")


@pytest.mark.parametrize("name", sorted(list_suite("methods")))
def test_every_shipped_method_is_valid(name: str) -> None:
    try:
        assert check_file(list_suite("methods")[name]).startswith("method, ")
    except MissingDependencyError as error:
        pytest.skip(str(error))
    spec = load_method_spec(name)
    for profile in ("quick", "full"):
        configurations = [repr(found) for found in spec.configurations(profile)]
        assert len(set(configurations)) == len(configurations) > 0


def content() -> dict[str, Any]:
    """beam-tiny as a dict, to be spoilt."""
    return {
        key: value
        for key, value in load_generated_spec("beam-tiny").model_dump(mode="json").items()
        if key != "name"
    }


def set_(*path: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(spec: dict[str, Any]) -> None:
        for step in path[:-1]:
            spec = spec[step]  # type: ignore[index]
        spec[path[-1]] = value  # type: ignore[index]

    return change


BAD = [
    (
        set_("geometry", "sise_m", value=[1.0, 1.0, 1.0]),
        r"unknown key `geometry.sise_m`; did you mean 'size_m'\?",
    ),
    (
        set_("supports", 0, "regoin", value="x-min"),
        r"unknown key `supports\[0\].regoin`; did you mean 'region'\?",
    ),
    (set_("extra", value=1), r"unknown key `extra`"),
    (set_("material", "poisson", value=0.5), r"`material.poisson` must be less than 0.5; got 0.5"),
    (
        set_("material", "poisson", value=-1.0),
        r"`material.poisson` must be greater than -1; got -1",
    ),
    (
        set_("material", "poisson", value="0.4"),
        r"`material.poisson` must be a valid number; got '0.4'",
    ),
    (set_("material", "young_pa", value=0.0), r"`material.young_pa` must be greater than 0; got 0"),
    (
        set_("material", "young_pa", value=-5.0),
        r"`material.young_pa` must be greater than 0; got -5",
    ),
    (set_("material", "young_pa", value=float("nan")), r"`material.young_pa` must be"),
    (
        set_("material", "young_pa", value=float("inf")),
        r"`material.young_pa` must be a finite number; got inf",
    ),
    (
        set_("material", "law", value="neo"),
        r"`material.law` must be 'saint-venant-kirchhoff', 'neo-hookean', 'mooney-rivlin' or 'ogden'; got 'neo'",
    ),
    (lambda spec: spec["material"].pop("law"), r"key `material.law` is missing"),
    (
        set_("material", value={"law": "mooney-rivlin", "c10_pa": 1.0, "c01_pa": 0.1}),
        r"key `material.bulk_pa` is missing",
    ),
    (
        set_(
            "material",
            value={"law": "mooney-rivlin", "c10_pa": -1.0, "c01_pa": 0.1, "bulk_pa": 9.0},
        ),
        r"`material.c10_pa` must be greater than 0; got -1",
    ),
    (
        set_(
            "material", value={"law": "ogden", "mu_pa": [1.0], "alpha": [2.0, 3.0], "bulk_pa": 9.0}
        ),
        r"`mu_pa` and `alpha` must have equal lengths",
    ),
    (
        set_("material", value={"law": "ogden", "mu_pa": [1.0], "alpha": [-2.0], "bulk_pa": 9.0}),
        r"every product of `mu_pa` and `alpha` must be > 0",
    ),
    (
        set_("loads", "patch_area_m2", value=1e-9),
        r"`patch_area_m2` must be at least about 0\.\d+, for facets with edges of up to 0\.5 m; got 1e-09",
    ),
    (
        set_("discretisation", value={"element": "wedge"}),
        r"`discretisation.element` must be 'hexahedron' or 'tetrahedron'; got 'wedge'",
    ),
    (
        set_("discretisation", value={"element": "tetrahedron", "integration": "selective"}),
        r"`integration` of tetrahedra must be 'full'",
    ),
    (
        set_("geometry", "shape", value="sphere"),
        r"`geometry.shape` must be 'box', 'l-shape', 'voxels', 'tetrahedra' or 'file'; got 'sphere'",
    ),
    (set_("geometry", "cells", value=[6, 2]), r"`geometry.cells\[2\]` is missing"),
    (
        set_("geometry", "cells", value=[6, 2, 0]),
        r"`geometry.cells\[2\]` must be greater than or equal to 1; got 0",
    ),
    (
        set_("geometry", "cells", value=[6, 2, 2.5]),
        r"`geometry.cells\[2\]` must be a valid integer; got 2.5",
    ),
    (
        set_("geometry", "size_m", value=[1.0, -1.0, 1.0]),
        r"`geometry.size_m\[1\]` must be greater than 0; got -1",
    ),
    (
        set_("supports", 0, "region", value="x-mim"),
        r"`supports\[0\].region` must be 'x-min', .* got 'x-mim'",
    ),
    (
        set_("supports", 0, "region", value={"box": [[0, 0, 0], [1, 1, 1]]}),
        r"did you mean 'box_m'\?",
    ),
    (
        set_("supports", 0, "region", value={"box_m": [[9.0, 9.0, 9.0], [10.0, 10.0, 10.0]]}),
        r"holds no node of the mesh",
    ),
    (
        set_("loads", "region", value={"sphere_m": [[0.0, 0.0, 9.0], 0.5]}),
        r"holds no node of the mesh",
    ),
    (
        set_("loads", "region", value={"sphere_m": [[2.0, 0.0, 1.0], 0.1]}),
        r"no facet of the surface",
    ),
    (
        set_("loads", "region", value={"sphere_m": [[2.0, 0.0, 1.0], -0.1]}),
        r"must be greater than 0; got -0.1",
    ),
    (
        set_("loads", "patch_area_m2", value=2.5),
        r"`patch_area_m2` must be in \(0, 2\], the area of the load region; got 2.5",
    ),
    (
        set_("loads", "patch_area_m2", value=0.0),
        r"`loads.patch_area_m2` must be greater than 0; got 0",
    ),
    (
        set_("loads", "magnitude_n", value=[2.0, 1.0]),
        r"`loads.magnitude_n`: the lower bound must not exceed the upper one",
    ),
    (
        set_("loads", "magnitude_n", value=[-1.0, 1.0]),
        r"`loads.magnitude_n\[0\]` must be greater than or equal to 0; got -1",
    ),
    (
        set_("loads", "samples_per_patch", value=0),
        r"`loads.samples_per_patch` must be greater than or equal to 1; got 0",
    ),
    (set_("loads", "seed", value=-1), r"`loads.seed` must be greater than or equal to 0; got -1"),
    (
        set_("loads", "kind", value="moment"),
        r"`loads.kind` must be 'force', 'normal' or 'tangential'; got 'moment'",
    ),
    (
        set_("split", "by", value="patch"),
        r"`split.by` must be 'region', 'sample' or 'direction'; got 'patch'",
    ),
    (
        set_("split", "test_fraction", value=1.0),
        r"`split.test_fraction` must be less than 1; got 1",
    ),
    (set_("needs", "error", value=True), r"`needs.error` must be a valid number; got True"),
    (
        set_("geometry", "cells", value=[2_000_000, 2_000, 2_000]),
        r"there must be at most 10,000,000 cells in all",
    ),
    (
        set_("loads", "magnitude_n", value=[0.0, 1e-300]),
        r"`loads.magnitude_n\[1\]` must be greater than or equal to 0.000000000001",
    ),
    (
        set_("supports", 0, "region", value={"box_m": [[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]]}),
        r"the supports fix every node",
    ),
    (lambda spec: spec.pop("material"), r"key `material` is missing"),
    (set_("geometry", "sise_m", value=1), r"Allowed here: cells, shape, size_m\."),
    (
        set_(
            "supports",
            0,
            "region",
            value={"box_m": [[0, 0, 0], [1, 1, 1]], "sphere_m": [[0, 0, 0], 1.0]},
        ),
        r"`supports\[0\]\.region\.sphere_m` cannot stand beside another key of a region\. Allowed here: box_m\.",
    ),
    (lambda spec: spec["geometry"].pop("cells"), r"key `geometry.cells` is missing"),
]


@pytest.mark.parametrize(("spoil", "message"), BAD)
def test_a_bad_dataset_is_one_clear_line(
    spoil: Callable[[dict[str, Any]], Any], message: str
) -> None:
    spec = content()
    spoil(spec)
    with pytest.raises(SpecError, match=message) as caught:
        mor_bench.load_scene(spec)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "min_distance_m = 1.0",
            "min_distance_m = 9.0",
            r"must leave some 3 of the 64 patches that far apart; 9 leaves none",
        ),
        (
            "[0.2, 0.0, 0.0], [4.0, 0.0, 0.95]",
            "[0.2, 0.0, 0.0], [4.0, 0.0, 1.0]",
            r"`tests.unseen_region` must lie apart from `loads.region`",
        ),
        (
            "{ box_m = [[0.2, 0.0, 0.0], [4.0, 0.0, 0.95]] }",
            "{ box_m = [[9.0, 0.0, 0.0], [9.5, 0.0, 0.95]] }",
            r"holds no node of the mesh",
        ),
    ],
)
def test_check_looks_at_the_plan_and_at_the_test_sets(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "mine.toml"
    text = list_suite("datasets")["beam-coarse-3-forces"].read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(MorBenchError, match=message):
        check_file(path)


METHOD = """
title = "t"
source = "s"
surrogate = "mor_bench.surrogates.pod:PODGalerkin"
"""

BAD_METHODS = [
    (
        "[parameters]\nn_mode = 3",
        r"unknown key `n_mode`; did you mean 'n_modes'\? Allowed here: energy_tolerance, inner_product, n_modes, tolerance",
    ),
    (
        "[parameters]\nn_modes = 0",
        r"`n_modes` must be greater than or equal to 1 or 'auto' or 'energy'; got 0",
    ),
    (
        "[parameters]\nn_modes = 3.5",
        r"`n_modes` must be a valid integer or 'auto' or 'energy'; got 3.5",
    ),
    (
        "[sweep]\nn_modes = [1, 0]",
        r"`n_modes` must be greater than or equal to 1 or 'auto' or 'energy'; got 0",
    ),
    ("[sweep]\nn_modes = []", r"the sweep of `n_modes` is empty"),
    ("[profiles.quik]", r"`profiles.quik"),
    (
        "[profiles.full.parameters]\ntolerance = -1.0",
        r"\(full\): `tolerance` must be greater than 0 or 'auto'; got -1",
    ),
    ("sweeps = 1", r"unknown key `sweeps`; did you mean 'sweep'\?"),
    ("x = [", r"not valid TOML"),
]


@pytest.mark.parametrize(("text", "message"), BAD_METHODS)
def test_a_bad_method_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(METHOD + text)
    with pytest.raises(SpecError, match=message) as caught:
        check_file(path)
    assert "\n" not in str(caught.value)
    assert "mine" in str(caught.value)


@pytest.mark.parametrize(
    ("surrogate", "message"),
    [
        ("mor_bench.surrogates.pod:PODGalerkim", r"did you mean 'PODGalerkin'\?"),
        ("no_such_package.module:Thing", r"cannot be imported"),
        ("mor_bench.surrogates.pod", r"package.module:Class"),
        ("mor_bench.surrogates.pod:stiffness_at_rest", r"is not a class"),
    ],
)
def test_a_surrogate_that_is_not_there(tmp_path: Path, surrogate: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(METHOD.replace("mor_bench.surrogates.pod:PODGalerkin", surrogate))
    with pytest.raises(MorBenchError, match=message):
        check_file(path)


def test_unknown_names_give_the_nearest() -> None:
    with pytest.raises(
        SpecError, match=r"unknown dataset 'beam-coarze'; did you mean 'beam-coarse'\?"
    ):
        mor_bench.load_scene("beam-coarze")
    with pytest.raises(SpecError, match=r"unknown method 'pood'; did you mean 'pod'\?"):
        mor_bench.load_method("pood")
    with pytest.raises(SpecError, match="no such file"):
        mor_bench.load_scene("nowhere/else.toml")


def test_load_method_takes_parameters_and_checks_them() -> None:
    assert mor_bench.load_method("pod", n_modes=7).parameters["n_modes"] == 7
    with pytest.raises(
        SpecError,
        match=r"PODGalerkin: `n_modes` must be greater than or equal to 1 or 'auto' or 'energy'; got 0",
    ):
        mor_bench.load_method("pod", n_modes=0)


def test_profile_replaces_parameters_and_sweep(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    base = "[parameters]\ntolerance = 1e-3\n[sweep]\nn_modes = [1, 2]\n"
    path.write_text(
        METHOD
        + base
        + "[profiles.quick.sweep]\nn_modes = [5]\n[profiles.quick.parameters]\ntolerance = 0.1"
    )
    spec = load_method_spec(path)
    assert spec.configurations("quick") == [{"tolerance": 0.1, "n_modes": 5}]
    assert spec.configurations("full") == [
        {"tolerance": 1e-3, "n_modes": 1},
        {"tolerance": 1e-3, "n_modes": 2},
    ]


def test_only_physics_decides_the_digest() -> None:
    spec = load_generated_spec("beam-tiny")
    assert (
        spec.digest()
        == spec.model_copy(
            update={"title": "other", "split": spec.split.model_copy(update={"by": "sample"})}
        ).digest()
    )
    assert (
        spec.digest()
        != spec.model_copy(
            update={"material": spec.material.model_copy(update={"young_pa": 501.0})}
        ).digest()
    )
