"""
The force that a surgeon feels
==============================

A tool holds a part of a beam and moves it sideways. A haptic device needs the reaction force. The
linear model is right for small ways only.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench
from mor_bench.snapshots.given import ObservedDisplacements

scene = mor_bench.load_scene(
    {
        "geometry": {"shape": "box", "size_m": [0.3, 0.05, 0.05], "cells": [18, 3, 3]},
        "material": {"law": "neo-hookean", "young_pa": 5000.0, "poisson": 0.45},
        "supports": [{"region": "x-min"}],
        "loads": {
            "kind": "displacement",
            "region": "x-max",
            "magnitude_m": [0.0, 0.2],
            "samples": 1,
        },
        "split": {"by": "sample"},
    }
)
ways = np.linspace(0.0, 0.2, 11)
held = np.zeros((len(ways), scene.mesh.n_nodes, 3))
held[:, :, 2] = ways[:, None]
for name in ("fem", "linear-fem"):
    method = mor_bench.load_method(name).fit(scene)
    u = method.predict(ObservedDisplacements(held, scene.observed_nodes))
    forces = mor_bench.tool_forces(scene, u)
    plt.plot(1e3 * ways, forces[:, :, 2].sum(axis=1), "o-", label=name)
plt.xlabel("way of the tool (mm)")
plt.ylabel("lateral force of the tool (N)")
plt.legend(frameon=False)
plt.show()
