"""
A ball presses a block
======================

A rigid ball moves down onto a neo-Hookean block and slides without friction. The force begins at
the touch and grows faster than the way, because the area of contact grows.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench
from mor_bench.snapshots.given import ObservedDisplacements

scene = mor_bench.load_scene(
    {
        "geometry": {"shape": "box", "size_m": [1.0, 1.0, 0.5], "cells": [6, 6, 3]},
        "material": {"law": "neo-hookean", "young_pa": 1000.0, "poisson": 0.4},
        "supports": [{"region": "z-min"}],
        "loads": {
            "kind": "contact",
            "region": "z-max",
            "instrument": {"sphere": {"radius_m": 0.4, "centre_m": [0.5, 0.5, 0.92]}},
            "direction": [0.0, 0.0, -1.0],
            "magnitude_m": [0.0, 0.15],
            "samples": 1,
        },
        "split": {"by": "sample"},
    }
)
ways = np.linspace(0.0, 0.15, 11)
motion = np.zeros((len(ways), scene.mesh.n_nodes, 3))
motion[:, :, 2] = -ways[:, None]
u = (
    mor_bench.load_method("fem")
    .fit(scene)
    .predict(ObservedDisplacements(motion, scene.observed_nodes))
)
reactions = mor_bench.reaction_forces(scene, u, np.zeros_like(u))
plt.plot(1e3 * ways, reactions[:, :, 2].sum(axis=1), "o-")
plt.axvline(20, color="grey", lw=0.5)
plt.xlabel("way of the ball (mm); it touches at the grey line")
plt.ylabel("force on the support (N)")
plt.show()
