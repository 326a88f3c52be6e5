"""The training of networks: reproducible, resumable, stopped early, sized to seconds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, MorBenchError, OutOfTimeError, SpecError, StoreError
from mor_bench.training_options import TrainingOptions

if TYPE_CHECKING:
    from torch import Tensor

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import training, training_loop  # noqa: E402 - torch is there
from mor_bench.learning.checkpoint import fingerprint_of  # noqa: E402
from mor_bench.learning.training import Training, device_of, train  # noqa: E402
from mor_bench.learning.training_plan import (  # noqa: E402
    LearningProblem,
    TrainingPlan,
    rate_factor,
)

PLAN = TrainingPlan(120, 8, 1e-2, second_moment_decay=0.9, validation_fraction=0.2)
NOISY: dict[str, Any] = {"noise": 2.0, "width": 200}
EARLY = replace(PLAN, iterations=1000, schedule="constant", validation_fraction=0.5)
"""With `NOISY`, a training whose held-out samples soon gain nothing."""


@dataclass
class Regression:
    """A small regression whose loss draws random numbers from the training's generator."""

    noise: float = 0.0
    width: int = 16
    name: str = "x"
    by_columns: bool = False  # weights, as some are on a graphics processor

    def __post_init__(self) -> None:
        draw = torch.Generator().manual_seed(3)
        self.x = torch.randn(60, 4, generator=draw)
        self.y = torch.sin(self.x @ torch.randn(4, 2, generator=draw))
        self.y = self.y + self.noise * torch.randn(60, 2, generator=draw)
        self.network = torch.nn.Sequential(
            torch.nn.Linear(4, self.width), torch.nn.Tanh(), torch.nn.Linear(self.width, 2)
        )
        with torch.no_grad():
            for parameter in self.network.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=draw) / 2)
                if self.by_columns and parameter.dim() == 2:
                    parameter.data = parameter.data.T.contiguous().T
        self.generator = draw
        self.calls = 0

    def loss(self, rows: Tensor) -> Tensor:
        self.calls += 1
        x = self.x[rows]
        if self.network.training:
            x = x + 0.05 * torch.randn(x.shape, generator=self.generator)
        error: Tensor = self.network(x).float() - self.y[rows]
        return error.square().mean()

    def train(
        self,
        plan: TrainingPlan = PLAN,
        loss: Callable[[Tensor], Tensor] | None = None,
        time_limit_s: float | None = None,
        **options: Any,
    ) -> Training:
        problem = LearningProblem(
            self.network,
            loss or self.loss,
            len(self.x),
            self.generator,
            knobs={"name": self.name},
        )
        return train(problem, plan, TrainingOptions(**options), time_limit_s)

    def interrupted(self, after: int, checkpoint: Path) -> None:
        """Train with checkpoints, and "end" the process in the step after each of them."""
        steps = 0

        def dying(rows: Tensor) -> Tensor:
            nonlocal steps
            steps += self.network.training
            if steps > after:
                raise KilledError
            return self.loss(rows)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
            with pytest.raises(KilledError):
                self.train(loss=dying, checkpoint=checkpoint)

    @property
    def weights(self) -> np.ndarray:
        flat = torch.cat([p.detach().ravel() for p in self.network.parameters()])
        return np.asarray(flat)


class KilledError(Exception):
    """Stands for the end of the process."""


def assert_same(one: Regression, done: Training, other: Regression, expected: Training) -> None:
    np.testing.assert_array_equal(one.weights, other.weights)
    np.testing.assert_array_equal(done.loss_curve, expected.loss_curve)
    np.testing.assert_array_equal(done.validation_curve, expected.validation_curve)
    assert done.iterations == expected.iterations


@pytest.mark.parametrize("by_columns", [False, True])
@pytest.mark.parametrize("after", [1, 49, 50, 60])
def test_an_interrupted_training_ends_with_the_same_bits(
    after: int, by_columns: bool, tmp_path: Path
) -> None:
    whole, resumed = (Regression(by_columns=by_columns) for _ in range(2))
    expected = whole.train()
    Regression(by_columns=by_columns).interrupted(after, tmp_path / "checkpoint")
    done = resumed.train(checkpoint=tmp_path / "checkpoint")
    assert resumed.calls < whole.calls
    assert_same(resumed, done, whole, expected)


@pytest.mark.parametrize(
    ("problem", "plan", "seconds"),
    [
        ({}, PLAN, None),
        ({}, replace(PLAN, iterations=50, validation_fraction=0.0), None),
        ({}, replace(PLAN, iterations=7, batch_size=60), None),
        ({}, PLAN, 0.1),
        (NOISY, EARLY, None),
    ],
    ids=["validated", "not validated", "one batch an epoch", "sized to seconds", "stopped early"],
)
def test_a_finished_training_resumes_after_its_last_iteration(
    problem: dict[str, Any], plan: TrainingPlan, seconds: float | None, tmp_path: Path
) -> None:
    whole, resumed = Regression(**problem), Regression(**problem)
    options: dict[str, Any] = {"checkpoint": tmp_path / "checkpoint", "fit_seconds": seconds}
    expected = whole.train(plan, **options)
    done = resumed.train(plan, **options)
    assert resumed.calls == 0
    assert_same(resumed, done, whole, expected)
    assert not resumed.network.training


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A checkpoint after 31 of 120 iterations."""
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint"
    Regression().interrupted(31, path)
    return path.read_bytes()


@pytest.fixture
def checkpoint(written: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "checkpoint"
    path.write_bytes(written)
    return path


def test_a_checkpoint_of_another_training_is_refused_and_kept(checkpoint: Path) -> None:
    with pytest.raises(InvalidInputError, match="another training"):
        Regression(name="y").train(checkpoint=checkpoint)
    with pytest.raises(InvalidInputError, match=r"another training .*seconds"):
        Regression().train(checkpoint=checkpoint, fit_seconds=9.0)
    fewer = Regression()
    fewer.x, fewer.y = fewer.x[:30], fewer.y[:30]  # samples that the fingerprint does not cover
    with pytest.raises(StoreError, match=r"`rows` must be .* of shape"):
        fewer.train(checkpoint=checkpoint)
    assert checkpoint.exists()


PARTS = ["network.0.weight", "best.2.bias", "optimiser.0.exp_avg", "generator", "rows", "numbers"]


@pytest.mark.parametrize("name", PARTS)
def test_a_checkpoint_with_a_changed_bit_is_refused(checkpoint: Path, name: str) -> None:
    content = bytearray(checkpoint.read_bytes())
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    if name == "numbers":
        content[content.index(b"iterations") + len(b'iterations\\": ')] ^= 2
    else:
        content[8 + length + header[name]["data_offsets"][0] + 2] ^= 1
    checkpoint.write_bytes(content)
    with pytest.raises(StoreError, match="the checksum does not match"):
        Regression().train(checkpoint=checkpoint)


@pytest.mark.parametrize("damage", ["truncated", "empty", "foreign", "other network"])
def test_a_damaged_checkpoint_is_refused(checkpoint: Path, damage: str) -> None:
    content = checkpoint.read_bytes()
    changed = {"truncated": content[:-7], "empty": b"", "foreign": b"\x80\x04K\x01."}
    checkpoint.write_bytes(changed.get(damage, content))
    expected = InvalidInputError if damage == "other network" else StoreError
    with pytest.raises(expected, match="checkpoint"):
        Regression(width=5 if damage == "other network" else 16).train(checkpoint=checkpoint)


def _number(name: str, value: object) -> Callable[..., object]:
    return lambda numbers, tensors: numbers.update({name: value})


def _tensor(name: str, change: Callable[[Tensor], Tensor]) -> Callable[..., object]:
    return lambda numbers, tensors: tensors.update({name: change(tensors[name])})


def _without(start: str) -> Callable[..., object]:
    return lambda numbers, tensors: [
        tensors.pop(name) for name in list(tensors) if name.startswith(start)
    ]


UNLIKE = "do not match the training: "
SAMPLES = "samples do not match the training"
FORGERIES: dict[str, tuple[Callable[..., object], str]] = {
    "infinite iterations": (_number("iterations", float("inf")), "`iterations`: "),
    "a negative iteration": (_number("iteration", -50), "`iteration`: "),
    "an iteration after the last": (_number("iteration", 10**6), "`iteration` must be 120"),
    "iterations of another plan": (_number("iterations", 10**6), "`iterations` must be 120 "),
    "an earlier iteration": (_number("iteration", 30), "`n_summed` must be 30 at iteration 30 of"),
    "a nested curve": (_number("curve", [[0.5]]), "`curve.0`: "),
    "a curve of NaN": (_number("curve", [float("nan")]), "`curve.0`: "),
    "a long curve": (_number("curve", [0.5, 0.5]), "`curve` must be 0 at iteration 31 of 120; got"),
    "a dict of validations": (_number("validated", {}), "`validated`: "),
    "an unknown number": (_number("n", 3), "`n`: "),
    "three totals": (_tensor("total", lambda x: x.repeat(3)), r"`total` must be .* of shape \(\)"),
    "no second moment": (_without("optimiser.1.exp_avg_sq"), UNLIKE + "optimiser.1.exp_avg_sq"),
    "no optimiser": (_without("optimiser."), UNLIKE + "optimiser.0"),
    "a transposed moment": (
        _tensor("optimiser.0.exp_avg", lambda x: x.T.contiguous()),
        "`optimiser.0.exp_avg` must be",
    ),
    "a negative second moment": (
        _tensor("optimiser.0.exp_avg_sq", lambda x: x - 1.0),
        "`optimiser.0.exp_avg_sq` must not be negative",
    ),
    "a negative step": (_tensor("optimiser.0.step", lambda x: -x), r"must be in \[1, "),
    "an order of floats": (_tensor("order", lambda x: x.double()), "`order` must be finite"),
    "an order of pairs": (_tensor("order", lambda x: x[:, None]), "`order` must be"),
    "a short order": (_tensor("order", lambda x: x[1:]), "`order` must be"),
    "a repeating order": (_tensor("order", lambda x: x[:1].repeat(len(x))), SAMPLES),
    "repeating rows": (_tensor("rows", lambda x: x[:1].repeat(len(x))), SAMPLES),
    "short best weights": (_tensor("best.0.weight", lambda x: x[:, :2].contiguous()), "best.0.we"),
    "best weights of NaN": (_tensor("best.0.weight", lambda x: x * float("nan")), "finite"),
    "no best weights": (_without("best."), UNLIKE + "best.0"),
    "weights of doubles": (_tensor("network.0.weight", lambda x: x.double()), "network.0.weight"),
    "no generator": (_without("generator"), UNLIKE + "generator"),
    "a generator of zeros": (_tensor("generator", lambda x: x * 0), "Invalid mt19937 state"),
    "an unknown tensor": (
        lambda numbers, tensors: tensors.update(other=tensors["order"] + 1),
        UNLIKE + "other",
    ),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_checkpoint_with_a_valid_checksum_is_refused(name: str, checkpoint: Path) -> None:
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(str(checkpoint), framework="pt") as file:
        header = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    numbers, (change, message) = json.loads(header.pop("numbers")), FORGERIES[name]
    change(numbers, tensors)
    header = {"format": header["format"], "fingerprint": header["fingerprint"]}
    header |= {"numbers": json.dumps(numbers)}
    save_file(tensors, checkpoint, header | {"sha256": fingerprint_of(header, tensors)})
    with pytest.raises(StoreError, match=f"a damaged checkpoint: .*{message}"):
        Regression().train(checkpoint=checkpoint)
    assert checkpoint.exists()


def test_early_stopping_keeps_the_best_validated_weights() -> None:
    problem = Regression(**NOISY)
    done = problem.train(EARLY)
    best = int(done.validation_curve.argmin())
    stopped = len(done.validation_curve) * (EARLY.iterations // training_loop.VALIDATIONS)
    assert stopped < done.iterations == EARLY.iterations
    assert len(done.loss_curve) == -(-stopped // training_loop.LOSS_INTERVAL)
    assert len(done.validation_curve) == best + 1 + training_loop.PATIENCE
    held = torch.randperm(60, generator=Regression(**NOISY).generator)[:30]
    assert not problem.network.training
    with torch.no_grad():
        loss = float(problem.loss(held))
    assert loss == pytest.approx(done.validation_curve[best], rel=1e-5)


def test_given_validation_samples_decide_instead_of_training_samples() -> None:
    """The samples after the training samples are validated, and are never in a batch."""
    problem = Regression(**NOISY)
    seen: set[int] = set()

    def loss(rows: Tensor) -> Tensor:
        if problem.network.training:
            seen.update(rows.tolist())
        return problem.loss(rows)

    learning = LearningProblem(problem.network, loss, 40, problem.generator, n_validation=20)
    done = train(learning, EARLY, TrainingOptions())
    assert seen == set(range(40))
    with torch.no_grad():
        left = float(problem.loss(torch.arange(40, 60)))
    assert left == pytest.approx(done.validation_curve.min(), rel=1e-5)


def test_a_training_sized_to_seconds_is_repeated_by_its_number_of_iterations() -> None:
    filled, repeated = Regression(), Regression()
    plan = replace(PLAN, validation_fraction=0.0)
    Regression().train(replace(plan, iterations=1))  # torch imports its optimisers
    start = perf_counter()
    done = filled.train(plan, fit_seconds=0.2)
    assert 0.02 < perf_counter() - start < 5.0
    assert done.iterations > 10
    assert repeated.train(replace(plan, iterations=done.iterations)).iterations == done.iterations
    np.testing.assert_array_equal(repeated.weights, filled.weights)


@pytest.mark.parametrize("each_s", [4e-4, 4e-3], ids=["many iterations", "few iterations"])
def test_the_given_time_includes_the_trial_and_the_validations(
    each_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss advances a simulated clock in proportion to its samples."""
    problem, asked_s = Regression(), 0.0

    def slow(rows: Tensor) -> Tensor:
        nonlocal asked_s
        asked_s += each_s * len(rows)
        return problem.loss(rows)

    monkeypatch.setattr(training_loop, "perf_counter", lambda: asked_s)
    monkeypatch.setattr(training_loop, "PATIENCE", 10**9)
    problem.train(replace(PLAN, validation_fraction=0.5), loss=slow, fit_seconds=1.0)
    assert 0.8 < asked_s < 1.2


def test_the_one_cycle_rate_rises_for_a_tenth_and_falls_to_zero() -> None:
    rates = np.array([rate_factor("one-cycle", i, 1000) for i in range(1000)])
    assert rates.argmax() == pytest.approx(100, abs=2)
    assert rates.max() == pytest.approx(1.0, abs=0.01)
    assert 0 < rates.min() < 0.02
    assert rates[-1] < 1e-4
    assert {rate_factor("constant", i, 1000) for i in range(1000)} == {1.0}


def test_bfloat16_trains_nearly_as_well_as_float32() -> None:
    exact, rounded = Regression(), Regression()
    curve = exact.train(replace(PLAN, iterations=200)).loss_curve
    other = rounded.train(replace(PLAN, iterations=200, precision="bfloat16")).loss_curve
    assert not np.array_equal(exact.weights, rounded.weights)
    assert other[-1] == pytest.approx(curve[-1], rel=0.2)
    assert other[-1] < 0.6 * other[0]


def test_a_training_that_would_take_too_long_ends_at_once() -> None:
    with pytest.raises(OutOfTimeError, match="would take"):
        Regression().train(replace(PLAN, iterations=10**9), time_limit_s=1.0)


def test_divergence_is_an_error_and_writes_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    message = (
        r"diverged .* the loss is (nan|inf), with a learning rate of 1e\+38 and products in "
        "float32; a lower rate may"
    )
    for _ in range(2):  # the second resumes from the last finite state, and ends as the first
        with pytest.raises(MorBenchError, match=message):
            Regression().train(
                replace(PLAN, learning_rate=1e38), checkpoint=tmp_path / "checkpoint"
            )
    with pytest.raises(MorBenchError, match=r"in bfloat16; a lower rate or float32 may help"):
        Regression().train(replace(PLAN, learning_rate=1e38, precision="bfloat16"))


@pytest.mark.parametrize("name", ["autoencoder", "deeponet", "umesh"])
def test_a_seed_beyond_32_bits_is_refused(name: str) -> None:
    mor_bench.load_method(name, seed=2**32 - 1)
    with pytest.raises(SpecError, match="`seed` must be less than 4294967296; got 4294967296"):
        mor_bench.load_method(name, seed=2**32)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_is_refused_where_there_is_none() -> None:
    assert device_of(TrainingOptions(device="auto")).type == "cpu"
    with pytest.raises(InvalidInputError, match="no CUDA device"):
        device_of(TrainingOptions(device="cuda"))
