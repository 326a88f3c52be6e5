"""Adapters are imported on first use, and the examples of docs/adapters.md work as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
import mor_bench.adapters
from mor_bench.errors import MissingDependencyError
from tests.commands import invoke
from tests.missing_packages import hide_package
from tests.small_runs import run_small

PAGE = (Path(__file__).parent.parent / "docs" / "adapters.md").read_text(encoding="utf-8")


def cells(title: str) -> str:
    """Return the Python of a section of the page."""
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    return "\n".join(re.findall(r"^```\{code-cell\} python\n(.*?)^```", section, re.M | re.S))


def test_importing_the_package_imports_neither_scikit_learn_nor_pytorch() -> None:
    code = (
        "import sys, mor_bench, mor_bench.adapters\n"
        "print(sorted({'sklearn', 'torch'} & sys.modules.keys()), dir(mor_bench.adapters))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"[] {mor_bench.adapters.__all__}"


@pytest.mark.parametrize(
    ("name", "home", "library", "install"),
    [
        ("SurrogateRegressor", "sklearn_regressor", "sklearn", "scikit-learn"),
        ("TorchSnapshots", "torch_snapshots", "torch", r"'mor-bench\[learn\]'"),
    ],
)
def test_without_its_library_an_adapter_says_what_to_install(
    name: str, home: str, library: str, install: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, f"mor_bench.adapters.{home}", raising=False)
    hide_package(library, monkeypatch)
    with pytest.raises(MissingDependencyError, match=f"{name} needs {library}: pip .* {install}"):
        getattr(mor_bench.adapters, name)


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Surrogates'"):
        _ = mor_bench.adapters.Surrogates


@pytest.fixture
def page(cache: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A namespace in which the page's datasets come from the cache of the tests."""
    real = mor_bench.load_dataset
    monkeypatch.setattr(
        mor_bench, "load_dataset", lambda *a, **k: real(*a, cache=cache, workers=1, **k)
    )
    return {}


def test_the_regressor_of_the_page_is_an_accurate_method(page: dict[str, Any]) -> None:
    exec(cells("A regressor of scikit-learn as a method"), page)
    assert page["summary"](page["errors"])["rel_l2_median"] < 0.05
    done = invoke("check", str(page["folder"] / "nearest.toml"))
    assert (done.exit_code, "2 quick and 2 full" in done.output) == (0, True), done.output


def test_the_grid_of_the_page_finds_the_best_method(page: dict[str, Any]) -> None:
    exec(cells("A regressor of scikit-learn as a method"), page)
    exec(cells("A method as an estimator of scikit-learn"), page)
    tried = page["search"].cv_results_
    pods = np.array(["n_modes" in choice for choice in tried["params"]])
    assert page["search"].best_score_ > 0.97
    assert page["search"].best_params_["method"] == "pca-ridge"
    assert np.argmax(tried["mean_test_score"][pods]) == 2  # the most modes


@pytest.mark.slow
def test_the_network_of_the_page_learns(page: dict[str, Any]) -> None:
    pytest.importorskip("torch")
    exec(cells("A regressor of scikit-learn as a method"), page)
    exec(cells("Samples as a data set of PyTorch"), page)
    assert page["summary"](page["errors"])["rel_l2_median"] < 0.3


@pytest.mark.slow
def test_the_regressor_of_the_page_takes_part_in_a_comparison(
    page: dict[str, Any], tmp_path: Path, cache: Path
) -> None:
    exec(cells("A regressor of scikit-learn as a method"), page)
    comparison = run_small(["linear-fem", page["folder"] / "nearest.toml"], tmp_path, cache)
    rows = {row.label: row for row in comparison.rows}
    for source in ("linear-response", "force"):
        row = rows[f"nearest [input={source}]"]
        assert row.status == "ok"
        assert row.latency_ms is not None
        assert row.told == ("input" if source == "force" else source)
    nearest, linear = rows["nearest [input=linear-response]"].error, rows["linear-fem"].error
    assert nearest is not None
    assert linear is not None
    assert nearest.rel_l2_median < linear.rel_l2_median
