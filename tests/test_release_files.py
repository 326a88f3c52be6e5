"""Files of a release agree: versions, the citation, the workflow, the container and the wheel."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from mor_bench.version import __version__
from tests.installed_wheel import INSTALLED_AS, expected_files

ROOT = Path(__file__).parents[1]


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def parsed(name: str) -> Any:
    yaml = pytest.importorskip("yaml", reason="needs PyYAML, which pre-commit installs")
    return yaml.safe_load(text(name))


def test_the_version_is_the_same_everywhere() -> None:
    (heading, *_) = re.findall("^## (.*)$", text("CHANGELOG.md"), re.MULTILINE)
    assert re.search(r"\d+\.\d+\.\d+", heading)[0] == __version__  # type: ignore[index]
    assert parsed("CITATION.cff")["version"] == __version__


def test_the_citation_has_what_the_format_requires() -> None:
    citation = parsed("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    for record in (citation, *citation["references"]):
        assert record["title"]
        for author in record["authors"]:
            assert "name" in author or {"family-names", "given-names"} <= author.keys()
    assert citation["message"]
    assert citation["license"] == "BSD-3-Clause"


def test_the_workflow_runs_on_three_systems_and_names_files_that_exist() -> None:
    jobs = parsed(".github/workflows/ci.yml")["jobs"]
    assert {"tests", "lint", "site", "benchmarks", "container", "wheel"} == set(jobs)
    for name in ("tests", "wheel"):
        systems = {system.split("-")[0] for system in jobs[name]["strategy"]["matrix"]["os"]}
        assert systems == {"ubuntu", "macos", "windows"}
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert any("-m tests.installed_wheel" in command for command in commands)
    named = {
        word
        for word in re.findall(r"[\w./-]+\.(?:py|txt|toml)\b", " ".join(commands))
        if not word.startswith(("dist/", "fresh/"))
    }
    assert named >= {"constraints.txt", "tests/test_speed.py"}
    for word in named:
        assert (ROOT / word).exists(), word
    for module in re.findall(r"-m (tests\.[\w.]+)", " ".join(commands)):
        assert (ROOT / f"{module.replace('.', '/')}.py").exists()


def test_the_local_check_has_the_steps_of_the_workflow() -> None:
    local = text(".ci/run")
    for step in ("ruff check", "ruff format --check", "mypy", "mor-bench check", "asv check"):
        assert step in local
        assert step in text(".github/workflows/ci.yml")
    assert "-m tests.installed_wheel" in local


def test_the_container_gets_all_that_the_wheel_is_built_from_and_no_root_user() -> None:
    lines = text("Containerfile").replace("\\\n", " ").splitlines()
    steps = [line.split(maxsplit=1) for line in lines if line and not line.startswith("#")]
    last = dict(steps)
    assert last["ENTRYPOINT"] == '["mor-bench"]'
    assert last["USER"] not in ("root", "0")
    kept = {line[1:] for line in text(".containerignore").splitlines() if line.startswith("!")}
    assert kept >= {*INSTALLED_AS, "pyproject.toml", "README.md", "LICENSE"}
    for word, rest in steps:
        names = [name for name in shlex.split(rest)[:-1] if word == "COPY" and name != "."]
        if names and not names[0].startswith("--from"):
            assert kept >= set(names)
    assert all((ROOT / name).exists() for name in kept)


def test_the_expected_files_of_the_wheel_are_those_that_users_need() -> None:
    found = expected_files(ROOT)
    for name in (
        "mor_bench/py.typed",
        "mor_bench/report/vendor/plotly-gl3d.min.js",
        "mor_bench/suite/datasets/beam-tiny.toml",
        "mor_bench/suite/methods/pod.toml",
    ):
        assert name in found
    assert any(name.startswith("mor_bench/suite/trained/") for name in found)
    assert not any("__pycache__" in name or name.startswith("tests/") for name in found)
