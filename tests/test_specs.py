"""Dataset and method files: shipped files are valid, and a mistake is named in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import MissingDependencyError, MorBenchError, RenamedWarning, SpecError
from mor_bench.report.published_figures import SAME_AMPLITUDE, scene_of
from mor_bench.runs.configurations import MOST_CONFIGURATIONS
from mor_bench.runs.file_check import check_file
from mor_bench.specs import list_suite, load_generated_spec, load_method_spec

SHIPPED = {
    "beam-tiny": (24, 63, 21, 210),
    "beam-coarse": (135, 256, 64, 6400),
    "beam-coarse-3-forces": (135, 256, 64, 12360),
    "beam-coarse-3-forces-paper": (135, 256, 64, 12360),
    "beam-coarse-paper": (135, 256, 64, 6400),
    "beam-stiffness": (135, 256, 64, 6400),
    "beam-shape": (135, 256, 64, 6400),
    "beam-nearly-incompressible": (135, 256, 64, 3200),
    "beam-neo-hooke": (135, 256, 64, 1600),
    "beam-mooney-rivlin": (135, 256, 64, 1600),
    "beam-tet": (810, 256, 64, 1600),
    "block-compression": (216, 343, 49, 1960),
    "l-shape": (335, 540, 60, 6000),
    "l-shape-paper": (335, 540, 60, 6000),
    "beam-fine": (3267, 4032, 336, 33600),
    "beam-fine-paper": (3267, 4032, 336, 33600),
    "liver-hex": (726, 1118, 200, 2000),
    "liver-hex-observed": (726, 1118, 200, 2000),
    "liver-hex-paper": (726, 1118, 200, 2000),
    "liver-grasped": (726, 1118, 12, 2000),
    "liver-pressed": (726, 1118, 422, 512),
    "artery-pressure": (384, 600, 2, 2000),
    "soft-arm": (692, 1276, 4, 500),
    "liver-tet": (4567, 1118, 200, 2000),
}
"""Cells, nodes, load patches (or moved nodes, pressed regions, nodes to touch), and samples."""

LARGE = [name for name in SHIPPED if name.startswith(("beam-fine", "liver"))]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LARGE else ()) for n in SHIPPED]
)
def test_every_shipped_dataset_has_its_pinned_counts(name: str) -> None:
    counts, _, warning = check_file(list_suite("datasets")[name]).partition("; warning: ")
    cells, nodes, patches, samples = SHIPPED[name]
    kinds = {"displacement": "moved nodes", "pressure": "pressed regions"}
    kinds["contact"] = "nodes to touch"
    loaded = kinds.get(load_generated_spec(name).load_plan.kind, "load patches")
    expected = f"{cells} cells, {nodes} nodes, {patches} {loaded}, {samples} samples"
    assert counts == f"dataset, {expected}"
    assert ("lock" in warning) == name.startswith(("liver-hex", "liver-tet"))


def test_the_counts_of_every_dataset_are_pinned() -> None:
    assert set(list_suite("datasets")) == set(SHIPPED)


@pytest.mark.parametrize("name", [name for name in SHIPPED if name.endswith(SAME_AMPLITUDE)])
def test_a_dataset_at_the_deformation_of_the_paper_has_only_larger_forces(name: str) -> None:
    """So what tests say of the meshes, supports and patches of its scene holds for it too."""
    own, paper = (
        load_generated_spec(n).model_dump(mode="json", exclude={"name", "title", "source"})
        for n in (scene_of(name), name)
    )
    forces = own["loads"].pop("magnitude_n"), paper["loads"].pop("magnitude_n")
    assert forces[0][0] == forces[1][0] == 0.0
    assert forces[0][1] < forces[1][1]
    assert own["tests"].pop("paper_magnitude_n") != paper["tests"].pop("paper_magnitude_n", None)
    assert own == paper


@pytest.mark.parametrize("name", list_suite("methods"))
def test_every_shipped_method_is_valid_and_its_sweep_fits_the_budget(name: str) -> None:
    try:
        assert check_file(list_suite("methods")[name]).startswith("method, ")
    except MissingDependencyError as error:
        pytest.skip(str(error))
    spec = load_method_spec(name)
    for profile in ("quick", "full"):
        configurations = [repr(found) for found in spec.configurations(profile)]
        assert len(set(configurations)) == len(configurations) > 0
        assert len(configurations) <= MOST_CONFIGURATIONS[profile]  # a run skips the rest


@pytest.mark.parametrize("name", list_suite("methods"))
def test_every_shipped_method_states_what_it_is_told(name: str) -> None:
    spec = load_method_spec(name)
    of_input: dict[Any, Any] = {"force": "input", "linear-response": "linear-response"}
    try:
        default = getattr(spec.load_class(), "input", None)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    for profile in ("quick", "full"):
        for parameters in spec.configurations(profile):
            given = parameters.get("input", default)
            assert spec.told_with(parameters) == of_input.get(given, spec.told)
    assert spec.told is not None
    assert not spec.reference or spec.told == "equations"


BAD_DATASETS = """
geometry.sise_m = [1.0] -> unknown key `geometry.sise_m`; did you mean 'size_m'?
geometry.sise_m = 1 -> Allowed here: cells, shape, size_m.
geometry.shape = "sphere" -> must be 'box', 'l-shape', 'chambered-box', 'tube'
geometry.cells = - -> key `geometry.cells` is missing.
geometry.cells = [6, 2] -> key `geometry.cells[2]` is missing.
geometry.cells = [6, 2, 0] -> `geometry.cells[2]` must be greater than or equal to 1; got 0.
geometry.cells = [6, 2, 2.5] -> `geometry.cells[2]` must be a valid integer; got 2.5.
geometry.cells = [2000000, 2000, 2000] -> there must be at most 400,000 cells in all
geometry.size_m = [1.0, -1.0, 1.0] -> `geometry.size_m[1]` must be greater than 0; got -1.0.
geometry = { shape = "file", file = 3 } -> `geometry.file`: it must be the path of a file; got 3.
geometry = { shape = "file", file = "none.vtu" } -> `geometry.file`: … no such file
grid_nodes = [1000, 1000, 1000] -> there must be at most 1,000,000 nodes in all
geometry.size_m = [1e200, 1.0, 1.0] -> `geometry.size_m[0]`: it must be in [1e-09, 1e+09] m
name = "../../x" -> `name` must consist of lower-case letters, digits and hyphens; got '../../x'.
title = "\\u001b[31m" -> `title`: it must not hold control characters
extra = 1 -> unknown key `extra`
supports.0.regoin = "x-min" -> unknown key `supports[0].regoin`; did you mean 'region'?
supports.0.region = "x-mim" -> `supports[0].region` must be 'x-min', … got 'x-mim'.
supports.0.region = { box = 1 } -> unknown key `supports[0].region.box`; did you mean 'box_m'?
supports.0.region = { box_m = [[9, 9, 9], [10, 10, 10]] } -> holds no node of the mesh
supports.0.region = { box_m = [[0, 0, 0], [2, 1, 1]] } -> the supports fix every node
supports.0.region = { box_m = 1, sphere_m = 1 } -> sphere_m` cannot stand beside another key
supports.0.region = { box_m = 1, sphere_m = 1 } -> of a region. Allowed here: box_m.
material = - -> key `material` is missing.
material.law = - -> key `material.law` is missing.
material.law = "neo" -> `material.law` must be 'saint-venant-kirchhoff', 'neo-hookean', 'coro
material.poisson = 0.5 -> `material.poisson` must be less than 0.5; got 0.5.
material.poisson = -1.0 -> `material.poisson` must be greater than -1; got -1.0.
material.poisson = "0.4" -> `material.poisson` must be a valid number; got '0.4'.
material.young_pa = 0.0 -> `material.young_pa` must be greater than 0; got 0.0.
material.young_pa = nan -> `material.young_pa` must be
material.young_pa = inf -> `material.young_pa` must be a finite number; got inf.
material.young_pa = 1e308 -> `material.young_pa`: it must be in [1e-06, 1e+15] Pa, the range in
material.young_pa = 5e-324 -> `material.young_pa`: it must be in [1e-06, 1e+15] Pa, the range in
material.poisson = 0.4999999999 -> `material.poisson`: it must be in [-0.999999, 0.499999], the
material = { law = "mooney-rivlin", c10_pa = 1.0, c01_pa = 0.1 } -> `material.bulk_pa` is missing
material = { law = "mooney-rivlin", c10_pa = -1.0, c01_pa = 0.1, bulk_pa = 9.0 } -> than 0; got -1
material = { law = "ogden", mu_pa = [1.0], alpha = [2.0, 3.0], bulk_pa = 9.0 } -> equal lengths
material = { law = "ogden", mu_pa = [1.0], alpha = [-2.0], bulk_pa = 9.0 } -> must be > 0
material = { law = "yeoh", c10_pa = 1.0, c20_pa = -2.0, c30_pa = 0.5, bulk_pa = 9.0 } -> 3 c10 c30
discretisation = { element = "wedge" } -> must be 'hexahedron' or 'tetrahedron'; got 'wedge'.
discretisation = { element = "tetrahedron", integration = "selective" } -> must be 'full'
loads.region = { sphere_m = [[0.0, 0.0, 9.0], 0.5] } -> holds no node of the mesh
loads.region = { sphere_m = [[2.0, 0.0, 1.0], 0.1] } -> no facet of the surface
loads.region = { sphere_m = [[2.0, 0.0, 1.0], -0.1] } -> must be greater than 0; got -0.1.
loads.patch_area_m2 = 1e-9 -> at least about 0. … facets have edges of up to 0.5 m; got 1e-09
loads.patch_area_m2 = 2.5 -> must be in (0, 2], the area of the load region; got 2.5.
loads.patch_area_m2 = 0.0 -> `loads.patch_area_m2` must be greater than 0; got 0.0.
loads.magnitude_n = [2.0, 1.0] -> `loads.magnitude_n`: the lower bound must not exceed the upper
loads.magnitude_n = [-1.0, 1.0] -> `loads.magnitude_n[0]` must be greater than or equal to 0
loads.magnitude_n = [0.0, 1e-300] -> `loads.magnitude_n[1]` must be greater than or equal to 0.0
loads.samples_per_patch = 1000000000000000000 -> must be less than or equal to 10000000
loads.samples_per_patch = 0 -> `loads.samples_per_patch` must be greater than or equal to 1
loads.seed = -1 -> `loads.seed` must be greater than or equal to 0; got -1.
loads.kind = "x" -> `loads.kind` must be 'force', 'normal', 'tangential', 'point', 'line', 'displ…
split.by = "patch" -> `split.by` must be 'region', 'sample' or 'direction'; got 'patch'.
split.test_fraction = 1.0 -> `split.test_fraction` must be less than 1; got 1.0.
needs.error = true -> `needs.error` must be a valid number; got True.
needs.outputs = "x-mim" -> `needs.outputs` must be 'all', 'x-min', … got 'x-mim'.
tests.unseen_region = "x-mim" -> `tests.unseen_region` must be 'x-min', … got 'x-mim'.
"""
"""Key of beam-tiny, its bad value as TOML or `-` for none, and parts of the message."""


def replaced(spec: Any, path: str, value: str) -> None:
    """Replace a value at a dotted path, or delete it."""
    *steps, last = path.split(".")
    for step in steps:
        spec = spec[int(step)] if step.isdecimal() else spec[step]
    if value == "-":
        del spec[last]
    else:
        spec[last] = tomllib.loads(f"value = {value}")["value"]


@pytest.mark.parametrize("line", BAD_DATASETS.strip().splitlines())
def test_a_mistake_in_a_dataset_is_one_clear_line(line: str) -> None:
    change, _, message = line.partition(" -> ")
    spec = load_generated_spec("beam-tiny").model_dump(mode="json", exclude={"name"})
    path, _, value = change.partition(" = ")
    replaced(spec, path, value)
    with pytest.raises(SpecError) as caught:
        mor_bench.load_scene(spec)
    assert all(part.strip() in str(caught.value) for part in message.split("…"))
    assert "\n" not in str(caught.value)


LOADED_BOX = "[0.2, 0.0, 0.0], [4.0, 0.0, 0.95]"


BODY: dict[str, Any] = {
    "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [6, 2, 2]},
    "material": {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": 0.4},
    "supports": [{"region": "x-min"}],
}


def test_a_body_alone_can_be_solved_as_in_its_dataset(tmp_path: Path) -> None:
    alone = mor_bench.load_scene(BODY)
    forces = np.zeros((alone.mesh.n_nodes, 3))
    forces[-1, 2] = 0.3
    of_dataset = mor_bench.load_scene("beam-tiny")
    answers = [
        mor_bench.load_method(name).fit(scene).predict(forces)
        for name in ("fem", "linear-fem")
        for scene in (alone, of_dataset)
    ]
    assert np.abs(answers[0]).max() > 0.02
    np.testing.assert_array_equal(answers[0], answers[1])
    np.testing.assert_allclose(answers[2], answers[3], atol=1e-15)
    for load in (mor_bench.load_dataset, lambda body: mor_bench.run([body], ["fem"], out=tmp_path)):
        with pytest.raises(SpecError, match="`loads` is missing, so no samples can be drawn"):
            load(BODY)


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        (
            {
                "material": {"law": "saint-venant-kirchhoff", "young_pa": -5.0, "poisson": 0.6},
                "supports": [{"region": "left"}],
                "loads": {"region": "x-max", "kind": "force"},
                "sppl": 1,
            },
            [
                "unknown key `sppl`",
                "`material.young_pa` must be greater than 0; got -5.0",
                "`material.poisson` must be less than 0.5; got 0.6",
                "`supports[0].region` must be",
                "key `loads.patch_area_m2` is missing",
                "key `loads.magnitude_n` is missing",
            ],
        ),
        (
            {
                "needs": {"outputs": {"sphere_m": [[9.0, 9.0, 9.0], 0.1]}},
                "observed": {"region": {"box_m": [[8.0, 8.0, 8.0], [9.0, 9.0, 9.0]]}},
            },
            ["((9.0, 9.0, 9.0), 0.1)", "((8.0, 8.0, 8.0), (9.0, 9.0, 9.0))"],
        ),
    ],
)
def test_an_invalid_scene_lists_all_its_mistakes(changes: dict[str, Any], parts: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        mor_bench.load_scene({**BODY, **changes})
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert message.count(part) == 1, part


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("min_distance_m = 1.0", "min_distance_m = 9.0", "patches are 9 m apart"),
        (
            LOADED_BOX,
            "[0.2, 0.0, 0.0], [4.0, 0.0, 1.0]",
            "`tests.unseen_region` must lie apart from `loads.region`",
        ),
        (LOADED_BOX, "[9.0, 0.0, 0.0], [9.5, 0.0, 0.95]", "holds no node of the mesh"),
    ],
)
def test_check_also_builds_the_load_plan_and_the_test_sets(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "mine.toml"
    text = list_suite("datasets")["beam-coarse-3-forces"].read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(MorBenchError, match=message):
        check_file(path)


def method_file(folder: Path, text: str = "", surrogate: str = "") -> Path:
    path = folder / "mine.toml"
    target = surrogate or "mor_bench.surrogates.pod:PODGalerkin"
    path.write_text(f'title = "t"\nsource = "s"\nsurrogate = "{target}"\n{text}', encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("parameters.n_mode = 3", r"unknown key `n_mode`; did you mean 'n_modes'\? Allowed here: "),
        ("parameters.n_modes = 0", r"must be greater than or equal to 1 or 'auto' or 'energy'; "),
        ("parameters.n_modes = 3.5", r"`n_modes` must be a valid integer or 'auto' or 'energy'; "),
        ("sweep.n_modes = [1, 0]", r"\(quick\): `n_modes` must be greater than or equal to 1"),
        ("sweep.n_modes = []", r"the sweep of `n_modes` is empty"),
        ("profiles.quik = {}", r"`profiles.quik"),
        ("profiles.full.parameters.tolerance = -1.0", r"\(full\): `tolerance` must be greater tha"),
        ("battery.parameters.n_modes = 0", r"\(battery\): `n_modes` must be greater than"),
        ("battery.benchmark.n_mode = 1", r"\(battery\): unknown key `n_mode`"),
        ("battery.races = [{ difference = 1.0 }]", r"key `battery.races\[0\].least_speedup` is mi"),
        ("sweeps = 1", r"unknown key `sweeps`; did you mean 'sweep'\?"),
        ("x = [", r"not valid TOML"),
    ],
)
def test_a_mistake_in_a_method_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SpecError, match=message) as caught:
        check_file(method_file(tmp_path, text))
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
def test_a_missing_class_gives_an_error_that_names_it(
    tmp_path: Path, surrogate: str, message: str
) -> None:
    with pytest.raises(MorBenchError, match=message):
        check_file(method_file(tmp_path, surrogate=surrogate))


def test_an_unknown_name_gives_an_error_with_the_nearest_one() -> None:
    with pytest.raises(SpecError, match=r"unknown dataset 'beam-coarze'; did you mean 'beam-coars"):
        mor_bench.load_scene("beam-coarze")
    with pytest.raises(SpecError, match=r"unknown method 'pood'; did you mean 'pod'\?"):
        mor_bench.load_method("pood")
    with pytest.raises(SpecError, match="no such file"):
        mor_bench.load_scene("nowhere/else.toml")


def test_load_method_takes_hyperparameters_and_checks_them() -> None:
    assert mor_bench.load_method("pod", n_modes=7).parameters["n_modes"] == 7
    with pytest.raises(SpecError, match=r"n_mode.*did you mean 'n_modes'"):
        mor_bench.load_method("pod", n_mode=3)
    with pytest.raises(SpecError, match="PODGalerkin: `n_modes` must be greater than or equal to"):
        mor_bench.load_method("pod", n_modes=0)


def test_a_profile_replaces_parameters_and_sweep(tmp_path: Path) -> None:
    text = """
        [parameters]
        tolerance = 1e-3
        [sweep]
        n_modes = [1, 2]
        [profiles.quick]
        sweep.n_modes = [5]
        parameters.tolerance = 0.1
    """
    spec = load_method_spec(method_file(tmp_path, text))
    assert spec.configurations("quick") == [{"tolerance": 0.1, "n_modes": 5}]
    assert spec.configurations("full") == [
        {"tolerance": 1e-3, "n_modes": 1},
        {"tolerance": 1e-3, "n_modes": 2},
    ]


def test_the_digest_depends_on_physics_only() -> None:
    spec = load_generated_spec("beam-tiny")
    split = spec.split.model_copy(update={"by": "sample"})
    assert spec.digest() == spec.model_copy(update={"title": "other", "split": split}).digest()
    stiffer = spec.material.model_copy(update={"young_pa": 501.0})
    assert spec.digest() != spec.model_copy(update={"material": stiffer}).digest()


@pytest.mark.parametrize(
    ("former", "name", "told"),
    [
        ("pca-regression-force", "pca-regression", "input"),
        ("pgd", "pgd-snapshots", "linear-response"),
        ("pgd-force", "pgd-snapshots-force", "input"),
    ],
)
def test_a_former_name_of_a_method_is_read_with_a_warning(
    former: str, name: str, told: str
) -> None:
    with pytest.warns(RenamedWarning, match=f"`{former}` is now `{name}`"):
        spec = load_method_spec(former)
    assert (spec.name, spec.told) == (name, told)
