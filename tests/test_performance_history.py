"""The stored history of asv: its files, its commits, and the picture that is drawn from them."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks import asv_history
from tests.benchmarks.asv_history import (
    RESULTS,
    ROOT,
    chosen,
    farthest_first,
    import_digests,
    spread,
    without_paths,
)
from tests.benchmarks.publish import publish_history
from tests.history.bench_history import in_new_process, peak_bytes
from tests.verification.trust_record import git

sys.path.append(str(ROOT / "docs" / "_ext"))

LEAST_COMMITS = 100  # fewer: a copy without the history
MOST_BYTES = 3e6
FILES = sorted(path for path in RESULTS.glob("*/*.json") if path.name != "machine.json")


def page() -> Any:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    import performance_history  # type: ignore[import-not-found]

    return performance_history


def read_by_asv(folder: Path) -> dict[str, dict[tuple[str, tuple[str, ...]], float]]:
    """Read a folder with asv's own reader: the value of every series, by commit."""
    results = pytest.importorskip("asv.results")
    found: dict[str, dict[tuple[str, tuple[str, ...]], float]] = {}
    for result in results.iter_results(str(folder)):
        values = found.setdefault(result.commit_hash, {})
        for name in result.get_all_result_keys():
            params = result.get_result_params(name)
            numbers = result.get_result_value(name, params) or []
            choices = _product(params)
            for choice, value in zip(choices, numbers, strict=False):
                if value is not None and not math.isnan(value):
                    values[name.partition(".")[2], choice] = value
    return found


def _product(params: list[list[str]]) -> list[tuple[str, ...]]:
    choices: list[tuple[str, ...]] = [()]
    for values in params:
        choices = [(*choice, value.strip("'")) for choice in choices for value in values]
    return choices


def test_asv_reads_every_stored_file_and_the_page_shows_its_values() -> None:
    by_asv = read_by_asv(RESULTS)
    assert len(by_asv) == len(FILES) > 1
    by_page: dict[str, dict[tuple[str, tuple[str, ...]], float]] = {}
    for key, series in page().read_series(page().stored()).items():
        for commit, value in series.values.items():
            by_page.setdefault(commit, {})[key] = value
    assert by_page == {commit: values for commit, values in by_asv.items() if values}


def test_every_line_of_the_picture_has_the_stored_values() -> None:
    by_asv = read_by_asv(RESULTS)
    figure = page().picture()
    assert figure is not None
    drawn = 0
    panels = {panel.title: panel for panel in page().PANELS}
    for axes in figure.axes:
        panel = panels[axes.get_title(loc="left")]
        for line in axes.get_lines():
            label = str(line.get_label())
            name = (panel.benchmark, (label,) if not label.startswith("_") and label else ())
            stored = sorted(values[name] for values in by_asv.values() if name in values)
            shown = sorted(float(y) for y in line.get_ydata() if not math.isnan(y))
            assert shown == pytest.approx([panel.factor * value for value in stored])
            drawn += len(shown)
    assert drawn > len(FILES)


def test_the_results_name_commits_of_the_main_line() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    commits = git("rev-list", "--first-parent", "HEAD").split()
    if len(commits) < LEAST_COMMITS:
        pytest.skip("a copy without the history")
    for path in FILES:
        content = json.loads(path.read_text())
        assert content["commit_hash"] in commits, path.name
        assert path.name.startswith(content["commit_hash"][:8])
        date = int(git("show", "-s", "--format=%at", content["commit_hash"]))
        assert content["date"] // 1000 == date, path.name


def test_the_files_are_small_and_name_no_place_of_the_machine() -> None:
    paths = [*FILES, *RESULTS.rglob("machine.json"), RESULTS / "benchmarks.json"]
    assert sum(path.stat().st_size for path in paths) < MOST_BYTES
    for path in paths:
        assert not re.search(r"/(home|root|work|tmp|usr|Users)/|_work_", path.read_text()), path


def test_a_single_commit_is_not_shown(tmp_path: Path) -> None:
    folder = tmp_path / "machine"
    folder.mkdir()
    shutil.copy(FILES[-1], folder)
    assert page().read_series(page().stored(tmp_path))
    assert page().shown(tmp_path) == {}
    assert page().picture(tmp_path) is None
    content = json.loads(FILES[-1].read_text())
    other = {**content, "commit_hash": "0" * 40, "date": content["date"] + 1}
    (folder / "other.json").write_text(json.dumps(other))
    assert len(page().shown(tmp_path)) > 10
    assert page().picture(tmp_path) is not None


def test_commits_are_spread_evenly_and_a_part_of_a_run_covers_the_whole_history() -> None:
    commits = [str(i) for i in range(101)]
    few = spread(commits, 11)
    assert few == [str(10 * i) for i in range(11)]
    assert spread(commits, 1) == ["100"]
    assert spread(commits, 500) == commits
    assert list(farthest_first(few, set()))[:4] == ["100", "0", "50", "80"]
    rest = list(farthest_first(few, {"0", "50", "60"}))
    assert rest[:2] == ["100", "80"]
    assert sorted(rest) == sorted(set(few) - {"0", "50", "60"})


def test_the_newest_fifty_commits_are_chosen_and_twelve_before() -> None:
    commits = [str(i) for i in range(400)]
    assert chosen(commits)[12:] == commits[350:]
    older = [int(commit) for commit in chosen(commits)[:12]]
    assert older[0] == 0
    assert older[-1] == 349
    assert {b - a for a, b in itertools.pairwise(older)} <= {31, 32}
    assert chosen(commits[:30]) == commits[:30]


def test_a_module_is_compiled_again_if_one_that_it_imports_has_changed(tmp_path: Path) -> None:
    package = tmp_path / "mor_bench"
    package.mkdir()
    sources = {
        "laws": "A = 1",
        "kernels": "from mor_bench import laws",
        "model": "def f():\n    from mor_bench.kernels import B",
        "page": "if TYPE_CHECKING:\n    from mor_bench.laws import A",
    }
    for name, source in sources.items():
        (package / f"{name}.py").write_text(source)
    before = import_digests(tmp_path)
    asv_history.set_times(tmp_path)
    times = {name: (package / f"{name}.py").stat().st_mtime for name in sources}
    (package / "laws.py").write_text("A = 2")
    after = import_digests(tmp_path)
    changed = {path.stem for path in before if before[path] != after[path]}
    assert changed == {"laws", "kernels", "model"}
    asv_history.set_times(tmp_path)
    new = {name for name, at in times.items() if (package / f"{name}.py").stat().st_mtime != at}
    assert new == changed


def test_an_environment_is_named_by_its_python() -> None:
    content = {
        "env_name": "existing-py_home_a_bin_python",
        "python": "/home/a/bin/python",
        "params": {"python": "/home/a/bin/python", "machine": "m"},
    }
    text = json.dumps(without_paths(content))
    assert "home" not in text
    assert f"existing-py{sys.version_info[0]}.{sys.version_info[1]}" in text


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
def test_the_peak_memory_is_that_of_the_new_process() -> None:
    large = np.ones(50_000_000)
    code = "from tests.history.bench_history import peak_bytes; print(peak_bytes())"
    assert 1e6 < float(in_new_process("-c", code)) < 0.75 * large.nbytes
    assert peak_bytes() > large.nbytes


@pytest.mark.slow
def test_the_published_history_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("asv")
    if not page().has_history():
        pytest.skip("a copy without the history")
    publish_history(tmp_path / "html")
    text = (tmp_path / "html" / "index.html").read_text()
    loaded = re.findall(r'<(?:script|link|img)[^>]*?(?:src|href)="([^"]+)"', text)
    assert len(loaded) > 10
    assert not [name for name in loaded if name.startswith(("http", "//"))]
    assert "FullOrder.track_solve" in (tmp_path / "html" / "index.json").read_text()
