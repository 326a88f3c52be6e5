"""`pick`: the evidence that it uses, its command line, and the command that times again."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

import mor_bench
from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.selection_text import retime_command
from mor_bench.analysis.verdict import Requirements, speed_rank
from mor_bench.errors import InvalidInputError
from mor_bench.results.comparison import Comparison
from mor_bench.runs.pick import newest_run
from mor_bench.specs import load_dataset_spec
from tests.commands import invoke
from tests.small_runs import LIMIT, short_timing


def test_the_command_that_times_again_has_the_options_of_the_run(small_run: Comparison) -> None:
    chosen = mor_bench.pick("beam-tiny", error=10.0, comparison=small_run)
    doubt = chosen.rows[0].latency_ms
    assert doubt is not None
    unstable = chosen.rows[0].with_parts(latency_ms=doubt.model_copy(update={"stable": False}))
    words = shlex.split(retime_command(replace(chosen, rows=[unstable])))
    assert words[:3] == ["mor-bench", "run", "beam-tiny"]
    assert words[-3:] == ["--out", str(small_run.out), "--retime"]
    assert words[words.index("--limit") + 1] == str(LIMIT)
    assert words[words.index("--cache") + 1] == small_run.settings["folders"]["cache"]
    assert "--time-limit" not in words
    assert "--seeds" not in words
    known = words[1 : words.index("-m")] + words[words.index("--limit") :]
    assert invoke(*known, "-m", "linear-fem", "--dry-run").exit_code == 0


def test_a_real_comparison_gives_a_choice(small_run: Comparison) -> None:
    def pick(error: float, latency_ms: float) -> Any:
        return mor_bench.pick("beam-tiny", error=error, latency_ms=latency_ms, comparison=small_run)

    rough = pick(10.0, 1e4)
    meeting = small_run.rows[:3]
    assert sorted(rough.qualified, key=speed_rank) == sorted(meeting, key=speed_rank)
    assert rough.choice == min(meeting, key=speed_rank)
    assert {rough.choice.method, rough.runner_up.method} == {"linear-fem", "pod-swept"}
    assert rough.run == small_run.out
    assert rough.figures[rough.choice.label]["error"] > rough.choice.error.rel_l2_median
    impossible = pick(1e-7, 1e-4)
    assert impossible.choice is None
    assert impossible.relaxations == []
    equal = analyse(small_run)["verdicts"][0]
    assert equal == mor_bench.pick("beam-tiny", comparison=small_run).summary()
    assert impossible.nearest is not None
    with pytest.raises(InvalidInputError, match="unknown limit `memory`"):
        mor_bench.pick("beam-tiny", memory=1.0, comparison=small_run)


def test_the_evidence_is_the_newest_finished_run_of_the_same_dataset(
    small_run: Comparison, tmp_path: Path
) -> None:
    spec, runs = load_dataset_spec("beam-tiny"), tmp_path / "reports" / "runs"
    for name in ("first", "older", "unfinished"):
        copied = replace(small_run, out=runs / name)
        copied.write()
    for name, time in (("first", 10**9), ("older", 0)):
        (runs / name / "comparison.json").write_text("{}", encoding="utf-8")
        os.utime(runs / name / "comparison.json", (time, time))
    (runs / "damaged").mkdir()
    for name in ("results.json", "comparison.json"):
        (runs / "damaged" / name).write_text("{", encoding="utf-8")
    found = newest_run(spec, runs)
    assert found is not None
    assert found.out == runs / "first"
    content = spec.model_dump(mode="json")
    other_needs = {**content, "needs": {"error": 0.5, "latency_ms": 7.0}}
    assert newest_run(load_dataset_spec(other_needs), runs) is not None
    stiffer = {**content, "material": {**content["material"], "young_pa": 501.0}}
    assert newest_run(load_dataset_spec(stiffer), runs) is None
    assert newest_run(spec, tmp_path) is None
    with pytest.raises(InvalidInputError, match="has results for another version of beam-tiny"):
        mor_bench.pick(stiffer, comparison=small_run)
    with pytest.raises(
        InvalidInputError, match="has no results for beam-coarse; it has results for beam-tiny"
    ):
        mor_bench.pick("beam-coarse", comparison=small_run)


@pytest.mark.slow
def test_without_evidence_a_comparison_is_run(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mor_bench.runs.configurations.CORE_METHODS", ("linear-fem",))
    with short_timing():
        chosen = mor_bench.pick("beam-tiny", error=10.0, latency_ms=1e4, cache=cache)
    assert chosen.run is not None
    assert chosen.run.parent == Path("reports") / "runs"
    assert (chosen.run / "comparison.json").exists()
    assert chosen.choice is not None
    assert chosen.choice.method == "linear-fem"
    again = mor_bench.pick("beam-tiny", latency_ms=1e4)  # this run is then the evidence
    assert again.run == chosen.run
    assert again.requirements == Requirements(0.01, 1e4)


def test_the_command_prints_a_choice_and_its_exit_code(small_run: Comparison) -> None:
    def command(*options: str) -> Result:
        return invoke("pick", "beam-tiny", f"--run={small_run.out}", *options)

    limits = ["--error=10", "--latency=10000", "--offline=1000", "--memory=1e3", "--json"]
    done = command(*limits)
    assert done.exit_code == 0, done.stderr
    asked = {"error": 10.0, "latency_ms": 1e4, "memory_bytes": 1e12, "offline_s": 1e3}
    assert json.loads(done.stdout)["requirements"] == asked
    done = command("--error=10", "--latency=0.00001")
    assert done.exit_code == 1
    assert "Enough alone: latency" in done.stdout
    assert command("--error=0").exit_code == 2


def test_the_folder_of_a_run_is_evidence_and_names_its_dataset(
    small_run: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = invoke("pick", "beam-tiny", f"--run={small_run.out}", "--error=10", "--latency=1e4")
    done = invoke("pick", str(small_run.out), "--error=10", "--latency=1e4")
    assert (done.exit_code, done.stdout) == (0, named.stdout), done.output
    limits = mor_bench.pick(small_run.out).requirements
    assert limits == Requirements(0.01, 3.0)  # those that the run stores
    monkeypatch.chdir(tmp_path)
    runs = Path("reports") / "runs"
    replace(small_run, out=runs / "mine").write()
    shutil.copytree(small_run.out / "samples", runs / "mine" / "samples")
    assert mor_bench.pick("mine", error=10.0, latency_ms=1e4).run == runs / "mine"
    # A dataset goes before a folder of the same name.
    Path("beam-tiny").symlink_to(runs / "mine")
    assert mor_bench.pick("beam-tiny", comparison=small_run).run == small_run.out
    with pytest.raises(InvalidInputError, match="the folder of a run is the evidence itself"):
        mor_bench.pick("mine", comparison=small_run)
    several = {**small_run.datasets, "other": small_run.datasets["beam-tiny"]}
    replace(small_run, out=runs / "several", datasets=several).write()
    with pytest.raises(InvalidInputError, match="has results for beam-tiny, other; name one: `mor"):
        mor_bench.pick("several")
