"""The dry run, and the digest of the code that a method's results depend on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mor_bench.errors import MissingDependencyError
from mor_bench.options import RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.runs.code_digest import code_digest, imported_sources
from mor_bench.runs.configurations import configurations_of
from mor_bench.runs.durations import REFERENCE_DOFS, REFERENCE_TRAINING, Pace, fit_seconds
from mor_bench.runs.plan import plan
from mor_bench.runs.run_context import RunContext
from mor_bench.specs import MethodSpec, list_suite, load_method_spec
from tests.commands import invoke
from tests.small_runs import LIMIT, keep_fit_record, method_file


def test_a_dry_run_computes_nothing_and_names_every_step(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    planned = plan(["beam-tiny"], ["linear-fem", "pod"], cache=cache, limit=LIMIT)
    assert not cache.exists()
    assert [step.done for step in planned.steps] == [False] * 6
    assert planned.steps[0].label == "60 of 60 samples"
    assert planned.n_unknown == 0
    assert planned.seconds > planned.stage_seconds("timing") > 0 < planned.stage_seconds("scores")


def test_a_dry_run_takes_the_cache_into_account(small_run: Comparison, cache: Path) -> None:
    planned = plan(["beam-tiny"], ["linear-fem", "pod"], cache=cache, limit=LIMIT)
    assert [step.done for step in planned.steps] == [True, True, *[False] * 4]


def test_a_method_of_unknown_duration_is_reported(tmp_path: Path) -> None:
    path = method_file(tmp_path, "mine", "tests.third_party:Zero")
    cache = tmp_path / "cache"
    assert plan(["beam-tiny"], [path], cache=cache).n_unknown == 1
    shown = invoke("run", "beam-tiny", "-m", str(path), "--dry-run", "--cache", str(cache))
    assert shown.exit_code == 0, shown.output
    assert "1 steps of unknown duration" in shown.output


def test_a_method_whose_library_is_missing_takes_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_class = MethodSpec.load_class

    def load(method: MethodSpec) -> type[Any]:
        if method.name == "umesh":
            raise MissingDependencyError("it needs torch")
        return load_class(method)

    monkeypatch.setattr(MethodSpec, "load_class", load)
    monkeypatch.setattr(Pace, "measured", lambda networks: Pace(1.0, 1.0, 1.0))
    options: dict[str, Any] = {"cache": tmp_path / "cache", "limit": LIMIT}
    found = plan(["beam-tiny"], ["linear-fem", "umesh"], **options)
    (step,) = (step for step in found.steps if "umesh" in step.label)
    assert step.label.endswith("(left out: it needs torch)")
    assert step.seconds == 0.0
    alone = plan(["beam-tiny"], ["linear-fem"], **options)
    for stage in ("compilation_s", "scoring_s", "timing_s", "report_s"):
        assert found.as_dict()[stage] == alone.as_dict()[stage]


def test_only_earlier_fits_of_the_same_method_predict_its_time(tmp_path: Path) -> None:
    configuration = configurations_of([load_method_spec("pod")], "quick")[0]
    size = REFERENCE_DOFS, REFERENCE_TRAINING
    arguments = configuration, RunContext.of(RunOptions(cache=tmp_path)), size, Pace(1.0, 1.0, 1.0)
    stated = fit_seconds(*arguments)
    keep_fit_record(tmp_path, "pod-tensor", configuration.parameters, size, 1e6)
    assert fit_seconds(*arguments) == stated != 1e6
    for small in ((size[0] // 8, size[1]), (size[0], size[1] // 8)):
        keep_fit_record(tmp_path, "pod", configuration.parameters, small, 1e6)
        assert fit_seconds(*arguments) == stated  # a small fit mostly takes a fixed time
    keep_fit_record(tmp_path, "pod", configuration.parameters, size, 1e6)
    assert fit_seconds(*arguments) == 1e6


def test_other_seeds_and_trainings_of_given_length_are_planned(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    one, three = (
        plan(["beam-tiny"], ["umesh"], cache=cache, limit=LIMIT, fit_seconds=50.0, seeds=seeds)
        for seeds in (1, 3)
    )
    assert [step.label for step in one.steps[1:]] == ["umesh [channels=16, steps=2]"]
    assert one.steps[1].seconds == 50.0
    assert [step.label for step in three.steps[2:]] == ["umesh: other seeds"]
    assert three.steps[2].seconds == 100.0
    drawing = plan(
        ["beam-tiny"], ["pca-extra-trees", "pca-ridge"], cache=cache, limit=LIMIT, seeds=3
    )
    extras = [step.label for step in drawing.steps if "other seeds" in step.label]
    assert extras == ["pca-extra-trees: other seeds"]  # ridge regression draws no numbers


@pytest.mark.parametrize(
    ("surrogate", "has_network"),
    [
        ("mor_bench.surrogates.fem:FullFEM", False),
        ("mor_bench.surrogates.umesh.method:UMesh", True),
    ],
)
def test_a_digest_depends_on_the_imports_of_a_method(surrogate: str, has_network: bool) -> None:
    modules = imported_sources(surrogate.partition(":")[0]).keys()
    assert "mor_bench.surrogate" in modules
    assert ("mor_bench.surrogates.umesh.network" in modules) == has_network
    above = ("mor_bench.runs", "mor_bench.report", "mor_bench.cli")
    assert not [module for module in modules if module.startswith(above)]


def test_a_digest_depends_on_the_modules_of_a_third_party(tmp_path: Path) -> None:
    package = tmp_path / "theirs"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "method.py").write_text(
        "from . import part\nfrom mor_bench.surrogates.pod import PODGalerkin as Mine\n"
    )
    (package / "part.py").write_text("x = 1")
    modules = imported_sources("theirs.method", tmp_path).keys()
    assert {"theirs.method", "theirs.part", "mor_bench.surrogates.pod"} <= modules
    before = code_digest("theirs.method:Mine", tmp_path)
    (package / "part.py").write_text("x = 22")
    assert code_digest("theirs.method:Mine", tmp_path) != before


def test_every_shipped_method_states_the_duration_of_a_fit() -> None:
    methods = [load_method_spec(path) for path in list_suite("methods").values()]
    assert all(method.fit_seconds(profile) for method in methods for profile in ("quick", "full"))
