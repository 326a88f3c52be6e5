"""Fixtures that several tests share: the tiny dataset, generated once per test run."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from functools import cache as kept
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.export.archive import write_archive
from mor_bench.results.comparison import Comparison
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_generated_spec
from mor_bench.surrogate import Surrogate
from tests.archives import BY, SPEC
from tests.small_runs import PLAIN, Heard, method_file, run_small


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
def coarse(cache: Path) -> Dataset:
    """The first samples of beam-coarse."""
    return mor_bench.load_dataset("beam-coarse", limit=640, cache=cache)


@pytest.fixture(scope="session")
def fitted_by_name(tiny: Dataset) -> Callable[[str], Surrogate]:
    """Fit a method to beam-tiny with its cheap hyperparameters, once; no test may change it."""
    from tests.suite_methods import cheap_method  # it reads every method file

    @kept
    def fit(name: str) -> Surrogate:
        method = cheap_method(name)
        if reason := method.supports(tiny.scene):
            pytest.skip(reason)
        return method.fit(tiny.scene, tiny.train if method.needs_snapshots else None)

    return fit


@pytest.fixture(scope="session")
def tiny_without_validation(cache: Path) -> Dataset:
    """beam-tiny with all samples but those of the test for training."""
    spec = load_generated_spec("beam-tiny")
    split = spec.split.model_copy(update={"validation_fraction": 0.01})
    whole = spec.model_copy(update={"split": split})
    data = mor_bench.load_dataset(whole, cache=cache, workers=1)
    assert len(data.validation) == 0
    return data


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return mor_bench.load_scene("beam-tiny")


@pytest.fixture(scope="session")
def heard() -> Heard:
    """The events that a listener received from `small_run`."""
    return Heard()


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory, cache: Path, heard: Heard) -> Comparison:
    """A comparison of good and broken methods on 60 samples of beam-tiny."""
    folder = tmp_path_factory.mktemp("small")
    pod = method_file(
        folder, "pod-swept", "mor_bench.surrogates.pod:PODGalerkin", sweep={"n_modes": [3, 20]}
    )
    broken = [
        method_file(folder, f"broken-{how}", "tests.third_party:Broken", how=how)
        for how in ("crash", "shape", "sometimes")
    ]
    out = folder / "reports" / "runs" / "first"
    return run_small(["linear-fem", pod, *broken], out, cache, listener=heard.listener())


@pytest.fixture(scope="session")
def plain_run(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Comparison:
    """A comparison of two methods of the suite, fitted one after the other."""
    out = tmp_path_factory.mktemp("plain") / "out"
    return run_small(PLAIN, out, cache)


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run a test of a network on one and on two threads."""
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def sound_archive(cache: Path, tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of beam-tiny; tests must not change it."""
    out = tmp_path_factory.mktemp("archive") / "tiny"
    write_archive(SPEC, out, ["A. Author"], BY, cache=cache, workers=1)
    return out


@pytest.fixture
def archive_copy(sound_archive: Path, tmp_path: Path) -> Path:
    """A copy of that archive."""
    return Path(shutil.copytree(sound_archive, tmp_path / "archive"))
