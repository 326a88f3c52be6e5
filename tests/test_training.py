"""Training of networks: it repeats and resumes to the last bit, ends early, fills a time, and refuses what is not its own."""

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
from mor_bench.surrogate import TrainingOptions

if TYPE_CHECKING:
    from torch import Tensor

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import training  # noqa: E402 - after the check that torch is there
from mor_bench.learning.training import Training, TrainingPlan, device_of, fingerprint_of, train  # noqa: E402

PLAN = TrainingPlan(120, 8, 1e-2, second_moment_decay=0.9, validation_fraction=0.2)


@dataclass
class Problem:
    """A small regression whose loss also draws from the training's generator, as augmentation does."""

    noise: float = 0.0
    width: int = 16

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(3)
        self.x = torch.randn(60, 4, generator=self.generator)
        self.y = torch.sin(
            self.x @ torch.randn(4, 2, generator=self.generator)
        ) + self.noise * torch.randn(60, 2, generator=self.generator)
        self.network = torch.nn.Sequential(
            torch.nn.Linear(4, self.width), torch.nn.Tanh(), torch.nn.Linear(self.width, 2)
        )
        with torch.no_grad():
            for parameter in self.network.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=self.generator) / 2)
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
        **keywords: object,
    ) -> Training:
        return train(self.network, loss or self.loss, len(self.x), plan, self.generator, **keywords)  # type: ignore[arg-type]

    @property
    def weights(self) -> np.ndarray:
        return np.concatenate(
            [parameter.detach().numpy().ravel() for parameter in self.network.parameters()]
        )


class KilledError(Exception):
    """Stands for the end of the process."""


@pytest.mark.parametrize("after", [1, 49, 50, 60])
def test_a_training_that_was_stopped_ends_with_the_same_bits(
    after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, stopped, resumed = Problem(), Problem(), Problem()
    expected = whole.train()
    options = TrainingOptions(checkpoint=tmp_path / "checkpoint")
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)

    def dying(rows: Tensor) -> Tensor:
        if stopped.network.training:
            dying.steps += 1  # type: ignore[attr-defined]
        if dying.steps > after:  # type: ignore[attr-defined]
            raise KilledError
        return stopped.loss(rows)

    dying.steps = 0  # type: ignore[attr-defined]
    with pytest.raises(KilledError):
        stopped.train(loss=dying, options=options, fingerprint="x")
    done = resumed.train(options=options, fingerprint="x")
    assert resumed.calls < whole.calls
    np.testing.assert_array_equal(resumed.weights, whole.weights)
    np.testing.assert_array_equal(done.loss_curve, expected.loss_curve)
    np.testing.assert_array_equal(done.validation_curve, expected.validation_curve)


@pytest.mark.parametrize(
    ("problem", "changes", "seconds"),
    [
        ({}, {}, None),
        ({}, {"iterations": 50, "validation_fraction": 0.0}, None),
        ({}, {"iterations": 7, "batch_size": 60}, None),
        ({}, {}, 0.3),
        (
            {"noise": 2.0, "width": 200},
            {"iterations": 4000, "schedule": "constant", "validation_fraction": 0.5},
            None,
        ),
    ],
    ids=["with samples held out", "without", "one batch an epoch", "to seconds", "ended early"],
)
def test_a_finished_training_goes_on_after_its_last_iteration(
    problem: dict[str, Any], changes: dict[str, Any], seconds: float | None, tmp_path: Path
) -> None:
    whole, resumed, plan = Problem(**problem), Problem(**problem), replace(PLAN, **changes)
    options = TrainingOptions(checkpoint=tmp_path / "checkpoint", fit_seconds=seconds)
    expected = whole.train(plan, options=options)
    done = resumed.train(plan, options=options)
    assert resumed.calls == 0
    assert done.iterations == expected.iterations
    np.testing.assert_array_equal(resumed.weights, whole.weights)
    np.testing.assert_array_equal(done.loss_curve, expected.loss_curve)
    np.testing.assert_array_equal(done.validation_curve, expected.validation_curve)
    assert not resumed.network.training


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of a training of 120 iterations, in its middle."""
    path = tmp_path / "checkpoint"
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    problem = Problem()

    def dying(rows: Tensor) -> Tensor:
        if problem.calls > 60:
            raise KilledError
        return problem.loss(rows)

    with pytest.raises(KilledError):
        problem.train(loss=dying, options=TrainingOptions(checkpoint=path), fingerprint="x")
    return path


def test_a_checkpoint_of_another_training_is_refused_and_left(checkpoint: Path) -> None:
    with pytest.raises(InvalidInputError, match="another training"):
        Problem().train(options=TrainingOptions(checkpoint=checkpoint), fingerprint="y")
    assert checkpoint.exists()


@pytest.mark.parametrize(
    "name",
    [
        "network.0.weight",
        "best.2.bias",
        "optimiser.0.exp_avg",
        "generator",
        "rows",
        "order",
        "numbers",
    ],
)
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
        Problem().train(options=TrainingOptions(checkpoint=checkpoint), fingerprint="x")


def test_a_checkpoint_of_other_seconds_or_samples_is_refused(checkpoint: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"another training .*seconds"):
        Problem().train(
            options=TrainingOptions(checkpoint=checkpoint, fit_seconds=9.0), fingerprint="x"
        )
    samples = Problem()
    samples.x, samples.y = (
        samples.x[:30],
        samples.y[:30],
    )  # fewer, and the caller's fingerprint does not tell
    with pytest.raises(StoreError, match=r"`rows` must be .* of shape"):
        samples.train(options=TrainingOptions(checkpoint=checkpoint), fingerprint="x")


@pytest.mark.parametrize("damage", ["truncated", "empty", "foreign", "other network"])
def test_a_damaged_checkpoint_is_refused(checkpoint: Path, damage: str) -> None:
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(
        {
            "truncated": content[:-7],
            "empty": b"",
            "foreign": b"\x80\x04K\x01.",
            "other network": content,
        }[damage]
    )
    problem = Problem(width=5) if damage == "other network" else Problem()
    with pytest.raises(StoreError, match="checkpoint"):
        problem.train(options=TrainingOptions(checkpoint=checkpoint), fingerprint="x")


def _number(name: str, value: object) -> Callable[..., object]:
    return lambda numbers, tensors: numbers.update({name: value})


def _tensor(name: str, change: Callable[[Tensor], Tensor]) -> Callable[..., object]:
    return lambda numbers, tensors: tensors.update({name: change(tensors[name])})


def _without(start: str) -> Callable[..., object]:
    return lambda numbers, tensors: [
        tensors.pop(name) for name in list(tensors) if name.startswith(start)
    ]


FORGERIES: dict[str, tuple[Callable[..., object], str]] = {
    "endless": (_number("iterations", float("inf")), "`iterations`: "),
    "an infinite iteration": (_number("iteration", float("inf")), "`iteration`: "),
    "a negative iteration": (_number("iteration", -50), "`iteration`: "),
    "an iteration after the last": (_number("iteration", 10**6), "`iteration` must be 120"),
    "iterations of another plan": (
        _number("iterations", 10**6),
        "`iterations` must be 120 .* got 1000000",
    ),
    "an iteration before": (
        _number("iteration", 30),
        "`n_summed` must be 30 at iteration 30 of 120; got",
    ),
    "a nested curve": (_number("curve", [[0.5]]), "`curve.0`: "),
    "a curve of words": (_number("curve", ["a"]), "`curve.0`: "),
    "a curve of NaN": (_number("curve", [float("nan")]), "`curve.0`: "),
    "a long curve": (
        _number("curve", [0.5, 0.5]),
        "`curve` must be 0 at iteration 31 of 120; got 2",
    ),
    "validated words": (_number("validated", ["a"]), "`validated.0`: "),
    "a validated dict": (_number("validated", {}), "`validated`: "),
    "another number": (_number("n", 3), "`n`: "),
    "totals": (
        _tensor("total", lambda x: x.repeat(3)),
        r"`total` must be .* of shape \(\); got torch.float32 of shape \(3,\)",
    ),
    "no moment": (
        _without("optimiser.1.exp_avg_sq"),
        "not those of the training: optimiser.1.exp_avg_sq",
    ),
    "no moments": (_without("optimiser."), "not those of the training: optimiser.0"),
    "a moment of another shape": (
        _tensor("optimiser.0.exp_avg", lambda x: x.T.contiguous()),
        "`optimiser.0.exp_avg` must be",
    ),
    "a negative second moment": (
        _tensor("optimiser.0.exp_avg_sq", lambda x: x - 1.0),
        "`optimiser.0.exp_avg_sq` must not be negative",
    ),
    "a step of before": (
        _tensor("optimiser.0.step", lambda x: -x),
        r"`optimiser.0.step` must be in \[1, ",
    ),
    "an order of floats": (
        _tensor("order", lambda x: x.double()),
        "`order` must be finite numbers, torch.int64",
    ),
    "an order of pairs": (_tensor("order", lambda x: x[:, None]), "`order` must be"),
    "an order that repeats": (
        _tensor("order", lambda x: x[:1].repeat(len(x))),
        "samples are not those of the training",
    ),
    "a short order": (_tensor("order", lambda x: x[1:]), "`order` must be"),
    "rows that repeat": (
        _tensor("rows", lambda x: x[:1].repeat(len(x))),
        "samples are not those of the training",
    ),
    "other best weights": (
        _tensor("best.0.weight", lambda x: x[:, :2].contiguous()),
        "`best.0.weight` must be",
    ),
    "best weights of NaN": (
        _tensor("best.0.weight", lambda x: x * float("nan")),
        "`best.0.weight` must be finite",
    ),
    "a best weight missing": (
        _without("best.0.weight"),
        "not those of the training: best.0.weight",
    ),
    "no best weights": (_without("best."), "not those of the training: best.0"),
    "weights of doubles": (
        _tensor("network.0.weight", lambda x: x.double()),
        "`network.0.weight` must be",
    ),
    "no generator": (_without("generator"), "not those of the training: generator"),
    "a generator of zeros": (_tensor("generator", lambda x: x * 0), "Invalid mt19937 state"),
    "another tensor": (
        lambda numbers, tensors: tensors.update(other=tensors["order"] + 1),
        "not those of the training: other",
    ),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_checkpoint_is_refused_and_left(name: str, checkpoint: Path) -> None:
    """With the fingerprint of the training, and a checksum that matches."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(str(checkpoint), framework="pt") as file:
        header, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
    numbers, (change, message) = json.loads(header["numbers"]), FORGERIES[name]
    change(numbers, tensors)
    header = {
        "format": header["format"],
        "fingerprint": header["fingerprint"],
        "numbers": json.dumps(numbers),
    }
    save_file(tensors, checkpoint, header | {"sha256": fingerprint_of(header, tensors)})
    with pytest.raises(StoreError, match=f"a damaged checkpoint: .*{message}"):
        Problem().train(options=TrainingOptions(checkpoint=checkpoint), fingerprint="x")
    assert checkpoint.exists()


def test_it_ends_when_the_samples_held_out_gain_nothing_and_keeps_the_best_weights() -> None:
    problem = Problem(noise=2.0, width=200)
    done = problem.train(
        replace(PLAN, iterations=4000, schedule="constant", validation_fraction=0.5)
    )
    best = int(done.validation_curve.argmin())
    assert done.iterations == 4000
    stopped = len(done.validation_curve) * (4000 // training.VALIDATIONS)
    assert stopped < 4000
    assert len(done.loss_curve) == -(-stopped // training.LOSS_INTERVAL), (
        "the losses before an early end are kept"
    )
    assert len(done.validation_curve) == best + 1 + training.PATIENCE
    rows = torch.randperm(60, generator=Problem(noise=2.0, width=200).generator)[:30]
    assert not problem.network.training
    with torch.no_grad():
        loss = float(problem.loss(rows))
    assert loss == pytest.approx(done.validation_curve[best], rel=1e-5)


def test_a_training_that_fills_a_time_is_repeated_by_its_number_of_iterations() -> None:
    filled, repeated = Problem(), Problem()
    plan = replace(PLAN, validation_fraction=0.0)
    Problem().train(replace(plan, iterations=1))  # torch imports what its optimisers need
    start = perf_counter()
    done = filled.train(plan, options=TrainingOptions(fit_seconds=0.5))
    assert 0.1 < perf_counter() - start < 5.0
    assert done.iterations > 50
    assert repeated.train(replace(plan, iterations=done.iterations)).iterations == done.iterations
    np.testing.assert_array_equal(repeated.weights, filled.weights)


@pytest.mark.parametrize(("seconds", "each"), [(1.0, 2e-4), (1.0, 4e-3)])
def test_a_time_holds_the_trial_and_the_looks_at_the_samples_held_out(
    seconds: float, each: float
) -> None:
    problem = Problem()
    asked = 0.0

    def slow(rows: Tensor) -> Tensor:
        nonlocal asked
        asked += each * len(rows)
        return problem.loss(rows)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "perf_counter", lambda: asked)
        patch.setattr(training, "PATIENCE", 10**9)
        problem.train(
            replace(PLAN, validation_fraction=0.5),
            loss=slow,
            options=TrainingOptions(fit_seconds=seconds),
        )
    assert 0.8 * seconds < asked < 1.2 * seconds


def test_bfloat16_trains_nearly_as_well() -> None:
    exact, rounded = Problem(), Problem()
    plan = replace(PLAN, iterations=400)
    losses = [
        problem.train(replace(plan, precision=name)).loss_curve
        for problem, name in ((exact, "float32"), (rounded, "bfloat16"))
    ]  # type: ignore[arg-type]
    assert not np.array_equal(exact.weights, rounded.weights)
    assert losses[1][-1] == pytest.approx(losses[0][-1], rel=0.2)
    assert losses[1][-1] < 0.2 * losses[1][0]


def test_too_little_time_and_divergence_are_errors() -> None:
    with pytest.raises(OutOfTimeError, match="would take"):
        Problem().train(replace(PLAN, iterations=10**9), time_limit_s=1.0)
    with pytest.raises(
        MorBenchError,
        match=r"diverged .* the loss is (nan|inf), with a learning rate of 1e\+38 and products in float32; a lower rate may",
    ):
        Problem().train(replace(PLAN, learning_rate=1e38))
    with pytest.raises(
        MorBenchError, match=r"products in bfloat16; a lower rate or float32 may help"
    ):
        Problem().train(replace(PLAN, learning_rate=1e38, precision="bfloat16"))


def test_a_training_that_diverges_writes_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    options = TrainingOptions(checkpoint=tmp_path / "checkpoint")
    for _ in range(2):  # the second goes on from what was finite, and ends as the first
        with pytest.raises(MorBenchError, match="diverged"):
            Problem().train(replace(PLAN, learning_rate=1e38), options=options)


@pytest.mark.parametrize(
    "name", ["autoencoder", "deeponet", "fno", "mesh-graph-net", "pod-nn", "umesh"]
)
def test_a_seed_that_the_generator_would_cut_is_refused(name: str) -> None:
    for seed in (5, 2**32 - 1):
        mor_bench.load_method(name, seed=seed)
    with pytest.raises(SpecError, match="`seed` must be less than 4294967296; got 4294967296"):
        mor_bench.load_method(name, seed=2**32)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_devices() -> None:
    assert device_of(TrainingOptions(device="auto")).type == "cpu"
    with pytest.raises(InvalidInputError, match="no CUDA device"):
        device_of(TrainingOptions(device="cuda"))
