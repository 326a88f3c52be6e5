"""Simulate how often the intervals of errors cover the error of another training.

    python -m tests.verification.interval_coverage [--simulations 1000] [--out FILE]

The logarithm of an error is a sum of normal effects: of the seed, of the load region (shared by all
trainings), of both together, and of the sample. The truth is the median error of another training
over all regions, not only those of the test set. With one training, only the regions vary, and the
truth is that training's own error over all regions. It prints the share of intervals that contain
the truth, and exits with 1 if a share is below 93 %.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import (
    central_interval,
    cluster_numbers,
    resample_weights,
    weighted_medians,
    widening,
)
from mor_bench.analysis.seeds import error_draws, seed_interval
from tests.verification.trust_record import trust_record

GOAL = 0.93
"""Lowest accepted share; the nominal one is 95 %."""

SEEDS, REGIONS, SEED_SDS = (3, 5, 10), (13, 27, 40, 100), (0.05, 0.1, 0.2, 0.3)
"""Numbers of trainings and of load regions, and log standard deviations between trainings."""


@dataclass(frozen=True)
class Setting:
    """A simulated comparison.

    Attributes
    ----------
    seeds, regions : int
        Number of trainings, and of load regions in the test set.
    seed_sd : float
        Standard deviation of the logarithm between trainings.
    samples : int
        Number of test samples.
    region_sd, both_sd, sample_sd, own_sd : float
        The same of a region, of a training in a region, of a sample, and of a training on a sample.
    """

    seeds: int
    regions: int
    seed_sd: float
    samples: int = 400
    region_sd: float = 0.3
    both_sd: float = 0.1
    sample_sd: float = 0.3
    own_sd: float = 0.1

    def trainings(self, generator: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """Return errors (seeds, samples), and the region of each sample."""
        k, regions = self.seeds, np.arange(self.samples) % self.regions
        shared = self.region_sd * generator.normal(size=self.regions)[regions]
        shared += self.sample_sd * generator.normal(size=self.samples)
        own = self.both_sd * generator.normal(size=(k, self.regions))[:, regions]
        own += self.own_sd * generator.normal(size=(k, self.samples))
        own += self.seed_sd * generator.normal(size=(k, 1))
        return np.exp(shared + own), regions


def coverage(setting: Setting, n: int, resamples: int, generator: np.random.Generator) -> float:
    """Return the share of n simulated intervals that contain the error of another training."""
    inside = 0
    for _ in range(n):
        trainings, regions = setting.trainings(generator)
        clusters = cluster_numbers(regions[:, None], setting.samples)
        weights = resample_weights(clusters, resamples, generator)
        factor = widening(setting.regions)
        draws = error_draws(trainings, weights, factor, weighted_medians, generator)
        low, high = central_interval(draws)
        inside += low <= np.exp(setting.seed_sd * generator.normal()) <= high
    return inside / n


def coverage_of_seeds(k: int, sd: float, n: int, generator: np.random.Generator) -> float:
    """Return the share of intervals from k trainings that contain another on the same test set."""
    errors = np.exp(sd * generator.normal(size=(n, k + 1)))
    intervals = [seed_interval(some[:k]) for some in errors.tolist()]
    ends = zip(intervals, errors[:, k], strict=True)
    return float(np.mean([low <= another <= high for (low, high), another in ends]))


def main() -> None:
    """Print the shares, and exit with 1 if one misses the goal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--resamples", type=int, default=1000)
    parser.add_argument("--out", type=Path, help="JSON file for the shares")
    options = parser.parse_args()
    n, generator = options.simulations, np.random.default_rng(0)
    settings = [Setting(1, regions, 0.0, both_sd=0.0) for regions in REGIONS]
    settings += [Setting(k, r, sd) for k in SEEDS for r in REGIONS for sd in SEED_SDS]
    found = []
    for setting in settings:
        share = coverage(setting, n, options.resamples, generator)
        found.append({**asdict(setting), "coverage": share})
        print(
            f"{setting.seeds:2d} trainings (log sd {setting.seed_sd:g}), "
            f"{setting.regions:3d} regions: {100 * share:.1f} %",
            flush=True,
        )
    alone = {k: coverage_of_seeds(k, 0.2, 10 * n, generator) for k in SEEDS}
    print(f"trainings alone, on the same test set: {alone}")
    if options.out:
        content = {"simulations": n, "regions_and_seeds": found, "seeds": alone}
        options.out.write_text(json.dumps({**trust_record(), **content}, indent=1) + "\n")
    lowest = min([item["coverage"] for item in found] + list(alone.values()))
    print(f"lowest share {100 * lowest:.1f} % (goal {100 * GOAL:.0f} %)")
    if lowest < GOAL:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
