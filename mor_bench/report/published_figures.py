"""Figures of the U-Mesh paper, as printed.

Source: Mendizabal, Márquez-Neila, Cotin: Simulation of hyperelastic materials in real-time using
deep learning, Medical Image Analysis 2020. The errors come from its tables of error measures (one
per scene) and its two comparisons with POD. Slopes, maxima and errors at a tip come from the text
and the captions. The paper's networks ran on a GeForce 1080 Ti, on a random split.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """A row of the paper's tables of error measures: c channels, k steps; lengths in m."""

    dataset: str
    channels: int
    steps: int
    mean_m: float
    std_m: float
    predict_ms: float
    train_min: float
    max_m: float | None = None
    slope: float | None = None


PUBLISHED = (
    Published("beam-coarse", 64, 2, 0.0028, 0.0008, 2.0, 24),
    Published("beam-coarse", 16, 4, 0.0012, 0.0009, 3.2, 40),
    Published("beam-coarse", 32, 4, 0.0009, 0.0008, 3.2, 40),
    Published("beam-coarse", 64, 3, 0.0007, 0.0007, 2.5, 80),
    Published("beam-coarse", 64, 4, 0.0007, 0.0007, 3.3, 95),
    Published("beam-coarse", 128, 3, 0.0007, 0.0006, 2.5, 35, slope=0.00352),
    Published("beam-coarse", 64, 5, 0.0006, 0.0005, 4.0, 426),
    Published("beam-coarse", 128, 4, 0.0006, 0.0005, 3.45, 320),
    Published("beam-coarse-3-forces", 64, 4, 0.0007, 0.0003, 3.5, 100),
    Published("beam-fine", 128, 3, 0.0019, 0.0018, 3.0, 210, max_m=0.0265, slope=0.0083),
    Published("l-shape", 128, 3, 0.00648, 0.00493, 3.2, 97, max_m=0.0327, slope=0.002046),
    Published("liver-hex", 128, 3, 2.89e-5, 3.41e-5, 3.0, 149, max_m=4.07e-4, slope=0.0021),
    Published("liver-tet", 128, 3, 5.33e-5, 6.03e-5, 3.0, 149, max_m=4.9e-4),
)


@dataclass(frozen=True)
class PaperScene:
    """A scene of the paper.

    Attributes
    ----------
    network : Published
        The network that the paper selected for it.
    amplitude_m : float
        Largest displacement in its test set, m.
    tip_at_max_e, tip_at_largest : float or None
        Relative l² norm at the tip, as a fraction: of the sample with the largest e, and of the
        sample with the largest deformation.
    """

    network: Published
    amplitude_m: float
    tip_at_max_e: float | None = None
    tip_at_largest: float | None = None


def _network(dataset: str, channels: int, steps: int) -> Published:
    wanted = dataset, channels, steps
    return next(row for row in PUBLISHED if (row.dataset, row.channels, row.steps) == wanted)


SCENES = {
    scene.network.dataset: scene
    for scene in (
        PaperScene(_network("beam-coarse", 128, 3), 0.724, tip_at_max_e=0.051),
        PaperScene(_network("beam-coarse-3-forces", 64, 4), 1.0035, tip_at_largest=0.015),
        PaperScene(_network("beam-fine", 128, 3), 1.011),
        PaperScene(_network("l-shape", 128, 3), 8.9016),
        PaperScene(_network("liver-hex", 128, 3), 0.0536),
        PaperScene(_network("liver-tet", 128, 3), 0.088),
    )
}
"""The paper's scenes, by the name of the dataset."""

SELECTED_ON_TEST = (
    "The paper compares its networks on the test data of the coarse beam and selects one; it "
    "mentions no other held-out data."
)

REMARKS = {
    "beam-coarse": (
        "The paper's training times do not grow with the network: 35 min for c = 128, k = 3, but "
        "80 min for c = 64, k = 3.",
    ),
    "beam-fine": (
        "The paper contradicts itself: ē is 0.0019 m in its table of errors and 0.006 m in its "
        'comparisons with POD; a FEM solve takes "more than 300 ms" in the text and 740 ms in '
        "the comparisons.",
        "At the tip it gives 1.6 % for one sample that moves by 0.4 m.",
    ),
    "liver-hex": (
        'The paper gives two maxima: 4.07e-4 m as "maximal error" (of e, it seems) and 0.0153 m '
        "as the largest nodal error, more than a quarter of the largest deformation.",
        "At the tip of a lobe it gives 2.4 to 8.5 % for four samples.",
    ),
    "liver-tet": ("At the tip of a lobe the paper gives 1.9 to 10 % for four samples.",),
}
"""Contradictions in the paper and figures of single samples, by the name of the dataset."""

SAME_ERROR = {"fem": (740.0, 0.0), "pod": (120.0, 0.006), "umesh": (3.0, 0.006)}
"""Published figures of `COMPARED`, by method: prediction time in ms, e in m; POD has 3 modes."""

SAME_TIME = {"fem": (740.0, 0.0), "hpod": (5.0, 0.084), "umesh": (3.0, 0.006)}
"""Published figures of `COMPARED`, by method: time in ms, e in m; the POD has one mode."""

COMPARED = "beam-fine"
"""Dataset of the paper's two comparisons."""

SAME_AMPLITUDE = "-paper"
"""End of the names of datasets that have a scene's larger loads."""


def scene_of(dataset: str) -> str:
    """Return the name of the scene: a dataset at the paper's amplitude is the same scene."""
    return dataset.removesuffix(SAME_AMPLITUDE)


def published_of(dataset: str) -> list[Published]:
    """Return the paper's networks on a dataset."""
    return [row for row in PUBLISHED if row.dataset == scene_of(dataset)]
