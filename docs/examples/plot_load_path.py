"""
The path of a growing load
==========================

With `steps`, a dataset holds every equilibrium on the way to a load. Each line is a load on the tip
of a beam. The more it deflects, the further bending draws the tip back.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

data = mor_bench.load_dataset(
    {
        "title": "A slender beam",
        "source": "an example",
        "geometry": {"shape": "box", "size_m": [1.0, 0.1, 0.1], "cells": [20, 2, 2]},
        "material": {"law": "neo-hookean", "young_pa": 1e4, "poisson": 0.4},
        "supports": [{"region": "x-min"}],
        "loads": {
            "region": "x-max",
            "kind": "force",
            "patch_area_m2": 0.01,
            "n_patches": 1,
            "samples": 24,
            "magnitude_n": [0.05, 0.25],
            "steps": 8,
        },
        "split": {"by": "sample"},
    }
)
u = np.concatenate([part.displacements for part in (data.train, data.validation, data.test)])
tip = data.scene.mesh.points[:, 0] == 1.0
for path in u.reshape(-1, 8, *u.shape[1:]):
    moved = path[:, tip].mean(axis=1)
    aside = np.linalg.norm(moved[:, 1:], axis=1)
    plt.plot(np.append(0, aside), np.append(0, moved[:, 0]), "o-", ms=3, lw=1)
plt.xlabel("deflection of the tip across the beam (m)")
plt.ylabel("its displacement along the beam (m)")
plt.show()
