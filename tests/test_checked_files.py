"""Files that attack their reader: each is refused at once, in one line that names it."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
import zlib
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest

import mor_bench
from mor_bench.array_files import read_hdf5, read_npy, read_npz
from mor_bench.checked_files import check_file, read_bytes, read_json, read_toml
from mor_bench.errors import MorBenchError, SpecError, StoreError, printable
from mor_bench.measure.discretisation_error import measured
from mor_bench.results.comparison import Comparison
from mor_bench.scene.files import read_mesh, read_triangles
from mor_bench.scene.mesh import box_mesh
from mor_bench.snapshots.manifest import read_manifest
from mor_bench.snapshots.sampling import far_apart, n_samples_of
from mor_bench.snapshots.store import read_shard
from mor_bench.specs import (
    MethodSpec,
    load_dataset_spec,
    load_generated_spec,
    load_method_spec,
)
from tests.model_files import sealed

READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "TOML of a dataset": ("a.toml", load_dataset_spec),
    "TOML of a method": ("a.toml", load_method_spec),
    "results": ("results.json", lambda path: Comparison.read(path.parent)),
    "manifest": ("manifest.json", lambda path: read_manifest(path.parent)),
    "shard": ("shard-00000.h5", read_shard),
    "model": ("a.safetensors", mor_bench.load_surrogate),
    "mesh": ("a.vtu", lambda path: read_mesh(path, 1.0)),
    "surface": ("a.stl", lambda path: read_triangles(path, 1.0)),
    "snapshots in NPZ": ("a.npz", read_npz),
    "snapshots in HDF5": ("a.h5", read_hdf5),
    "predictions": ("a.npy", read_npy),
}


def refused(read: Callable[[Path], Any], path: Path, message: str) -> None:
    with pytest.raises(MorBenchError, match=message) as caught:
        read(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("thing", ["pipe", "device"])
def test_only_regular_files_are_replaced(thing: str, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    if thing == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    fitted = mor_bench.load_method("linear-fem").fit(mor_bench.load_scene("beam-tiny"), None)
    before = path.lstat()
    refused(fitted.save, path, "is a device or pipe")
    assert os.path.samestat(path.lstat(), before)  # it was not replaced
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("thing", ["pipe", "device", "folder"])
def test_only_regular_files_are_read(kind: str, thing: str, tmp_path: Path) -> None:
    name, read = READERS[kind]
    path = tmp_path / name
    if thing == "folder":
        path.mkdir()
    elif not hasattr(os, "mkfifo"):
        pytest.skip("there are no named pipes")
    elif thing == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    refused(read, path, "a device or pipe, not a file|Is a directory|: a folder; ")


def test_the_size_of_a_file_is_limited(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"[1, 2]")
    assert read_bytes(path, 6) == b"[1, 2]"
    for read in (read_bytes, check_file):
        with pytest.raises(
            StoreError, match=r"a\.json: 6 bytes; files of this kind have at most 5"
        ):
            read(path, 5)
    path.write_bytes(b"[" + b"0," * 2**23 + b"0]")
    refused(read_json, path, "files of this kind have at most 16,777,216")


DEEP = {
    "a.toml": [
        "a = " + "[" * 400 + "]" * 400,
        "a = " + "[" * 100_000,
        ".".join("a" * 90) + "=1",
        r'"\"".' * 30_000 + "a = 1",
        "'\u2028' . " * 30_000 + "a = 1",
    ],
    "a.json": ["[" * 65 + "]" * 65, "[" * 100_000, '{"a":' * 70 + "1" + "}" * 70],
}


@pytest.mark.parametrize(("name", "text"), [(name, text) for name in DEEP for text in DEEP[name]])
def test_deep_nesting_is_refused(name: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    read = read_toml if name == "a.toml" else read_json
    refused(read, path, "tables and lists are nested more than 64 deep")


def test_content_of_few_levels_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" * 64 + "]" * 64)
    assert read_json(path)


@pytest.mark.parametrize("text", ["1" * 5000, "123456789012345678901", '"\\ud800"', "nul", "\xff"])
def test_values_that_no_program_can_hold_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin1"))
    refused(read_json, path, "a.json: not valid JSON")
    path = tmp_path / "a.toml"
    path.write_text(f"a = 0x{'f' * 5000}")
    refused(read_toml, path, "not valid TOML: an integer has more than 64 bits")


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    shipped = Path(mor_bench.__file__).parents[1] / "datasets" / "beam-tiny.toml"
    path = tmp_path / "beam-tiny.toml"
    path.write_bytes(b"\xef\xbb\xbf" + shipped.read_bytes())
    assert load_dataset_spec(path) == load_dataset_spec("beam-tiny")


def test_a_reader_of_json_never_shows_its_parser(tmp_path: Path) -> None:
    (tmp_path / "datasets").mkdir()
    path = tmp_path / "datasets" / "a.refine.json"
    path.write_text("[" * 10_000)
    refused(
        lambda _: measured(load_generated_spec("beam-tiny"), tmp_path, tmp_path), path, "damaged"
    )


def npz(members: dict[str, bytes], **kinds: Any) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", **kinds) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


ONE = npy(np.zeros(3))
TWICE = npz({"a.npy": ONE, "b.npy": ONE}).replace(b"b.npy", b"a.npy")
ENCRYPTED = bytearray(npz({"a.npy": ONE}))
ENCRYPTED[ENCRYPTED.rindex(b"PK\x01\x02") + 8] |= 1
BAD_NPZ = {
    "pickle": (b"\x80\x04cos\nsystem\n.", "File is not a zip file"),
    "object": (npz({"a.npy": npy(np.array([None, 1], object))}), "holds Python objects"),
    "doubled": (TWICE, "`a` occurs more than once"),
    "with and without ending": (npz({"a.npy": ONE, "a": ONE}), "`a` occurs more than once"),
    "encrypted": (bytes(ENCRYPTED), "encrypted"),
    "compression": (npz({"a.npy": ONE}, compression=zipfile.ZIP_LZMA), "compression is unknown"),
    "huge header": (npz({"a.npy": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31)}), "readable"),
    "huge shape": (
        npz({"a.npy": ONE.replace(b"(3,), }         ", b"(3000000000,), }")}),
        "truncated",
    ),
    "bomb": (npz({"a.npy": bytes(2**27)}, compression=zipfile.ZIP_DEFLATED), "arrays of 134 MB"),
    "not an array": (npz({"a.npy": b"hello"}), "not a readable .npz file"),
}


@pytest.mark.parametrize("kind", BAD_NPZ)
def test_odd_npz_files_are_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    content, message = BAD_NPZ[kind]
    path.write_bytes(content)
    refused(read_npz, path, message)


def linked(file: h5py.File) -> None:
    file["a"] = h5py.ExternalLink("other.h5", "/a")


def circular(file: h5py.File) -> None:
    file["a"] = h5py.SoftLink("/")


def outside(file: h5py.File) -> None:
    file.create_dataset("a", (3,), "f8", external=[("other.raw", 0, 24)])


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "a", shape=(3,))
    file.create_virtual_dataset("a", layout)


def huge(file: h5py.File) -> None:
    file.create_dataset("a", (10**12,), "f8", chunks=(1000,))


def words(file: h5py.File) -> None:
    file["a"] = ["one", "two"]


BAD_HDF5: dict[Callable[[h5py.File], None], str] = {
    linked: "`a` is a link to another place or file",
    circular: "`a` is a link to another place or file",
    outside: "the content of `a` lies in other files",
    virtual: "the content of `a` lies in other files",
    huge: "declares arrays of 8,000,000 MB",
    words: "`a` must be an array of numbers",
}


@pytest.mark.parametrize("write", BAD_HDF5, ids=lambda write: write.__name__)
def test_odd_hdf5_files_are_refused(write: Callable[[h5py.File], None], tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        write(file)
    refused(read_hdf5, path, BAD_HDF5[write])


def test_the_header_of_a_model_file_is_limited(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(struct.pack("<Q", 2**40) + b"{}")
    refused(mor_bench.load_surrogate, path, "not a readable safetensors file: .*[Hh]eader")


def body(path: Path) -> meshio.Mesh:
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))
    whole = meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)])
    meshio.write(path, whole)
    return whole


@pytest.mark.parametrize("kind", ["HDF", "Binary"])
def test_a_mesh_in_two_files_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))
    whole = meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)])
    meshio.write(path, whole, file_format="xdmf", data_format=kind)
    refused(lambda p: read_mesh(p, 1.0), path, "refers to another file .*; a mesh must be one file")
    meshio.write(path, whole, file_format="xdmf", data_format="XML")
    assert read_mesh(path, 1.0)[0].n_nodes == 27


@pytest.mark.parametrize("name", ["a.node", "a.ele", "a.xml", "a.vol.gz"])
def test_formats_of_several_or_packed_files_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"1")
    refused(lambda p: read_mesh(p, 1.0), path, "a mesh must be one file, not packed")


def test_a_grid_that_lists_no_cells_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_text(
        "# vtk DataFile Version 3.0\n\nASCII\nDATASET STRUCTURED_POINTS\n"
        "DIMENSIONS 100 100 100\nORIGIN 0 0 0\nSPACING 1 1 1\n"
    )
    refused(lambda p: read_mesh(p, 1.0), path, "a grid of type STRUCTURED_POINTS lists no cells")


def test_an_included_abaqus_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.inp"
    body(path)
    assert read_mesh(path, 1.0)[0].n_nodes == 27
    path.write_text(path.read_text() + "*Include, input=nodes.inp\n")
    refused(lambda p: read_mesh(p, 1.0), path, "refers to another file .*Include, input=nodes.inp")


def test_a_mesh_in_hdf5_with_a_link_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.med"
    body(path)
    assert read_mesh(path, 1.0)[0].n_nodes == 27
    with h5py.File(path, "a") as file:
        linked(file)
    refused(lambda p: read_mesh(p, 1.0), path, "`a` is a link to another place or file")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux limits memory")
def test_a_compression_bomb_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.vtu"
    body(path)
    block = zlib.compress(bytes(2**29), 9)
    header = struct.pack("<IIII", 1, 2**29, 0, len(block))
    data = b64encode(header).decode() + b64encode(block).decode()
    text = path.read_text()
    start = text.index(">", text.index("<DataArray")) + 1
    path.write_text(text[:start] + data + text[text.index("</DataArray>") :])
    refused(lambda p: read_mesh(p, 1.0), path, "reading it takes more than .* MB of memory")


def test_many_equal_points_are_counted_and_not_listed(tmp_path: Path) -> None:
    path = tmp_path / "a.vtu"
    points = np.vstack([np.zeros((20_000, 3)), np.eye(3)])
    cells = np.array([[i, 20_000, 20_001, 20_002] for i in range(20_000)])
    meshio.write(path, meshio.Mesh(points, [("tetra", cells)]))
    refused(lambda p: read_mesh(p, 1.0), path, "399,980,000 pairs of nodes coincide")


@pytest.mark.parametrize("unit_m", [1e300, 1e-30])
def test_coordinates_beyond_double_precision_are_refused(unit_m: float, tmp_path: Path) -> None:
    for name in ("a.vtu", "a.stl"):
        path = tmp_path / name
        if name == "a.vtu":
            body(path)
        else:
            points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
            faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
            meshio.write(path, meshio.Mesh(points, [("triangle", faces)]))
        if name == "a.vtu" or unit_m > 1:
            reader: Callable[..., Any] = read_mesh if name == "a.vtu" else read_triangles
            refused(partial(reader, unit_m=unit_m), path, "positions must be in")


def test_a_plan_of_too_many_samples_is_refused() -> None:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    spec["loads"]["samples_per_patch"] = 10_000_000
    scene = mor_bench.load_scene(spec)
    with pytest.raises(SpecError, match=r"10,000,000 samples each are .* at most 10,000,000 are"):
        n_samples_of(scene)
    with pytest.raises(SpecError, match="at most 10,000 patches; got 20,000"):
        far_apart(np.zeros((20_000, 3)).tobytes(), 2, 1.0)


def test_a_sweep_of_too_many_configurations_is_refused() -> None:
    shipped = load_method_spec("pod").model_dump(mode="json", exclude={"name", "folder"})
    whole = {"name": "pod", **shipped, "sweep": {"n_modes": list(range(1, 1002))}}
    with pytest.raises(ValueError, match="at most 1,000 configurations; got 1,001"):
        MethodSpec.model_validate(whole)


def forged_model(scene: Any) -> bytes:
    header = {
        "format": "mor-bench surrogate",
        "schema_version": "1",
        "surrogate": "mor_bench.surrogates.pod:PODGalerkin",
        "parameters": "{}",
        "scene": json.dumps(scene),
    }
    return sealed(header, {"modes": np.zeros((3, 3))})


def test_the_scene_of_a_model_names_no_local_file(tmp_path: Path) -> None:
    model, secret = tmp_path / "a.safetensors", tmp_path / "secret.toml"
    secret.write_text("secret = 1")
    model.write_bytes(forged_model(str(secret)))
    refused(mor_bench.load_surrogate, model, "scene: a dataset must be a table; got str")
    scene = load_generated_spec("beam-tiny").model_dump(mode="json")
    scene["geometry"] = {"shape": "file", "file": str(secret)}
    model.write_bytes(forged_model(scene))
    refused(mor_bench.load_surrogate, model, "it must be a table of `path` and `sha256`")
    scene["geometry"]["file"] = {"path": str(secret), "sha256": "0" * 64}
    model.write_bytes(forged_model(scene))
    refused(mor_bench.load_surrogate, model, "secret.toml: the file has changed")


def test_a_dataset_whose_name_is_a_path_is_refused(tmp_path: Path) -> None:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    for name in ("../../x", str(tmp_path / "x"), "..", "", "a b", "A", "a\n", "x" * 300):
        with pytest.raises(SpecError, match="name"):
            mor_bench.load_dataset({**spec, "name": name}, cache=tmp_path / "cache")
    assert not list(tmp_path.iterdir())


def test_text_from_a_file_cannot_steer_the_terminal() -> None:
    assert printable("a\x1b[31mb\x07\n") == "a\\x1b[31mb\\x07\n"
    assert len(printable("a" * 10**6)) < 2100


def test_a_long_wrong_value_is_not_quoted_in_full(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f'surrogate = 1\ntitle = "{"a" * 100_000}"\n')
    with pytest.raises(SpecError) as caught:
        load_method_spec(path)
    assert len(str(caught.value)) < 1000
