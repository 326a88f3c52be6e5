"""`mor-bench new-method` writes a small real method that works as it is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.cli.new_method import write_method
from mor_bench.errors import SpecError
from mor_bench.runs.file_check import check_file
from mor_bench.snapshots.dataset import Dataset
from tests.architecture_checks import CHECKS

ROOT = Path(__file__).parents[1]


def in_folder(folder: Path, *arguments: str) -> str:
    """Run Python in a folder whose own `mor_bench` is imported, and return its output."""
    done = subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_new_method_is_valid_and_reproduces_its_training_data(
    tmp_path: Path, tiny: Dataset
) -> None:
    toml, source = write_method("my-first-method", tmp_path / "mine")
    assert {toml, source} == set((tmp_path / "mine").iterdir())
    assert check_file(toml) == "method, 3 quick and 3 full configurations"
    method = mor_bench.load_method(toml).fit(tiny.scene, tiny.train)
    predicted = method.predict(tiny.train.forces[:5])
    reference = tiny.train.displacements[:5]
    np.testing.assert_allclose(predicted, reference, atol=1e-9 * np.abs(reference).max())


def test_in_a_checkout_the_new_files_join_the_suite_and_keep_the_laws_of_the_tree(
    tmp_path: Path,
) -> None:
    for folder in ("methods", "mor_bench/surrogates"):
        (tmp_path / folder).mkdir(parents=True)
    toml, source = write_method("b2", tmp_path)
    assert toml == tmp_path / "methods" / "b2.toml"
    assert source == tmp_path / "mor_bench" / "surrogates" / "b2.py"
    assert 'surrogate = "mor_bench.surrogates.b2:B2"' in toml.read_text(encoding="utf-8")
    tree = {"mor_bench/surrogates/b2.py": source.read_text(encoding="utf-8")}
    assert [broken for check in CHECKS.values() for broken in check(tree)] == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("3d", "begin with a letter; got '3d'"),
        ("My-method", "must hold lower-case letters"),
        ("../escape", "must hold lower-case letters"),
        ("json", "Python has a module or keyword"),
        ("class", "Python has a module or keyword"),
        ("none", "Python has a module or keyword"),
        ("field", "its class would be called Field, a name that its file imports"),
        ("scene", "its class would be called Scene"),
        ("pod", "'pod' is a method of the suite"),
    ],
)
def test_a_bad_name_is_refused_and_nothing_is_written(
    tmp_path: Path, name: str, message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        write_method(name, tmp_path / "mine")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("existing", ["mine.toml", "mine.py"])
def test_existing_files_are_kept_and_nothing_is_written_in_part(
    tmp_path: Path, existing: str
) -> None:
    (tmp_path / existing).write_text("keep me", encoding="utf-8")
    with pytest.raises(SpecError, match=f"{existing}: the file exists"):
        write_method("mine", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    assert (tmp_path / existing).read_text(encoding="utf-8") == "keep me"


@pytest.mark.slow
def test_in_a_checkout_the_method_passes_check_the_battery_and_a_run(
    tmp_path: Path, cache: Path
) -> None:
    for folder in ("mor_bench", "methods", "datasets"):
        shutil.copytree(ROOT / folder, tmp_path / folder)  # with the kernels that Numba compiled
    in_folder(tmp_path, "mor_bench", "new-method", "mine")
    assert "method, 3 quick" in in_folder(tmp_path, "mor_bench", "check", "methods/mine.toml")
    out = ["--limit", "60", "--cache", str(cache), "--out", "out"]
    assert "mine" in in_folder(tmp_path, "mor_bench", "run", "beam-tiny", "-m", "mine", *out)
    (tmp_path / "tests").mkdir()
    for path in (*ROOT.glob("tests/*.py"), ROOT / "pyproject.toml"):
        shutil.copy(path, tmp_path / path.relative_to(ROOT))
    battery = in_folder(tmp_path, "pytest", "-q", "tests/test_contract.py", "-k", "mine")
    assert " passed" in battery
    assert " failed" not in battery
