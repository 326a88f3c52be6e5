"""Agreement of errors that are estimated without the reference with measured errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from mor_bench.mechanics.indicator import ErrorIndicator

N_INDICATED = 64
"""Number of test samples whose errors are estimated, spread evenly over the test set."""

LEAST_INDICATED = 10
"""Fewest usable samples for a summary."""

EXACT = 1e-6
"""Relative error below which there is no summary, since the reference has such errors itself."""


class Indicated:
    """Collects the error estimates of a test set, whose predictions come in chunks.

    Parameters
    ----------
    indicator : ErrorIndicator or None
        None collects nothing.
    n_samples : int
        Size of the test set.
    """

    def __init__(self, indicator: ErrorIndicator | None, n_samples: int) -> None:
        self._indicator = indicator
        self._chosen = np.unique(np.linspace(0, n_samples - 1, N_INDICATED).astype(np.int64))
        self._rows: list[NDArray[np.float64]] = []

    def add(self, first: int, forces: NDArray[np.float64], predicted: NDArray[np.float64]) -> None:
        """Estimate the errors of a chunk's chosen samples.

        Parameters
        ----------
        first : int
            Number of the chunk's first sample.
        forces, predicted : (n, n_nodes, 3) float64
            Loads, N, and predictions, m.
        """
        if self._indicator is None:
            return
        chosen = self._chosen[(self._chosen >= first) & (self._chosen < first + len(forces))]
        found = self._indicator(forces[chosen - first], predicted[chosen - first])
        self._rows.append(
            np.stack([chosen, found.relative_correction, found.relative_residual], axis=1)
        )

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Return `indicated`, (n, 3): number of the sample, relative correction and residual."""
        return {"indicated": np.concatenate(self._rows)} if self._rows else {}


def indicator_summary(score: Mapping[str, Any]) -> dict[str, float] | None:
    """Compare estimated with measured errors; None if too few samples are usable."""
    rows, correction, residual = score.get("indicated", np.zeros((0, 3))).T
    measured = score["relative_l2"][rows.astype(int)]
    usable = (
        np.isfinite(measured) & (measured > 0) & np.isfinite(correction) & np.isfinite(residual)
    )
    measured, correction, residual = measured[usable], correction[usable], residual[usable]
    if len(measured) < LEAST_INDICATED or measured.max() < EXACT:
        return None
    ratio = correction / measured
    return {
        "n": len(measured),
        "rank_correlation": float(spearmanr(measured, correction)[0]),
        "residual_rank_correlation": float(spearmanr(measured, residual)[0]),
        **{
            f"ratio_{name}": float(np.quantile(ratio, share))
            for name, share in (("p5", 0.05), ("median", 0.5), ("p95", 0.95))
        },
    }
