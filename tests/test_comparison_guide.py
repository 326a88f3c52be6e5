"""The example of docs/comparison.md is run as it stands there; jobs and a cluster give the same rows."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mor_bench

GUIDE = (Path(__file__).parent.parent / "docs" / "comparison.md").read_text(encoding="utf-8")


def test_the_example_of_a_method_of_one_s_own_competes(cache: Path, tmp_path: Path) -> None:
    (script,) = re.findall(r"```python\n# my_method.py\n(.*?)```", GUIDE, re.DOTALL)
    (text,) = re.findall(r"```toml\n# mean.toml\n(.*?)```", GUIDE, re.DOTALL)
    (tmp_path / "my_method.py").write_text(script, encoding="utf-8")
    (tmp_path / "mean.toml").write_text(text, encoding="utf-8")
    comparison = mor_bench.run(
        ["beam-tiny"], [tmp_path / "mean.toml"], out=tmp_path / "out", cache=cache
    )
    assert [(row["label"], row["status"]) for row in comparison.rows] == [
        ("mean [power=0.5]", "ok"),
        ("mean [power=1.0]", "ok"),
    ]
    assert comparison.rows[0]["model_bytes"] > 1000
    assert comparison.rows[0]["error"]["rel_l2_median"] > 0.3


def test_fits_at_once_give_the_same_errors(tmp_path: Path, cache: Path) -> None:
    import os

    methods = ["linear-fem", "pod"]
    one = mor_bench.run(["beam-tiny"], methods, out=tmp_path / "one", cache=cache)
    if (os.cpu_count() or 1) < 2:
        pytest.skip("needs two cores")
    two = mor_bench.run(
        ["beam-tiny"], methods, out=tmp_path / "two", cache=tmp_path / "cache", jobs=2
    )
    assert [row["label"] for row in two.rows] == [row["label"] for row in one.rows]
    for row, other in zip(one.rows, two.rows, strict=True):
        assert other["error"]["rel_l2_median"] == pytest.approx(
            row["error"]["rel_l2_median"], rel=1e-9
        )


def test_a_cluster_fits_and_this_machine_times(tmp_path: Path, cache: Path) -> None:
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--no-dashboard",
    ]
    worker = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        address,
        "--nthreads",
        "1",
        "--nworkers",
        "1",
        "--no-dashboard",
        "--no-nanny",
    ]
    running = [
        subprocess.Popen(dask, stderr=subprocess.DEVNULL),
        subprocess.Popen(worker, stderr=subprocess.DEVNULL),
    ]
    try:
        time.sleep(1)
        there = mor_bench.run(
            ["beam-tiny"],
            ["linear-fem", "pca-regression-force"],
            out=tmp_path / "there",
            cache=tmp_path / "cache",
            cluster=address,
        )
    finally:
        for process in running[::-1]:
            process.terminate()
            process.wait()
    here = mor_bench.run(
        ["beam-tiny"], ["linear-fem", "pca-regression-force"], out=tmp_path / "here", cache=cache
    )
    assert [row["status"] for row in there.rows] == ["ok", "ok"]
    for row, other in zip(here.rows, there.rows, strict=True):
        assert other["error"]["rel_l2_median"] == pytest.approx(
            row["error"]["rel_l2_median"], rel=1e-9
        )
        assert other["latency_ms"]["median"] > 0
