"""Trainings and queries on a graphics processor agree with those on a processor."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.snapshots.dataset import Dataset
from mor_bench.training_options import TrainingOptions

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import training, training_loop  # noqa: E402 - torch is there
from mor_bench.learning.inference import Inference  # noqa: E402
from mor_bench.surrogates.umesh.network import new_network  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

TINY = {"channels": 8, "steps": 1, "iterations": 60, "batch_size": 8, "learning_rate": 1e-3}
ROUNDING = 2e-2
"""Relative difference of answers; tensor cores round products to TF32."""


@pytest.fixture(scope="module", params=["beam-tiny", "beam-tet"])
def data(request: pytest.FixtureRequest, cache: Path) -> Dataset:
    return mor_bench.load_dataset(request.param, split="sample", limit=80, cache=cache, workers=1)


def fitted(data: Dataset, device: Any, name: str = "umesh", **options: Any) -> Any:
    parameters = TINY | options.pop("parameters", {})
    method = mor_bench.load_method(name, **parameters)
    method.training = TrainingOptions(device=device, **options)
    return method.fit(data.scene, data.train)


def difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


@pytest.mark.parametrize("name", ["umesh", "umesh-linear"])
def test_a_training_on_a_graphics_processor_gives_the_same_model(
    data: Dataset, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)  # Adam amplifies rounding
    own, other = (fitted(data, device, name) for device in ("cuda", "cpu"))
    forces = data.test.forces
    assert difference(own.predict(forces), other.predict(forces)) < ROUNDING
    assert own.loss_curve_[-1] == pytest.approx(other.loss_curve_[-1], rel=ROUNDING)


def test_recorded_steps_change_the_weights_as_others_do(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = fitted(data, "cuda")
    monkeypatch.setattr(training_loop, "N_UNRECORDED", 0)
    plain = fitted(data, "cuda")
    assert difference(recorded.predict(data.test.forces), plain.predict(data.test.forces)) < 1e-3
    assert np.allclose(recorded.loss_curve_, plain.loss_curve_, rtol=1e-3)


def test_a_training_repeats_to_the_last_digit(data: Dataset) -> None:
    one, other = fitted(data, "cuda"), fitted(data, "cuda")
    assert np.array_equal(one.predict(data.test.forces), other.predict(data.test.forces))


def test_trainings_side_by_side_record_and_validate(data: Dataset) -> None:
    chosen = {"validation_fraction": 0.2, "batch_size": 7}
    alone = fitted(data, "cuda", parameters=chosen)
    with ThreadPoolExecutor(6) as threads:
        running = [threads.submit(fitted, data, "cuda", parameters=chosen) for _ in range(12)]
        beside = [one.result() for one in running]
    assert not torch.backends.cudnn.benchmark
    wanted = alone.predict(data.test.forces)
    assert max(difference(one.predict(data.test.forces), wanted) for one in beside) < ROUNDING


def test_a_stopped_training_resumes(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fitted(data, "cuda")
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)

    class StopError(Exception):
        pass

    def stop(done: int, *_: object) -> None:
        if done >= TINY["iterations"] - 10:
            raise StopError

    with pytest.raises(StopError):
        fitted(data, "cuda", checkpoint=tmp_path / "state", progress=stop)
    resumed = fitted(data, "cuda", checkpoint=tmp_path / "state")
    assert difference(resumed.predict(data.test.forces), whole.predict(data.test.forces)) < 1e-3


def test_held_out_samples_and_bfloat16_and_a_given_time(data: Dataset) -> None:
    chosen = {"validation_fraction": 0.2, "precision": "bfloat16"}
    method = fitted(data, "cuda", parameters=chosen)
    assert min(method.validation_curve_) < method.validation_curve_[0]
    timed = fitted(data, "cuda", fit_seconds=2.0)
    assert timed.iterations_ > TINY["iterations"]


@pytest.mark.parametrize("name", ["transolver", "deeponet", "mesh-graph-net", "fno", "autoencoder"])
def test_other_networks_train_on_a_graphics_processor(data: Dataset, name: str) -> None:
    method = mor_bench.load_method(name, iterations=20)
    method.training = TrainingOptions(device="cuda")
    method.fit(data.scene, data.train)
    assert np.isfinite(method.predict(data.test.forces)).all()


def test_queries_on_a_graphics_processor_agree(data: Dataset) -> None:
    eager, cuda = (
        fitted(data, "cpu", parameters={"inference": backend}) for backend in ("eager", "cuda")
    )
    forces = data.test.forces
    one_by_one = np.concatenate([cuda.predict(forces[i : i + 1]) for i in range(len(forces))])
    assert difference(one_by_one, eager.predict(forces)) < ROUNDING
    assert difference(cuda.predict(forces), eager.predict(forces)) < ROUNDING


@torch.inference_mode()  # type: ignore[untyped-decorator]
def test_a_replayed_query_takes_new_inputs_and_shapes() -> None:
    net = new_network(8, 1, torch.Generator().manual_seed(0)).eval()
    function = Inference(net, "cuda")
    for shape in [(4, 4, 4), (4, 4, 4), (8, 4, 4)]:
        x = torch.randn(1, 3, *shape)
        assert difference(function(x).numpy(), net(x).numpy()) < ROUNDING
