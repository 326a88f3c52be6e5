"""The limit of displacements on refined meshes, and what is known without one."""

from __future__ import annotations

import numpy as np
import pytest

from mor_bench.measure.mesh_limit import known_error, limit_of


def test_extrapolation_finds_the_limit_of_a_series_of_known_order() -> None:
    exact, error = np.random.default_rng(2).normal(size=(2, 5, 3))
    for order in (1.0, 1.6, 2.0):
        found, seen, kind = limit_of(
            [exact + error * 2.0 ** (-order * level) for level in range(3)]
        )
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)
        assert seen == pytest.approx(order)
        assert kind == "extrapolated"
    for insane in (0.1, 5.0, -1.0):
        series = [exact + error * 2.0 ** (-insane * level) for level in range(3)]
        assert limit_of(series)[2] == "finest"
        np.testing.assert_array_equal(limit_of(series)[0], series[-1])
    assert limit_of([exact, exact + error])[1:] == (None, "finest")
    assert limit_of([exact, exact, exact])[1:] == (None, "finest")


@pytest.mark.parametrize(
    ("orders", "known"),
    [
        ([1.5, 1.2, 0.3], (1e-3, 0.1, False)),
        ([1.5, 0.2, 0.3], (1e-3, 0.1, True)),
        ([None, None, None], (1e-3, 0.1, True)),
        ([-1.5, -0.2, 1.3], (None, None, False)),
    ],
)
def test_an_error_without_a_limit_is_a_bound_or_unknown(
    orders: list[float | None], known: tuple[float | None, float | None, bool]
) -> None:
    loads = [
        {
            "order": order,
            "error_m": 1e-3,
            "limit": "extrapolated" if order is not None and order > 0.5 else "finest",
        }
        for order in orders
    ]
    assert known_error({"error_m": 1e-3, "relative_l2_median": 0.1, "loads": loads}) == known
