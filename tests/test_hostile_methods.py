"""Methods and files that attack the process which reads their results."""

from __future__ import annotations

import hashlib
import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import meshio
import numpy as np
import psutil
import pytest

from mor_bench.checked_files import read_written
from mor_bench.errors import MorBenchError, StoreError
from mor_bench.results.arrays import write_arrays
from mor_bench.results.comparison import Comparison
from mor_bench.runs.code_digest import imported_sources
from mor_bench.sandbox import process as process_module
from mor_bench.scene.files import read_mesh
from mor_bench.scene.mesh import box_mesh
from mor_bench.snapshots.store import (
    SCHEMA_VERSION,
    Shard,
    header_line,
    read_shard,
    shard_bytes,
)
from tests.case_marks import nightly_but
from tests.commands import invoke, mor_bench_command
from tests.small_runs import method_file, run_small
from tests.synthetic import a_row


def module(folder: Path, name: str, code: str, class_: str = "Mine") -> Path:
    """Write a method's module and its file."""
    (folder / f"{name}.py").write_text(code, encoding="utf-8")
    return method_file(folder, name, f"{name}:{class_}")


LINKED = """
import ctypes
import os
import numpy as np
import mor_bench

class Mine(mor_bench.Surrogate):
    needs_snapshots = False
    def answer(self, forces):
        return np.zeros_like(forces)
    def save(self, path):
        ctypes.CDLL(None).symlink(os.fsencode({secret!r}), os.fsencode(path))
"""


@pytest.mark.slow
def test_a_model_that_is_a_link_is_not_copied(cache: Path, tmp_path: Path) -> None:
    run_small(["linear-fem"], tmp_path / "before", cache)
    secret = next(cache.glob("datasets/*/shard-00000.h5"))
    path = module(tmp_path, "linked", LINKED.format(secret=str(secret)))
    (row,) = run_small([path], tmp_path / "out", cache).rows
    assert row.status == "failed"
    assert "a link to another file" in str(row.reason)
    stolen = secret.read_bytes()
    models = [file for file in cache.glob("fits/linked-*/*") if file.is_file()]
    assert all(file.read_bytes() != stolen for file in models)


@pytest.mark.parametrize("way", ["symbolic", "hard", "folder"])
def test_links_of_untrusted_processes_are_not_followed(way: str, tmp_path: Path) -> None:
    folder, secret = tmp_path / "own", tmp_path / "theirs" / "secret"
    folder.mkdir()
    secret.parent.mkdir()
    secret.write_bytes(b"secret")
    path = folder / "answers"
    if way == "symbolic":
        path.symlink_to(secret)
    elif way == "hard":
        path.hardlink_to(secret)
    else:
        (folder / "sub").symlink_to(secret.parent)
        path = folder / "sub" / "secret"
    with pytest.raises(StoreError, match=r"a link to another file|leads outside"):
        read_written(path, folder)
    plain = folder / "plain"
    plain.write_bytes(b"mine")
    assert read_written(plain, folder) == b"mine"


WRITTEN = {
    "a number": b"1\n",
    "no message": b'{"error": "x", "warnings": []}\n',
    "a number as error": b'{"error": 5, "message": "x", "warnings": []}\n',
    "no warnings": b"{}\n",
    "deep": b"[" * 100_000 + b"\n",
    "no JSON": b"hello\n",
    "odd bytes": b"\xff\xfe\n",
    "a flood": b"{}\n" * 50_000,
}

WRITER = """
import os
import mor_bench

for number in range(3, 64):
    try:
        if os.fstat(number) and number not in (0, 1, 2):
            os.write(number, {written!r})
    except OSError:
        pass

class Mine(mor_bench.Surrogate):
    needs_snapshots = False
    def answer(self, forces):
        return 0.0 * forces
"""


@pytest.mark.slow
@pytest.mark.parametrize("written", nightly_but(4, WRITTEN))
def test_what_a_method_writes_to_its_result_pipe_costs_its_row(
    written: str, cache: Path, tmp_path: Path
) -> None:
    path = module(tmp_path, "writer", WRITER.format(written=WRITTEN[written]))
    rows = run_small([path, "linear-fem"], tmp_path / "out", cache, time_limit_s=20.0).rows
    assert rows[1].ok
    assert rows[0].status == "failed"
    assert "\n" not in str(rows[0].reason)


def test_a_line_without_end_is_not_read_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(process_module, "MOST_ANSWER_BYTES", 1000)
    code = WRITER.format(written=b"x" * 5000)
    path = module(tmp_path, "endless", code)
    done = mor_bench_command("check", str(path), cwd=tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGRTMIN"), reason="needs real-time signals")
def test_a_death_by_a_nameless_signal_is_one_line(tmp_path: Path) -> None:
    path = module(tmp_path, "suicide", "import os\nos.kill(os.getpid(), 40)\n")
    done = mor_bench_command("check", str(path), cwd=tmp_path)
    assert done.returncode == 2
    assert "its process died of signal 40" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_module_with_deep_expressions_is_a_method_like_any_other(
    cache: Path, tmp_path: Path
) -> None:
    code = "from tests.third_party import Zero as Mine\nX = " + "+".join(["1"] * 1200) + "\n"
    path = module(tmp_path, "deep", code)
    assert "mor_bench.surrogate" in imported_sources("deep", tmp_path)
    (row,) = run_small([path], tmp_path / "out", cache).rows
    assert row.ok, row.reason


@pytest.mark.slow
def test_an_error_inside_a_third_partys_fit_is_one_line(cache: Path, tmp_path: Path) -> None:
    code = """
import mor_bench

class Mine(mor_bench.Surrogate):
    def fit(self, scene, snapshots=None):
        return {}["missing"]
    def answer(self, forces):
        return forces
"""
    path = module(tmp_path, "keyless", code)
    arguments = ["-m", str(path), "--out", "m", "--limit", "60", "--cache", str(cache)]
    done = mor_bench_command("fit", "beam-tiny", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "method keyless: crashed with KeyError: 'missing' (keyless.py, line 6)" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel of Linux ends the group")
def test_what_an_import_forks_dies_with_a_killed_check(tmp_path: Path) -> None:
    path = module(tmp_path, "forker", "import os, time\nos.fork()\ntime.sleep(300)\n")
    mark = {"MOR_BENCH_FORKER": str(tmp_path)}
    command = subprocess.Popen(
        [sys.executable, "-m", "mor_bench", "check", str(path)], env={**os.environ, **mark}
    )

    def own() -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("MOR_BENCH_FORKER") == str(tmp_path):
                    found.append(process)
            except psutil.Error:
                continue
        return found

    until = time.monotonic() + 60.0
    while len(own()) < 3 and time.monotonic() < until:
        time.sleep(0.2)
    assert len(own()) >= 3  # the command, its process, and the fork
    command.kill()
    command.wait()
    until = time.monotonic() + 5.0
    while left := [p for p in own() if p.status() != psutil.STATUS_ZOMBIE]:
        assert time.monotonic() < until, [p.cmdline() for p in left]
        time.sleep(0.1)


def forged(folder: Path, change: Callable[[h5py.File], None]) -> Path:
    """Return a shard with other content under a valid checksum."""
    sound = Shard(
        "key",
        0,
        np.zeros((1, 1), int),
        np.ones((1, 1, 3)),
        np.zeros((1, 9)),
        np.ones(1),
        np.zeros(1, np.uint8),
    )
    buffer = io.BytesIO(shard_bytes(sound))
    with h5py.File(buffer, "r+") as file:
        change(file)
    body = buffer.getvalue()[512:]
    path = folder / "shard-00000.h5"
    path.write_bytes(
        header_line(SCHEMA_VERSION, len(body), hashlib.sha256(body).hexdigest()) + body
    )
    return path


def _text(file: h5py.File) -> None:
    file.attrs["start"] = "x"


def _large(file: h5py.File) -> None:
    del file["displacements"]
    file.create_dataset("displacements", (4000, 100_000), "<f8", chunks=(100, 1000))


def _external(file: h5py.File) -> None:
    del file["min_det_f"]
    file.create_dataset("min_det_f", (1,), "<f8", external=[("/etc/hostname", 0, 8)])


def _linked(file: h5py.File) -> None:
    del file["min_det_f"]
    file["min_det_f"] = h5py.ExternalLink("/tmp/other.h5", "a")


def _words(file: h5py.File) -> None:
    del file["status"]
    file["status"] = np.array([b"ok"])


def _scalar(file: h5py.File) -> None:
    del file["status"]
    file["status"] = np.uint8(0)


@pytest.mark.parametrize("change", [_text, _large, _external, _linked, _words, _scalar])
def test_a_forged_shard_is_refused(change: Callable[[h5py.File], None], tmp_path: Path) -> None:
    assert read_shard(forged(tmp_path, lambda _: None)).start == 0
    with pytest.raises(StoreError, match=r"shard-00000\.h5: "):
        read_shard(forged(tmp_path, change))


@pytest.mark.slow
def test_scores_with_a_changed_digest_are_made_again(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = run_small(["linear-fem"], tmp_path / "a", cache).rows[0]
    for path in cache.glob("fits/*/score-*.h5"):
        content = bytearray(path.read_bytes())
        found = re.search(rb"[0-9a-f]{64}", content)
        assert found
        content[found.start()] = 0xE2
        path.write_bytes(content)
    assert run_small(["linear-fem"], tmp_path / "b", cache).rows[0].error == first.error


def body() -> meshio.Mesh:
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))
    return meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)])


@pytest.mark.parametrize(
    "text", [" *INCLUDE, INPUT=body.inp", "*INCLUDE,INPUT=body.inp\r", "INCLUDE,x=body.inp"]
)
def test_a_hidden_include_of_abaqus_is_refused(text: str, tmp_path: Path) -> None:
    meshio.write(tmp_path / "body.inp", body())
    path = tmp_path / "a.inp"
    path.write_bytes(f"*HEADING\r{text}\n".encode())
    with pytest.raises(MorBenchError, match="refers to another file"):
        read_mesh(path, 1.0)


@pytest.mark.parametrize("way", ["utf-16", "document type", "blanks"])
def test_a_hidden_reference_of_xdmf_is_refused(way: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    meshio.write(path, body(), file_format="xdmf", data_format="HDF")
    text = path.read_text(encoding="utf-8")
    if way == "utf-16":
        path.write_bytes(text.encode("utf-16"))
    elif way == "document type":
        head = '<!DOCTYPE Xdmf [<!ATTLIST DataItem Format CDATA "HDF">]>'
        path.write_text(head + text.replace(' Format="HDF"', ""), encoding="utf-8")
    else:
        path.write_text(text.replace('Format="HDF"', "Format\n=\n'&#72;DF'"), encoding="utf-8")
    with pytest.raises(MorBenchError, match="refers to another file"):
        read_mesh(path, 1.0)


def test_a_grid_without_cells_is_refused_behind_blanks(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_text(
        "# vtk DataFile Version 3.0\n\nASCII\n DATASET STRUCTURED_POINTS\n"
        "DIMENSIONS 71 71 71\nORIGIN 0 0 0\nSPACING 1 1 1\n"
    )
    with pytest.raises(MorBenchError, match="lists no cells"):
        read_mesh(path, 1.0)


def test_a_mesh_file_of_gigabytes_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.vtu"
    with path.open("wb") as file:
        file.truncate(6 * 2**30)  # without content it takes no space
    begun = time.process_time()
    with pytest.raises(MorBenchError, match="files of this kind have at most 1,073,741,824"):
        read_mesh(path, 1.0)
    assert time.process_time() - begun < 1.0


def test_many_named_sets_are_counted_in_one_pass(tmp_path: Path) -> None:
    path = tmp_path / "a.inp"
    sets = "".join(f"*NSET, NSET=a{i}\n1\n" for i in range(100_000))
    path.write_text(sets + "*NODE\n1, 0, 0, 0\n")
    begun = time.process_time()
    with pytest.raises(MorBenchError):
        read_mesh(path, 1.0)
    assert time.process_time() - begun < 5.0


NINES = "9" * 5000


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "beam-tiny", "-m", f"pod[n_modes={NINES}]", "--dry-run"],
        ["fit", "beam-tiny", "-m", "pod", "--set", f"n_modes={NINES}", "--out", "m"],
    ],
)
def test_a_number_of_thousands_of_digits_is_one_line(arguments: list[str]) -> None:
    done = invoke(*arguments)
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) <= 3


def test_a_long_width_in_columns_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", NINES)
    assert invoke("list").exit_code == 0


def test_raw_samples_of_a_long_name_have_a_short_one(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {}, [])
    rows = [a_row("m" * 200), a_row("m" * 200 + "n")]
    for row in rows:
        made.put(row, {"relative_l2": np.zeros(40)})
    assert len({made.samples_path(row) for row in rows}) == 2
    assert max(len(made.samples_path(row).name) for row in rows) < 190


@pytest.mark.slow
def test_a_method_named_like_a_pattern_is_planned(tmp_path: Path, cache: Path) -> None:
    path = method_file(tmp_path, "plain", "tests.third_party:Zero")
    odd = path.with_name("a**.toml")
    path.rename(odd)
    done = invoke("run", "beam-tiny", "-m", str(odd), "--dry-run", "--cache", str(cache))
    assert done.exit_code in (0, 2), done.exception


def test_raw_samples_are_written_behind_no_link(tmp_path: Path) -> None:
    victim, out = tmp_path / "victim", tmp_path / "out"
    victim.mkdir()
    out.mkdir()
    (out / "samples").symlink_to(victim)
    with pytest.raises(StoreError, match="is a link to another folder"):
        write_arrays(out / "samples" / "a.h5", {"a": np.zeros(3)})
    assert not list(victim.iterdir())
