"""The command line, in processes of its own as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import mor_bench_command as mor_bench


def test_help_imports_nothing_heavy() -> None:
    heavy = [
        "numpy",
        "scipy",
        "numba",
        "pandas",
        "torch",
        "matplotlib",
        "sklearn",
        "pydantic",
        "h5py",
    ]
    code = f"""
import sys
from typer.testing import CliRunner
from mor_bench.cli.app import app
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
print([name for name in {heavy} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_library_does_not_import_torch_unless_asked() -> None:
    code = "import sys, mor_bench; mor_bench.load_scene('beam-tiny'); mor_bench.load_method('pod'); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_run_writes_everything_and_report_draws_it_again(tmp_path: Path, cache: Path) -> None:
    options = [
        "-m",
        "linear-fem",
        "-m",
        "pod",
        "--cache",
        str(cache),
        "--out",
        "out",
        "--split",
        "sample",
    ]
    done = mor_bench("run", "beam-tiny", *options, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert len(results["rows"]) == 8
    assert all(row["split"] == "sample" for row in results["rows"])
    out = tmp_path / "out"
    for name in ("results.json", "results.csv", "comparison.json", "report.html"):
        assert (out / name).stat().st_size > 100
    figures = sorted(out.glob("figures/*.png"))
    assert len(figures) >= 4
    assert (out / "report.html").read_text(encoding="utf-8").count("data:image/png;base64") >= 4
    for figure in figures:
        figure.unlink()
    again = mor_bench("report", "out", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert sorted(out.glob("figures/*.png")) == figures
    assert "pod" in again.stdout


def test_list_and_check(tmp_path: Path) -> None:
    listed = json.loads(mor_bench("list", "--json", cwd=tmp_path).stdout)
    assert {"beam-coarse", "beam-tiny"} <= {entry["name"] for entry in listed["datasets"]}
    assert {"fem", "pod", "hpod", "pca-regression", "umesh"} <= {
        entry["name"] for entry in listed["methods"]
    }
    assert mor_bench("check", cwd=tmp_path).returncode == 0
    bad = tmp_path / "bad.toml"
    bad.write_text('title = "x"\nsurogate = "y"\n')
    done = mor_bench("check", "bad.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "bad.toml: " in done.stderr
    assert done.stderr.count("\n") == 1


def test_refine_prints_and_keeps_its_record(tmp_path: Path) -> None:
    done = mor_bench(
        "refine",
        "beam-tiny",
        "--loads",
        "2",
        "--levels",
        "1",
        "--cache",
        "c",
        "--json",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.rglob("discretisation.json")
    assert json.loads(done.stdout) == json.loads(path.read_text())
    again = mor_bench(
        "refine",
        "beam-tiny",
        "--loads",
        "2",
        "--levels",
        "2",
        "--max-dofs",
        "1000",
        "--cache",
        "c",
        cwd=tmp_path,
    )
    assert "left out for their size: 1,536 cells (6,075 dofs)" in again.stdout
    assert "discretisation error of beam-tiny: mean e " in again.stdout


def test_generate_says_where(tmp_path: Path) -> None:
    done = mor_bench(
        "generate", "beam-tiny", "--limit", "100", "--workers", "1", "--cache", "c", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / done.stdout.strip()).glob("shard-*.h5"))) == 1


def test_generate_makes_the_test_sets_if_asked(tmp_path: Path) -> None:
    done = mor_bench(
        "generate",
        "beam-tiny",
        "--tests",
        "--limit",
        "5",
        "--workers",
        "1",
        "--cache",
        "c",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    folders = [Path(line) for line in done.stdout.splitlines()]
    names = [
        "beam-tiny",
        *(
            f"beam-tiny--{name}"
            for name in ("in-range", "2x", "4x", "unseen-regions", "several-forces")
        ),
    ]
    assert [folder.name.rsplit("-", 2)[0] for folder in folders] == names
    assert all((tmp_path / folder / "shard-00000.h5").is_file() for folder in folders)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "beam-coars"], "unknown dataset 'beam-coars'; did you mean 'beam-coarse'?"),
        (["run", "beam-tiny", "-m", "pood"], "unknown method 'pood'; did you mean 'pod'?"),
        (["run", "--suite", "nowhere"], "nowhere: a suite must hold a folder"),
        (["report", "nowhere"], "no such file"),
        (["refine", "beam-tini"], "unknown dataset 'beam-tini'; did you mean 'beam-tiny'?"),
        (
            ["refine", "beam-tiny", "--levels", "0", "--cache", "."],
            "`levels` must be an integer in [1, 10]; got 0.",
        ),
        (
            ["refine", "beam-tiny", "--max-dofs", "900", "--cache", "."],
            "`max_dofs` must be at least 975",
        ),
        (
            [
                "generate",
                "beam-tiny",
                "--workers",
                "2",
                "--cluster",
                "tcp://127.0.0.1:1",
                "--cache",
                ".",
            ],
            "`workers` and `cluster` exclude each other",
        ),
        (
            ["generate", "beam-tiny", "--cluster", "host", "--cache", "."],
            "must be the address of a Dask scheduler, tcp://host:port; got 'host'",
        ),
        (["run", "beam-tiny", "--threads", "100000"], "`threads` must be an integer in [1, "),
    ],
)
def test_errors_are_one_line_and_nothing_is_written(
    tmp_path: Path, arguments: list[str], message: str
) -> None:
    done = mor_bench(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_an_encoding_without_our_letters_stops_nothing(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(
        "PYTHONIOENCODING", "ascii"
    )  # that of files and pipes on Windows lacks ē too
    done = mor_bench(
        "run", "beam-tiny", "-m", "linear-fem", "--out", "out", "--cache", str(cache), cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "linear-fem" in done.stdout
