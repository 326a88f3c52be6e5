"""Every reader of a file answers a damaged or forged one with its content or one clear line."""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from pydantic import ValidationError

import mor_bench
from mor_bench.array_files import read_npy
from mor_bench.digests import digest_of_arrays
from mor_bench.export.asv_files import (
    COLUMNS,
    Figure,
    Figures,
    is_own_project,
    to_columns,
    write_file,
)
from mor_bench.export.asv_results import describe
from mor_bench.hard_cases.catalogue import CaseResult
from mor_bench.hard_cases.suite import StressResults
from mor_bench.measure.discretisation_error import measured
from mor_bench.measure.method_session import MethodSession
from mor_bench.report.hard_case_table import stress_table
from mor_bench.results.arrays import verified_arrays, write_verified
from mor_bench.runs.cached_fit import read_fit_record, training_seconds
from mor_bench.runs.scoring import read_cost
from mor_bench.runs.shipped_models import shipped_models
from mor_bench.sandbox.process import parsed_answer
from mor_bench.scene.files import read_mesh
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.snapshot_file import read_arrays
from mor_bench.scene.surfaces import read_surface
from mor_bench.snapshots.generate import shard_seconds
from mor_bench.snapshots.manifest import Manifest, read_manifest
from mor_bench.snapshots.solve import GENERATOR_VERSION
from mor_bench.snapshots.store import (
    HEADER_BYTES,
    SCHEMA_VERSION,
    Shard,
    header_line,
    read_shard,
    write_shard,
)
from mor_bench.specs import (
    SourceFile,
    check_parameters,
    load_dataset_spec,
    load_generated_spec,
    load_method_spec,
)
from tests.mutations import (
    JSON,
    PAGE,
    QUICK,
    SLOW,
    TEXT,
    Reader,
    attacked,
    documented,
    mutated_bytes,
    mutated_json,
)

SUITE = Path(mor_bench.__file__).parents[1]


tiny_spec = cache(partial(load_generated_spec, "beam-tiny"))


def of_suite(kind: str, name: str) -> Callable[[Path], object]:
    return lambda path: shutil.copyfile(SUITE / kind / name, path)


def build(path: Path) -> None:
    mor_bench.load_scene(load_dataset_spec(path))


def mesh_of(tetrahedra: bool = False) -> meshio.Mesh:
    mesh = box_mesh((2.0, 1.0, 1.0), (2, 1, 1), tetrahedra)
    held = (mesh.points[:, 0] == 0.0).astype(int)
    kind = "tetra" if tetrahedra else "hexahedron"
    return meshio.Mesh(mesh.points, [(kind, mesh.cells)], point_data={"held": held})


def checked_method(path: Path) -> None:
    spec = load_method_spec(path)
    check_parameters(spec.load_class(), spec.configurations("full")[0])


def written_as(file_format: str, **options: Any) -> Callable[[Path], object]:
    return lambda path: meshio.write(path, mesh_of(), file_format=file_format, **options)


def plain_msh(path: Path, version: str = "gmsh22") -> None:
    mesh = mesh_of()
    mesh.point_data.clear()
    meshio.write(path, mesh, file_format=version, binary=False)


def surface(path: Path, **options: Any) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    meshio.write(path, meshio.Mesh(points, [("triangle", faces)]), **options)


def body(path: Path) -> object:
    return read_mesh(path, 1.0)


def source(path: Path) -> object:
    return read_arrays(SourceFile(path=str(path), sha256=sha256(path.read_bytes())))


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def snapshots() -> dict[str, np.ndarray]:
    mesh, generator = box_mesh((2.0, 1.0, 1.0), (2, 1, 1)), np.random.default_rng(0)
    shape = (6, mesh.n_nodes, 3)
    fixed = np.flatnonzero(mesh.points[:, 0] == 0.0)
    moved = generator.normal(size=shape)
    moved[:, fixed] = 0.0
    return {
        "points": mesh.points,
        "cells": mesh.cells,
        "forces": generator.normal(size=shape),
        "displacements": moved,
        "fixed_nodes": fixed,
        "regions": np.arange(6) % 3,
    }


def snapshots_npz(path: Path) -> None:
    np.savez(path, allow_pickle=False, **snapshots())


def snapshots_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, array in snapshots().items():
            file.create_dataset(name, data=array, compression="gzip")


def repacked(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate the arrays of an NPZ file, not the archive."""
    arrays = dict(np.load(io.BytesIO(content)))
    name = list(arrays)[generator.integers(len(arrays))]
    array = arrays[name]
    match generator.integers(6):
        case 0:
            del arrays[name]
        case 1:
            kinds = ("f4", "f8", "i1", "i8", "u8", "c16", "U5", "?", "M8[s]", "S3")
            with np.errstate(all="ignore"):
                arrays[name] = array.astype(kinds[generator.integers(len(kinds))])
        case 2:
            arrays[name] = array[None] if generator.random() < 0.5 else array.ravel()
        case 3:
            arrays[name] = array[: int(generator.integers(0, len(array) + 1))]
        case 4:
            flat = array.astype(float).ravel()
            values = [np.nan, np.inf, -1.0, 1e308, 1e-320, 7.0, 1e12, 0.0]
            flat[generator.integers(flat.size)] = values[generator.integers(len(values))]
            arrays[name] = flat.reshape(array.shape).astype(array.dtype)
        case _:
            arrays["extra"] = array
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def a_shard(path: Path) -> None:
    vectors = np.ones((3, 1, 3))
    patches, status = np.zeros((3, 1), np.int64), np.zeros(3, np.uint8)
    write_shard(path, Shard("key", 0, patches, vectors, np.zeros((3, 9)), np.ones(3), status))


def a_parametric_shard(path: Path) -> None:
    a_shard(path)
    write_shard(path, replace(read_shard(path), parameters=np.ones((3, 2))))


def forged_shard(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate the HDF5 part of a shard, with a header that fits."""
    rest = mutated_bytes(content[HEADER_BYTES:], generator)
    return header_line(SCHEMA_VERSION, len(rest), sha256(rest)) + rest


def a_manifest(path: Path) -> None:
    manifest = Manifest(tiny_spec(), GENERATOR_VERSION, 10, 100, ({"a": "b"},))
    path.write_bytes(manifest.to_json())


def manifest_of(path: Path) -> object:
    return read_manifest(path.parent)


def forged_manifest(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate a manifest, with a checksum that fits."""
    changed = json.loads(mutated_json(content, generator))
    if isinstance(changed, dict):
        changed.pop("sha256", None)
        changed["sha256"] = sha256(json.dumps(changed, sort_keys=True).encode())
    return json.dumps(changed).encode()


def a_fit(path: Path) -> None:
    record = {
        "method": "pod",
        "n_train": 10,
        "n_dofs": 30,
        "fit_s": 1.0,
        "fit_core_s": 1.0,
        "fit_memory_bytes": 10**8,
        "model_bytes": 1000,
        "needs_snapshots": True,
        "parameters": {"n_modes": 5},
        "training": {"iterations": 5, "loss": [1.0, float("nan")]},
        "warnings": ["w"],
    }
    path.write_text(json.dumps(record))


def asv(path: Path) -> None:
    figures: Figures = {
        ("'pod'", "'quick'"): Figure(1.0, {"q_25": 0.9}),
        ("'fem'", "'quick'"): Figure(None),
    }
    content = {
        "commit_hash": "0" * 40,
        "date": 0,
        "params": {},
        "result_columns": COLUMNS,
        "results": {"comparison.beam-tiny.latency": to_columns(figures)},
    }
    write_file(path, content, "results")


def stress_results(path: Path) -> None:
    row = CaseResult("zero-force", "", "pod", "zero", "zero", "pass", {"size": 0.0}, 0.1)
    StressResults([row], "quick", {"cores": 2}).write(path)


def stressed(path: Path) -> None:
    found = StressResults.read(path)
    stress_table(found, [row.method for row in found.rows])


def a_score(path: Path) -> None:
    write_verified(path, {"mean_dof_m": np.ones(5), "relative_l2": np.ones(5)})


def forged_score(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate the digest of a score."""
    at = content.index(
        digest_of_arrays({"mean_dof_m": np.ones(5), "relative_l2": np.ones(5)}).encode()
    )
    changed = bytearray(content)
    changed[at + int(generator.integers(64))] = int(generator.integers(256))
    return bytes(changed)


def cost(path: Path) -> None:
    with suppress(ValidationError):  # it is counted again
        read_cost(path)


def an_answer(path: Path) -> None:
    answer = {"latency_ms": [1.0, 2.0], "gc_ms": [0.0, 0.0], "checked": [1], "warnings": ["w"]}
    path.write_text(json.dumps({**answer, "cpu_s": 1.0, "wall_s": 1.0, "cpu_all_s": 2.0}))


def answered(path: Path) -> None:
    parsed_answer(path.read_bytes(), MethodSession, "time")


def gmsh1(path: Path) -> None:
    points, cells = mesh_of().points, mesh_of().cells[0].data
    nodes = [f"{i + 1} {x} {y} {z}" for i, (x, y, z) in enumerate(points)]
    elements = [
        f"{i + 1} 5 7 7 8 {' '.join(str(n + 1) for n in cell)}" for i, cell in enumerate(cells)
    ]
    lines = ["$NOD", str(len(nodes)), *nodes, "$ENDNOD", "$ELM", str(len(cells)), *elements]
    path.write_text("\n".join([*lines, "$ENDELM", ""]))


READERS = [
    Reader("dataset.toml", of_suite("datasets", "beam-tiny.toml"), build, TEXT),
    Reader("l-shape.toml", of_suite("datasets", "l-shape.toml"), load_dataset_spec, TEXT),
    Reader(
        "method.toml",
        of_suite("methods", "pod.toml"),
        checked_method,
        TEXT,
    ),
    Reader("mesh.vtu", written_as("vtu", binary=False), body, TEXT),
    Reader("packed.vtu", written_as("vtu"), body, [mutated_bytes]),
    Reader("mesh.vtk", written_as("vtk", binary=False), body, TEXT),
    Reader("packed.vtk", written_as("vtk"), body, [mutated_bytes]),
    Reader("mesh42.vtk", written_as("vtk42", binary=False), body, TEXT),
    Reader("packed42.vtk", written_as("vtk42"), body, [mutated_bytes]),
    Reader("mesh.msh", plain_msh, body, TEXT),
    Reader("packed.msh", written_as("gmsh"), body, [mutated_bytes]),
    Reader("mesh41.msh", partial(plain_msh, version="gmsh"), body, TEXT),
    Reader("packed22.msh", written_as("gmsh22"), body, [mutated_bytes]),
    Reader("mesh1.msh", gmsh1, body, TEXT),
    Reader("mesh.inp", written_as("abaqus"), body, TEXT),
    Reader("mesh.med", written_as("med"), body, [mutated_bytes]),
    Reader("mesh.xdmf", written_as("xdmf", data_format="XML"), body, TEXT),
    Reader("mesh.mesh", written_as("medit"), body, TEXT),
    Reader("mesh.meshb", written_as("medit"), body, [mutated_bytes]),
    Reader("mesh.bdf", written_as("nastran"), body, TEXT),
    Reader("mesh.avs", written_as("avsucd"), body, TEXT),
    # meshio formats thousands of warnings for some of them.
    Reader("mesh.su2", written_as("su2"), body, TEXT, limit_s=10.0),
    Reader("mesh.f3grid", written_as("flac3d"), body, TEXT),
    Reader("mesh.b8.ugrid", written_as("ugrid"), body, [mutated_bytes]),
    Reader("surface.stl", surface, read_surface, TEXT),
    Reader("packed.stl", partial(surface, binary=True), read_surface, [mutated_bytes]),
    Reader("surface.obj", surface, read_surface, TEXT),
    Reader("snapshots.npz", snapshots_npz, source, [mutated_bytes]),
    Reader("arrays.npz", snapshots_npz, source, [repacked]),
    Reader("snapshots.h5", snapshots_h5, source, [mutated_bytes]),
    Reader("predictions.npy", lambda path: np.save(path, np.ones((3, 4))), read_npy, TEXT),
    Reader("shard.h5", a_shard, read_shard, [mutated_bytes, forged_shard]),
    Reader("parameters.h5", a_parametric_shard, read_shard, [mutated_bytes, forged_shard]),
    Reader("manifest.json", a_manifest, manifest_of, [*JSON, forged_manifest]),
    Reader("fit.json", a_fit, read_fit_record, JSON),
    Reader(
        "training.json",
        lambda path: path.write_text('{"taken_s": 12.5}'),
        training_seconds,
        JSON,
    ),
    Reader("score.h5", a_score, verified_arrays, [mutated_bytes, forged_score]),
    Reader("cost.json", lambda path: path.write_text('{"cells": 135.0}'), cost, JSON),
    Reader("answer.json", an_answer, answered, JSON),
    Reader("seconds-00000.txt", lambda path: path.write_text("1.25\n"), shard_seconds, TEXT),
    Reader("stress.json", stress_results, stressed, JSON),
    Reader("pyproject.toml", of_suite(".", "pyproject.toml"), is_own_project, TEXT),
    Reader("0-mor-bench-py3.11.json", asv, lambda path: describe(path.parents[1]), JSON),
    Reader(
        "umesh-beam-coarse.json",
        of_suite("trained", "umesh-beam-coarse.json"),
        lambda path: shipped_models(path.parent),
        JSON,
    ),
    Reader(
        "beam-tiny.refine.json",
        of_suite("datasets", "beam-tiny.refine.json"),
        lambda path: measured(tiny_spec(), path.parent, path.parents[1]),
        JSON,
    ),
]
"""Results, raw samples, models and checkpoints are in `tests.test_mutated_results`."""


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_mutated_files_are_read_or_refused(reader: Reader, tmp_path: Path) -> None:
    attacked(reader, tmp_path, QUICK)


@pytest.mark.nightly
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_many_mutated_files_are_read_or_refused(reader: Reader, tmp_path: Path) -> None:
    attacked(reader, tmp_path, SLOW)


def test_the_documented_counts_are_those_of_these_tests() -> None:
    assert documented()[f"files of {len(READERS)} kinds, see below"] == len(READERS) * SLOW
    named = re.findall("`([^`]*)`", PAGE.read_text(encoding="utf-8").partition("The kinds are ")[2])
    assert named[: len(READERS)] == [reader.name for reader in READERS]
