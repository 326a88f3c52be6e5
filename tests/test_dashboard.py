"""Comparisons as results of asv, and the published dashboard in a browser without the internet."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from mor_bench.errors import InvalidInputError, MorBenchError, StoreError
from mor_bench.export.asv_results import describe, export_asv
from mor_bench.machine import describe_machine
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs import list_suite
from tests.benchmarks.bench_full_order import FullOrder
from tests.benchmarks.bench_surrogates import METHODS
from tests.benchmarks.publish import LOCAL, make_offline, publish
from tests.commands import invoke as command
from tests.synthetic import a_row

CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)
pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")

OWN = {
    "bench_full_order.FullOrder.time_solve": {
        "name": "bench_full_order.FullOrder.time_solve",
        "params": [],
        "param_names": [],
        "unit": "seconds",
    }
}
"""An entry that asv itself may have written to benchmarks.json."""


def row(method: str, seconds: float = 1e-3, **fields: Any) -> Row:
    times = {"median": 1e3, "low": 0.9e3, "high": 1.2e3}
    measured = {
        "n_train": 170,
        "error": {"rel_l2_median": 0.02, "mean_dof_m": 3e-4},
        "latency_ms": {**{k: seconds * ms for k, ms in times.items()}, "n_queries": 200},
        "offline_s": {"data": 1.0, "fit": 0.5},
        "memory_bytes": {"fit": 2e8, "predict": 1e8},
        "throughput": {"8": 4000.0, "64": None},
    }
    return a_row(method, **{**measured, **fields})


def comparison(*rows: Row, **machine: Any) -> Comparison:
    ran_on = {**describe_machine(), **machine}
    datasets: dict[str, dict[str, Any]] = {row.dataset: {} for row in rows}
    return Comparison(Path("run"), ran_on, list(rows), datasets, settings={"profile": "quick"})


def git(folder: Path, *arguments: str) -> str:
    named = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    return subprocess.run(
        ["git", *named, *arguments],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
        env=environment,
    ).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: a checkout of a project called mor-bench with two commits."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "pyproject.toml").write_text('[project]\nname = "mor-bench"\n')
    (folder / "asv.conf.json").write_text((Path(__file__).parents[1] / "asv.conf.json").read_text())
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    for day in (1, 2):
        date = f"2024-01-0{day}T12:00:00Z"
        git(folder, "commit", "--quiet", "--allow-empty", "--message", "day", "--date", date)
    monkeypatch.chdir(folder)
    return folder


def results(out: Path, commit: str) -> dict[str, dict[str, Any]]:
    """Return the results of a commit: for each quantity, asv's columns by name."""
    content = json.loads(next(out.glob(f"*/{commit[:8]}-*.json")).read_text())
    return {
        name.rpartition(".")[2]: dict(zip(content["result_columns"], values, strict=False))
        for name, values in content["results"].items()
    }


def test_exported_figures_keep_their_values_and_units(checkout: Path) -> None:
    out = checkout / "results"
    infinite = {"rel_l2_median": math.inf, "mean_dof_m": 1.0}
    failed, skipped = row("hpod", status="failed"), row("umesh", status="skipped")
    paths = export_asv(
        comparison(row("fem", 2e-3), row("pod", error=infinite), failed, skipped), out
    )
    head = git(checkout, "rev-parse", "HEAD")
    assert paths[::2] == [out / platform.node() / "machine.json", out / "benchmarks.json"]
    content = json.loads(paths[1].read_text())
    assert (content["version"], content["commit_hash"]) == (2, head)
    assert content["date"] == 1000 * int(git(checkout, "show", "-s", "--format=%at"))
    found = results(out, head)
    setting = "'quick, split by region, 170 + 40 samples, 1 thread'"
    assert found["latency"]["params"] == [["'fem'", "'pod'", "'hpod'"], [setting]]
    assert found["latency"]["result"] == [2e-3, 1e-3, None]
    assert found["relative_error"]["result"] == [0.02, None, None]
    assert found["mean_dof_error"]["result"] == [3e-4, 1.0, None]
    assert found["fit"]["result"][:2] == [0.5, 0.5]
    assert found["peak_memory_fit"]["result"][0] == 2e8
    assert found["query_in_batch_8"]["result"][0] == 1 / 4000
    assert "query_in_batch_64" not in found
    statistics = ("ci_99_a", "q_25", "q_75", "ci_99_b")
    ends = [found["latency"][f"stats_{name}"][0] / 2e-3 for name in statistics]
    assert 0.85 < ends[0] < 0.9 < ends[1] < 1 < ends[2] < 1.2 < ends[3] < 1.3
    named = json.loads(paths[2].read_text())
    assert (named["version"], named["comparison.beam-tiny.latency"]["unit"]) == (2, "seconds")
    assert named["comparison.beam-tiny.latency"]["params"] == found["latency"]["params"]


def test_exports_accumulate_and_keep_the_files_of_asv(checkout: Path) -> None:
    out = checkout / "results"
    benchmarks, machine_file = out / "benchmarks.json", out / platform.node() / "machine.json"
    machine_file.parent.mkdir(parents=True)
    benchmarks.write_text(json.dumps({**OWN, "version": 2}))
    machine = dict.fromkeys(("machine", "cpu", "os", "arch", "num_cpu", "ram"), "mine")
    machine_file.write_text(json.dumps({**machine, "version": 1}))
    first, second = git(checkout, "rev-parse", "HEAD~1"), git(checkout, "rev-parse", "HEAD")
    export_asv(comparison(row("fem"), row("pod")), out, commit="HEAD~1")
    again = comparison(row("fem", 5e-3), row("hpod"), row("fem", threads=2))
    export_asv(again, out, commit=first[:10])
    export_asv(comparison(row("umesh")), out)
    found = results(out, first)["latency"]
    assert found["params"][0] == ["'fem'", "'pod'", "'hpod'"]
    expected = [5e-3, 1e-3, 1e-3, math.nan, 1e-3, math.nan]
    assert found["result"] == pytest.approx(expected, nan_ok=True)
    assert results(out, second)["latency"]["result"] == [1e-3]
    assert json.loads(machine_file.read_text()) == {**machine, "version": 1}
    before = json.loads(benchmarks.read_text())
    labels = ["'fem'", "'pod'", "'hpod'", "'umesh'"]
    assert before["comparison.beam-tiny.latency"]["params"][0] == labels
    assert before.items() >= OWN.items()
    benchmarks.write_text(json.dumps({**OWN, "version": 2}))  # as asv does when it runs again
    describe(out)
    assert json.loads(benchmarks.read_text()) == before


def test_an_impossible_export_is_refused_and_nothing_is_written(checkout: Path) -> None:
    out = checkout / "results"
    fem, elsewhere = comparison(row("fem")), {"processor": "abacus", "cores": 3}
    for message, made, options in (
        (r"`commit` must name a commit of .*; got 'v9'", fem, {"commit": "v9"}),
        (r"machine \(abacus, 3 cores\); give its name", comparison(row("fem"), **elsewhere), {}),
        (r"`machine` must consist of .*; got '../x'", fem, {"machine": "../x"}),
        ("no configuration has finished", comparison(row("fem", status="failed")), {}),
    ):
        with pytest.raises(InvalidInputError, match=message):
            export_asv(made, out, **options)
    assert not out.exists()
    out.mkdir()
    (out / "benchmarks.json").write_text('{"version": 3}')
    with pytest.raises(StoreError, match=r"asv's benchmarks in version 3; .* reads version 2"):
        export_asv(comparison(row("fem"), **elsewhere), out, machine="abacus")
    assert [path.name for path in out.iterdir()] == ["benchmarks.json"]
    (checkout / "pyproject.toml").unlink()
    with pytest.raises(InvalidInputError, match="is not in a git checkout of mor-bench"):
        export_asv(fem, out)


HOSTILE = "<img src=x onerror=alert(1)>"

HOSTILE_RUNS: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "dataset": ({"dataset": "../../x"}, {}, "a dataset is called '../../x'"),
    "label": ({"label": HOSTILE}, {}, "is not fit for a page"),
    "split": ({"split": HOSTILE}, {}, "is not fit for a page"),
    "processor": ({}, {"processor": HOSTILE}, "is not fit for a page"),
    "system": ({}, {"system": HOSTILE}, "is not fit for a page"),
    "cores": ({}, {"cores": HOSTILE}, "is not fit for a page"),
    "python": ({}, {"python": "3.11/../../x"}, "`machine.python` must be a version"),
}
"""Changed fields of a row and of the machine of a run, and the words of the refusal."""


@pytest.mark.parametrize("part", [*HOSTILE_RUNS, "profile"])
def test_no_text_of_a_run_becomes_markup_of_the_dashboard(part: str, checkout: Path) -> None:
    fields, machine, words = HOSTILE_RUNS.get(part, ({}, {}, "is not fit for a page"))
    made = comparison(row("fem", **fields), **machine)
    if part == "profile":
        made.settings["profile"] = HOSTILE
    with pytest.raises(StoreError, match=words) as caught:
        export_asv(made, checkout / "results", machine="abacus")
    assert "results.json" in str(caught.value)
    assert not (checkout / "results").exists()


def stored_figures(content: dict[str, Any]) -> list[Any]:
    found: list[Any] = content["results"]["comparison.beam-tiny.latency"]
    return found


FORGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "benchmark": lambda stored: stored["results"].update({f"comparison.{HOSTILE}.latency": []}),
    "quantity": lambda stored: stored["results"].update(
        {"comparison.x.y": stored_figures(stored), "params.x.latency": stored_figures(stored)}
    ),
    "parameter": lambda stored: stored_figures(stored)[1][0].__setitem__(0, HOSTILE),
    "value": lambda stored: stored_figures(stored)[0].__setitem__(0, "1"),
    "missing value": lambda stored: stored_figures(stored)[0].pop(),
    "statistics": lambda stored: stored_figures(stored)[3].append(1.0),
    "columns": lambda stored: stored["result_columns"].reverse(),
    "date": lambda stored: stored.update(date="today"),
    "results": lambda stored: stored.update(results=3),
    "commit": lambda stored: stored.pop("commit_hash"),
}


@pytest.mark.parametrize("part", FORGED)
def test_forged_results_of_another_commit_never_reach_the_dashboard(
    part: str, checkout: Path
) -> None:
    out = checkout / "results"
    path = export_asv(comparison(row("fem"), row("pod")), out, commit="HEAD~1")[1]
    content = json.loads(path.read_text())
    FORGED[part](content)
    path.write_text(json.dumps(content))
    before = (out / "benchmarks.json").read_bytes()
    with pytest.raises(StoreError, match=path.name) as caught:
        export_asv(comparison(row("fem")), out)
    assert "\n" not in str(caught.value)
    assert (out / "benchmarks.json").read_bytes() == before


def test_a_forged_description_of_a_machine_is_refused(checkout: Path) -> None:
    path = checkout / "results" / "abacus" / "machine.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"version": 1, "machine": "abacus", "cpu": HOSTILE}))
    with pytest.raises(StoreError, match=r"machine\.json: the text .* is not fit for a page"):
        export_asv(comparison(row("fem")), checkout / "results", machine="abacus")


@pytest.mark.slow
def test_the_export_command_prints_the_files_it_writes(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison(row("fem")).write()
    export = ("export", "asv", str(checkout / "run"), "--out", "results")
    done = command(*export)
    assert done.exit_code == 0, done.stderr
    written = {path.relative_to(checkout) for path in checkout.glob("results/**/*.json")}
    assert {Path(line) for line in done.stdout.splitlines()} == written
    found = results(checkout / "results", git(checkout, "rev-parse", "HEAD"))
    assert found["relative_error"]["result"] == [0.02]
    monkeypatch.chdir(tmp_path)
    assert command(*export).exit_code == 2


def test_asv_follows_every_method_of_the_suite() -> None:
    assert METHODS.keys() == list_suite("methods").keys()


@pytest.mark.slow
@pytest.mark.parametrize("dataset", FullOrder.params)
def test_no_benchmark_of_the_full_order_model_raises(dataset: str) -> None:
    """asv silently skips a benchmark that raises."""
    benchmark = FullOrder()
    benchmark.setup(dataset)
    found = [name for name in vars(FullOrder) if name.startswith(("time_", "peakmem_"))]
    assert len(found) >= 6
    for name in found:
        getattr(benchmark, name)(dataset)
    assert 0 < benchmark.track_iterations(dataset) < 50
    assert 0 < benchmark.track_relative_error(dataset) < 1e-6
    benchmark.teardown(dataset)


@pytest.fixture
def dashboard(checkout: Path) -> Iterator[str]:
    """The address of a published dashboard with a comparison of two commits."""
    pytest.importorskip("asv")
    out = checkout / ".asv" / "results"
    pod = row("pod", 2e-3, label="pod [n_modes=10]")
    export_asv(comparison(row("fem", 1e-3), pod), out, commit="HEAD~1")
    export_asv(comparison(row("fem", 3e-3), pod), out)
    html = publish(checkout / "asv.conf.json")
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(html))
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def page(address: str, profile: Path) -> str:
    """Return the document of a page after its scripts have run in a headless browser."""
    quiet = "no-first-run disable-background-networking disable-component-update disable-sync"
    plain = f"headless no-sandbox disable-gpu disable-quic no-proxy-server dump-dom {quiet}"
    options = [
        *plain.split(),
        "host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        f"user-data-dir={profile}",
        "virtual-time-budget=10000",
        "window-size=1400,900",
    ]
    return subprocess.run(
        [str(CHROMIUM), *(f"--{option}" for option in options), address],
        check=True,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
    ).stdout


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium to open the dashboard with")
def test_the_dashboard_draws_without_the_internet(dashboard: str, tmp_path: Path) -> None:
    grid = page(dashboard, tmp_path / "grid")
    for quantity in ("latency", "relative_error", "peak_memory_fit", "query_in_batch_8"):
        link = f'<a class="btn benchmark-container" href="#comparison.beam-tiny.{quantity}">'
        assert re.search(rf'{link}.*?<canvas class="flot-base"', grid)
    graph = page(f"{dashboard}/#comparison.beam-tiny.latency", tmp_path / "graph")
    shown = graph[graph.index('id="main-graph"') :]
    assert '<canvas class="flot-overlay"' in shown
    assert shown.count("flot-tick-label") >= 4
    for label in ("fem", "pod [n_modes=10]"):
        assert label in shown
    for found in (grid, graph):
        assert "continental origin" not in found  # asv's page for failed scripts
        assert "Download error" not in found


@pytest.mark.slow
def test_the_dashboard_loads_nothing_from_elsewhere(
    dashboard: str, checkout: Path, tmp_path: Path
) -> None:
    folder = checkout / ".asv" / "html"
    written = (folder / "index.html").read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link|img)[^>]*?(?:src|href)="([^"]+)"', written)
    assert len(loaded) > len(LOCAL)
    assert all((folder / name).is_file() for name in loaded if not name.endswith(".xml"))
    address = "https://code.jquery.com/jquery-9.0.min.js"
    (tmp_path / "index.html").write_text(f'<script src="{address}"></script>', encoding="utf-8")
    with pytest.raises(MorBenchError, match=f"loads {address}, of which .* has no copy"):
        make_offline(tmp_path)
