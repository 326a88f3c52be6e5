"""Fixtures that several tests share: the tiny dataset, generated once per test run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Small products are up to 100 times slower if their threads wait for each other."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder for datasets that the whole test run shares."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def tiny(cache: Path) -> Dataset:
    """beam-tiny with its default split."""
    return mor_bench.load_dataset("beam-tiny", cache=cache, workers=1)


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return mor_bench.load_scene("beam-tiny")
