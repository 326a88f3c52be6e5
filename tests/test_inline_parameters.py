"""Hyperparameters in brackets beside the name of a method."""

from __future__ import annotations

from pathlib import Path

import pytest

import mor_bench
from mor_bench.analysis.selection_text import retime_command
from mor_bench.analysis.verdict import Requirements, Verdict
from mor_bench.errors import SpecError
from mor_bench.specs import load_method_spec
from mor_bench.specs.inline_parameters import split_method
from tests.small_runs import method_file


@pytest.mark.parametrize(
    ("given", "values"),
    [
        ("pod", {}),
        ("pod[n_modes=10]", {"n_modes": [10]}),
        ("a[x=1,2, y=on , z=[1, 2],'p,q']", {"x": [1, 2], "y": ["on"], "z": [[1, 2], "p,q"]}),
        ("a[x={k = 1, l = 2},1e-4]", {"x": [{"k": 1, "l": 2}, 1e-4]}),
        ("runs[1]/own.toml", {}),
    ],
)
def test_values_are_written_as_in_toml(given: str, values: dict[str, object]) -> None:
    assert split_method(given)[1] == values


@pytest.mark.parametrize("given", ["pod[", "pod[]", "pod[3]", "pod[n=]", "pod[n=1,]", "pod[n=1] x"])
def test_other_texts_in_brackets_are_refused(given: str) -> None:
    with pytest.raises(SpecError, match="write parameters as NAME"):
        split_method(given)


def test_values_replace_those_of_the_file_and_of_every_profile() -> None:
    spec = load_method_spec("hpod[n_modes=7,9]")
    swept = [c["n_modes"] for c in spec.configurations("quick")]
    assert sorted(swept) == 4 * [7] + 4 * [9]
    assert {c["sampling"] for c in spec.configurations("quick")} == {"points", "cells"}
    assert {c["n_modes"] for c in spec.configurations("full")} == {7, 9}
    assert spec.name == "hpod"
    small = load_method_spec("umesh[channels=8]").configurations("quick")
    assert [(c["channels"], c["iterations"]) for c in small] == [(8, 4500)]


def test_values_beside_a_file_and_for_a_single_method(tmp_path: Path) -> None:
    path = method_file(tmp_path, "mine", "mor_bench.surrogates.pod:PODGalerkin", n_modes=5)
    assert load_method_spec(f"{path}[n_modes=3,4]").sweep == {"n_modes": [3, 4]}
    assert mor_bench.load_method("pod[n_modes=7]").parameters["n_modes"] == 7
    with pytest.raises(SpecError, match="did you mean 'n_modes'"):
        mor_bench.load_method("pod[n_mods=7]")
    with pytest.raises(SpecError, match="one value"):
        mor_bench.load_method("pod[n_modes=7,8]")


def test_the_command_that_repeats_timings_repeats_the_values() -> None:
    given = "pod[n_modes=7,9]"
    assert load_method_spec(given).asked == given
    verdict = Verdict("beam-tiny", Requirements(), [], settings={"methods": [given]}, run=Path("r"))
    assert "-m 'pod[n_modes=7,9]'" in retime_command(verdict)
