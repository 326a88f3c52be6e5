"""Settings that trainings side by side on a graphics processor share."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning.cuda_graphs import FastConvolutions  # noqa: E402 - torch is there


def test_a_training_that_ends_leaves_the_search_for_convolutions_to_those_beside_it() -> None:
    fast, before = FastConvolutions(), torch.backends.cudnn.benchmark
    with ExitStack() as beside:
        with fast:
            beside.enter_context(fast)
        assert torch.backends.cudnn.benchmark
    assert torch.backends.cudnn.benchmark == before
