"""Digits of the laws at a point: equal stretches, wide ranges of det F, inverted points."""

from __future__ import annotations

from decimal import Decimal, localcontext
from math import log

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.scene.materials import (
    Corotational,
    HolzapfelGasserOgden,
    Material,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Yeoh,
)

from .laws_and_elements import at_points

Array = NDArray[np.float64]

OGDEN = Ogden((100.0, -20.0), (2.5, -2.0), 800.0)
YEOH = Yeoh(80.0, -20.0, 15.0, 800.0)

FIBRES = HolzapfelGasserOgden(80.0, 90.0, 1.2, 0.1, ((1.0, 2.0, 0.0), (0.0, -1.0, 3.0)), 800.0)

LAWS = [NeoHookean(500.0, 0.4), MooneyRivlin(60.0, 20.0, 800.0), OGDEN, YEOH, FIBRES]
EVERY = [*LAWS, Corotational(500.0, 0.4)]


def shear_moduli(law: Ogden, gaps: list[Decimal], stretch: Decimal) -> tuple[float, float]:
    """Return A_0101 and A_0110 of a diagonal F in 60 digits; Ogden 1984, section 6.1."""
    with localcontext() as context:
        context.prec = 60
        lams = [stretch, stretch + (gaps[0] or Decimal("1e-25")), stretch + gaps[1]]
        volume = lams[0] * lams[1] * lams[2]
        beta = [Decimal(0)] * 3
        for mu, alpha in zip(law.mu_pa, law.alpha, strict=True):
            powers = [((lam.ln() - volume.ln() / 3) * Decimal(alpha)).exp() for lam in lams]
            beta = [
                b + Decimal(mu) * (p - sum(powers, Decimal(0)) / 3)
                for b, p in zip(beta, powers, strict=True)
            ]
        pressure = Decimal(law.bulk_pa) * (volume - 1) * volume
        p0, p1 = (beta[0] + pressure) / lams[0], (beta[1] + pressure) / lams[1]
        run = lams[0] ** 2 - lams[1] ** 2
        return (
            float((p0 * lams[0] - p1 * lams[1]) / run),
            float((p0 * lams[1] - p1 * lams[0]) / run),
        )


@pytest.mark.parametrize("gap", [0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-6, 1e-4, 1e-2, 0.1, 0.5, 0.9])
def test_no_digits_of_ogdens_tangent_are_lost_where_stretches_are_almost_equal(gap: float) -> None:
    for h in (-0.2, 0.0, 0.3):
        for third in (0.0, 0.25):
            H = np.diag([h, h + gap, h + third])
            gaps = [Decimal(H[1, 1]) - Decimal(h), Decimal(H[2, 2]) - Decimal(h)]
            expected = shear_moduli(OGDEN, gaps, 1 + Decimal(h))
            _, A, _, _ = at_points(OGDEN, H[None])
            found = A[0, 0, 1, 0, 1], A[0, 0, 1, 1, 0]
            np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14 * np.abs(A).max())


@pytest.mark.parametrize("stretch", np.geomspace(0.02, 50.0, 9))
def test_energies_of_wide_dilatations_match_the_closed_forms(stretch: float) -> None:
    J = stretch**3
    neo = NeoHookean(500.0, 0.4)
    logs = log(J)
    expected = 1.5 * neo.lame_mu * (stretch**2 - 1) - neo.lame_mu * logs
    expected += 0.5 * neo.lame_lambda * logs**2
    gradient = ((stretch - 1.0) * np.eye(3))[None]
    assert at_points(neo, gradient)[2] == pytest.approx(expected, rel=1e-13)
    for law in LAWS[1:]:
        found = at_points(law, gradient)
        assert found[2] == pytest.approx(400.0 * (J - 1) ** 2, rel=1e-11)
        assert found[3] == pytest.approx(J)


@pytest.mark.parametrize("law", EVERY)
def test_stress_and_its_derivative_are_those_of_the_energy(law: Material) -> None:
    """Central differences of the fourth order at random deformations."""
    H = 0.1 * np.random.default_rng(1).normal(size=(5, 3, 3))
    P, A, _, _ = at_points(law, H)
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = 1e-3
        ways = [at_points(law, H + k * step)[0] for k in (-2, -1, 1, 2)]
        slope = (ways[0] - 8 * ways[1] + 8 * ways[2] - ways[3]) / 12e-3
        np.testing.assert_allclose(slope, A[:, :, :, i, j], atol=1e-8 * np.abs(A).max())
        for point in range(len(H)):
            energies = [at_points(law, (H[point] + k * step)[None])[2] for k in (-2, -1, 1, 2)]
            rise = (energies[0] - 8 * energies[1] + 8 * energies[2] - energies[3]) / 12e-3
            assert rise == pytest.approx(P[point, i, j], abs=1e-8 * np.abs(A).max())


@pytest.mark.parametrize("law", EVERY)
def test_an_inverted_point_has_infinite_energy_and_leaves_the_others_alone(law: Material) -> None:
    H = 0.1 * np.random.default_rng(1).normal(size=(4, 3, 3))
    alone, _, energy, _ = at_points(law, H[:3])
    H[3] = np.diag([-2.0, 0.1, 0.2])
    P, A, infinite, least = at_points(law, H)
    np.testing.assert_array_equal(P[:3], alone)
    assert np.isfinite(energy)
    assert infinite == np.inf
    assert least == pytest.approx(-1.32)
    assert not P[3].any()
    assert not A[3].any()
