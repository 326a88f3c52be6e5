"""What a run says that it would do, and the digest of what a method's results depend on."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

import mor_bench
from mor_bench.cli.app import app
from mor_bench.runs.code_digest import code_digest, imported_sources
from mor_bench.runs.plan import plan
from mor_bench.specs import MethodSpec


def test_nothing_is_computed_and_what_is_there_is_said(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    before = plan(["beam-tiny"], ["linear-fem", "pod"], cache=cache, limit=60)
    assert not cache.exists()
    assert [step.done for step in before.steps] == [False] * 9
    assert before.steps[0].label == "60 of 60 samples"
    assert before.n_unknown == 0
    assert before.seconds > before.timing_s > 0
    mor_bench.run(["beam-tiny"], ["linear-fem"], cache=cache, limit=60, out=tmp_path / "out")
    after = plan(["beam-tiny"], ["linear-fem", "pod"], cache=cache, limit=60)
    assert [step.done for step in after.steps] == [True, True, *[False] * 7]
    assert after.seconds < before.seconds


def test_a_method_of_which_nothing_is_known_says_so(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Zero"\n')
    planned = plan(["beam-tiny"], [path], cache=tmp_path / "cache")
    assert planned.n_unknown == 1
    said = CliRunner().invoke(
        app, ["run", "beam-tiny", "-m", str(path), "--dry-run", "--cache", str(tmp_path / "cache")]
    )
    assert said.exit_code == 0, said.output
    assert "1 steps of which nothing is known" in said.output


@pytest.mark.parametrize("name", ["fem", "umesh"])
def test_a_digest_follows_what_a_method_imports(name: str) -> None:
    surrogate = {
        "fem": "mor_bench.surrogates.fem:FullFEM",
        "umesh": "mor_bench.surrogates.umesh.method:UMesh",
    }[name]
    modules = set(imported_sources(surrogate.partition(":")[0]))
    assert "mor_bench.surrogate" in modules
    assert ("mor_bench.surrogates.umesh.network" in modules) == (name == "umesh")
    assert not any(module.startswith(("mor_bench.run", "mor_bench.report")) for module in modules)
    assert code_digest(surrogate) == code_digest(surrogate)


def test_a_digest_follows_modules_beside_a_third_party_s(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "__init__.py").write_text("")
    (tmp_path / "theirs" / "method.py").write_text(
        "from . import part\nfrom mor_bench.surrogates.pod import PODGalerkin as Mine\n"
    )
    part = tmp_path / "theirs" / "part.py"
    part.write_text("x = 1")
    modules = set(imported_sources("theirs.method", tmp_path))
    assert {"theirs.method", "theirs.part", "mor_bench.surrogates.pod"} <= modules
    before = code_digest("theirs.method:Mine", tmp_path)
    part.write_text("x = 22")
    assert code_digest("theirs.method:Mine", tmp_path) != before


def test_every_shipped_method_says_how_long_a_fit_takes() -> None:
    from mor_bench.specs import list_suite, load_method_spec

    methods: list[MethodSpec] = [load_method_spec(path) for path in list_suite("methods").values()]
    assert all(method.fit_seconds(profile) for method in methods for profile in ("quick", "full"))
