"""Comparisons as results of asv, and the published dashboard in a browser that reaches nothing but this machine."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, MorBenchError, StoreError
from mor_bench.export.asv_results import describe, export_asv
from mor_bench.machine import describe_machine
from mor_bench.results.comparison import Comparison
from mor_bench.specs import list_suite
from tests.benchmarks.bench_full_order import FullOrder
from tests.benchmarks.bench_surrogates import METHODS
from tests.benchmarks.publish import LOCAL, make_offline, publish
from tests.commands import mor_bench_command as command

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
"""What asv itself may have written to benchmarks.json."""


def row(label: str, seconds: float = 1e-3, **changed: Any) -> dict[str, Any]:
    latency = {
        "median": 1e3 * seconds,
        "low": 0.9e3 * seconds,
        "high": 1.2e3 * seconds,
        "n_queries": 200,
    }
    return {
        "dataset": "beam-tiny",
        "split": "region",
        "method": label.split()[0],
        "label": label,
        "status": "ok",
        "n_train": 170,
        "n_test": 40,
        "threads": 1,
        "error": {"rel_l2_median": 0.02, "mean_dof_m": 3e-4},
        "latency_ms": latency,
        "offline_s": {"data": 1.0, "fit": 0.5},
        "memory_bytes": {"fit": 2e8, "predict": 1e8},
        "throughput": {"8": 4000.0, "64": None},
        **changed,
    }


def comparison(*rows: dict[str, Any], **machine: Any) -> Comparison:
    return Comparison(
        Path("run"), {**describe_machine(), **machine}, list(rows), settings={"profile": "quick"}
    )


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
    """A checkout of something called mor-bench with two commits, as working folder."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "pyproject.toml").write_text('[project]\nname = "mor-bench"\n')
    (folder / "asv.conf.json").write_text((Path(__file__).parents[1] / "asv.conf.json").read_text())
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    for day in (1, 2):
        git(
            folder,
            "commit",
            "--quiet",
            "--allow-empty",
            "--message",
            f"day {day}",
            "--date",
            f"2024-01-0{day}T12:00:00Z",
        )
    monkeypatch.chdir(folder)
    return folder


def results(out: Path, commit: str) -> dict[str, Any]:
    return json.loads(next(out.glob(f"*/{commit[:8]}-*.json")).read_text())["results"]  # type: ignore[no-any-return]


def test_figures_keep_their_values_and_units(checkout: Path) -> None:
    out = checkout / "results"
    rows = (
        row("fem", 2e-3),
        row("pod", error={"rel_l2_median": math.inf, "mean_dof_m": 1.0}),
        row("hpod", status="failed"),
        row("umesh", status="skipped"),
    )
    paths = export_asv(comparison(*rows), out)
    head = git(checkout, "rev-parse", "HEAD")
    assert paths == [
        out / platform.node() / "machine.json",
        next(out.glob("*/*-mor-bench-py*.json")),
        out / "benchmarks.json",
    ]
    content = json.loads(paths[1].read_text())
    assert (content["version"], content["commit_hash"]) == (2, head)
    assert content["date"] == 1000 * int(git(checkout, "show", "-s", "--format=%at"))
    found = {
        name.rpartition(".")[2]: dict(zip(content["result_columns"], values, strict=True))
        for name, values in content["results"].items()
    }
    assert found["latency"]["params"] == [
        ["'fem'", "'pod'", "'hpod'"],
        ["'quick, split by region, 170 + 40 samples, 1 thread'"],
    ]
    assert found["latency"]["result"] == [2e-3, 1e-3, None]
    assert found["relative_error"]["result"] == [0.02, None, None]
    assert found["mean_dof_error"]["result"] == [3e-4, 1.0, None]
    assert found["fit"]["result"][:2] == [0.5, 0.5]
    assert found["peak_memory_fit"]["result"][0] == 2e8
    assert found["query_in_batch_8"]["result"][0] == 1 / 4000
    assert "query_in_batch_64" not in found
    low, high = (found["latency"][f"stats_ci_99_{side}"] for side in "ab")
    assert 0.85 * 2e-3 < low[0] < 0.9 * 2e-3 < found["latency"]["stats_q_25"][0] < 2e-3
    assert 2e-3 < found["latency"]["stats_q_75"][0] < 1.2 * 2e-3 < high[0] < 1.3 * 2e-3
    named = json.loads(paths[2].read_text())
    assert (named["version"], named["comparison.beam-tiny.latency"]["unit"]) == (2, "seconds")
    assert named["comparison.beam-tiny.latency"]["params"] == found["latency"]["params"]


def test_exports_add_up_and_leave_asvs_own_alone(checkout: Path) -> None:
    out = checkout / "results"
    (out / platform.node()).mkdir(parents=True)
    (out / "benchmarks.json").write_text(json.dumps({**OWN, "version": 2}))
    machine = {
        "machine": platform.node(),
        "cpu": "mine",
        "os": "",
        "arch": "",
        "num_cpu": "2",
        "ram": "1",
        "version": 1,
    }
    (out / platform.node() / "machine.json").write_text(json.dumps(machine))
    first, second = git(checkout, "rev-parse", "HEAD~1"), git(checkout, "rev-parse", "HEAD")
    export_asv(comparison(row("fem"), row("pod")), out, commit="HEAD~1")
    export_asv(
        comparison(row("fem", 5e-3), row("hpod"), row("fem", threads=2)), out, commit=first[:10]
    )
    export_asv(comparison(row("umesh")), out)
    values, (labels, settings), *_ = results(out, first)["comparison.beam-tiny.latency"]
    assert (labels, len(settings)) == (["'fem'", "'pod'", "'hpod'"], 2)
    assert values[:3] == [5e-3, 1e-3, 1e-3]
    assert [value is not None and math.isnan(value) for value in values] == [
        False,
        False,
        False,
        True,
        False,
        True,
    ]
    assert results(out, second)["comparison.beam-tiny.latency"][0] == [1e-3]
    assert json.loads((out / platform.node() / "machine.json").read_text()) == machine
    before = json.loads((out / "benchmarks.json").read_text())
    assert before["comparison.beam-tiny.latency"]["params"][0] == [
        "'fem'",
        "'pod'",
        "'hpod'",
        "'umesh'",
    ]
    assert (
        before["bench_full_order.FullOrder.time_solve"]
        == OWN["bench_full_order.FullOrder.time_solve"]
    )
    (out / "benchmarks.json").write_text(
        json.dumps({**OWN, "version": 2})
    )  # as asv does when it runs again
    describe(out)
    assert json.loads((out / "benchmarks.json").read_text()) == before


def test_what_cannot_be_exported_is_named(checkout: Path) -> None:
    out = checkout / "results"
    with pytest.raises(InvalidInputError, match=r"`commit` must name a commit of .*; got 'v9'"):
        export_asv(comparison(row("fem")), out, commit="v9")
    with pytest.raises(
        InvalidInputError, match=r"another machine \(abacus, 3 cores\); give its name"
    ):
        export_asv(comparison(row("fem"), processor="abacus", cores=3), out)
    with pytest.raises(InvalidInputError, match=r"`machine` must consist of .*; got '../x'"):
        export_asv(comparison(row("fem")), out, machine="../x")
    with pytest.raises(InvalidInputError, match="no configuration has finished"):
        export_asv(comparison(row("fem", status="failed")), out)
    assert not out.exists()
    out.mkdir()
    (out / "benchmarks.json").write_text('{"version": 3}')
    with pytest.raises(
        StoreError, match=r"benchmarks.json: asv's benchmarks in version 3; .* knows version 2"
    ):
        export_asv(comparison(row("fem"), processor="abacus"), out, machine="abacus")
    assert [path.name for path in out.iterdir()] == ["benchmarks.json"]
    (checkout / "pyproject.toml").unlink()
    with pytest.raises(InvalidInputError, match="is in no git checkout of mor-bench"):
        export_asv(comparison(row("fem")), out)


def test_the_command_exports_a_run(checkout: Path, cache: Path, tmp_path: Path) -> None:
    mor_bench.run(datasets=["beam-tiny"], methods=["linear-fem"], out=tmp_path / "run", cache=cache)
    done = command("export", "asv", str(tmp_path / "run"), "--out", "results", cwd=checkout)
    assert done.returncode == 0, done.stderr
    assert {Path(line) for line in done.stdout.splitlines()} == {
        path.relative_to(checkout) for path in checkout.glob("results/**/*.json")
    }
    error = results(checkout / "results", git(checkout, "rev-parse", "HEAD"))[
        "comparison.beam-tiny.relative_error"
    ][0][0]
    assert 0.01 < error < 0.05  # linear elasticity on the loads of beam-tiny
    assert (
        command("export", "asv", str(tmp_path / "run"), "--out", "results", cwd=tmp_path).returncode
        == 2
    )


def test_asv_follows_every_method_of_the_suite() -> None:
    assert METHODS.keys() == list_suite("methods").keys()


@pytest.mark.parametrize("dataset", FullOrder.params)
def test_nothing_of_the_full_order_model_is_skipped(dataset: str) -> None:
    benchmark = FullOrder()
    benchmark.setup(dataset)  # an error in it, as on an old commit, is a skip to asv
    found = [name for name in vars(FullOrder) if name.startswith(("time_", "peakmem_"))]
    assert len(found) >= 6
    for name in found:
        getattr(benchmark, name)(dataset)
    assert 0 < benchmark.track_iterations(dataset) < 50
    assert 0 < benchmark.track_relative_error(dataset) < 1e-6
    benchmark.teardown(dataset)


@pytest.fixture
def dashboard(checkout: Path) -> Iterator[str]:
    """Address of a published dashboard with a comparison of two commits."""
    pytest.importorskip("asv")
    out = checkout / ".asv" / "results"
    export_asv(comparison(row("fem", 1e-3), row("pod [n_modes=10]", 2e-3)), out, commit="HEAD~1")
    export_asv(comparison(row("fem", 3e-3), row("pod [n_modes=10]", 2e-3)), out)
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
    """The document that a headless browser has made of a page when its scripts are done."""
    quiet = [
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    alone = [
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        "--no-proxy-server",
        f"--user-data-dir={profile}",
    ]
    command = [
        str(CHROMIUM),
        "--headless",
        "--no-sandbox",
        *quiet,
        *alone,
        "--virtual-time-budget=10000",
        "--window-size=1400,900",
        "--dump-dom",
    ]
    return subprocess.run(
        [*command, address],
        check=True,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
    ).stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium to open the dashboard with")
def test_the_dashboard_draws_without_the_internet(dashboard: str, tmp_path: Path) -> None:
    grid = page(dashboard, tmp_path / "grid")
    for quantity in ("latency", "relative_error", "peak_memory_fit", "query_in_batch_8"):
        assert re.search(
            rf'<a class="btn benchmark-container" href="#comparison.beam-tiny.{quantity}">.*?<canvas class="flot-base"',
            grid,
        )
    graph = page(f"{dashboard}/#comparison.beam-tiny.latency", tmp_path / "graph")
    shown = graph[graph.index('id="main-graph"') :]
    assert '<canvas class="flot-overlay"' in shown
    assert shown.count("flot-tick-label") >= 4
    for label in ("fem", "pod [n_modes=10]"):
        assert label in shown
    for found in (grid, graph):
        assert "continental origin" not in found  # asv's page for scripts that failed
        assert "Download error" not in found


def test_the_page_loads_nothing_from_elsewhere(
    dashboard: str, checkout: Path, tmp_path: Path
) -> None:
    folder = checkout / ".asv" / "html"
    written = (folder / "index.html").read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link|img)[^>]*?(?:src|href)="([^"]+)"', written)
    assert len(loaded) > len(LOCAL)
    assert all((folder / name).is_file() for name in loaded if not name.endswith(".xml"))
    newer = tmp_path / "newer"
    newer.mkdir()
    (newer / "index.html").write_text(
        '<script src="https://code.jquery.com/jquery-9.0.min.js"></script>', encoding="utf-8"
    )
    with pytest.raises(
        MorBenchError,
        match=r"loads https://code.jquery.com/jquery-9.0.min.js, of which .* has no copy",
    ):
        make_offline(newer)
