"""
A heavy block on springs
========================

A block rests on a bed of springs under its own weight. On a stiff bed, the compression of the block
itself adds to the sinking of its top. Displacements of a query are measured from this rest state.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench
from mor_bench.mechanics.model import rest_displacement

density, gravity, height = 1000.0, 9.81, 0.1
stiffnesses = np.geomspace(2e4, 1e6, 8)


def rest(stiffness):
    scene = mor_bench.load_scene(
        {
            "geometry": {"shape": "box", "size_m": [0.4, 0.4, height], "cells": [6, 6, 2]},
            "material": {"law": "neo-hookean", "young_pa": 1e5, "poisson": 0.4},
            "springs": [{"region": "z-min", "stiffness_n_m3": float(stiffness)}],
            "gravity": {"density_kg_m3": density},
        }
    )
    u = rest_displacement(scene)[:, 2]
    bottom, top = scene.mesh.points[:, 2] == 0, scene.mesh.points[:, 2] == height
    return -u[bottom].mean(), -u[top].mean()


sinking = np.array([rest(stiffness) for stiffness in stiffnesses])
plt.loglog(stiffnesses, 1e3 * sinking[:, 0], "o", label="bottom")
plt.loglog(stiffnesses, 1e3 * sinking[:, 1], "s", label="top")
pressure = density * gravity * height
plt.loglog(stiffnesses, 1e3 * pressure / stiffnesses, color="grey", label="weight over stiffness")
plt.xlabel("stiffness of the bed (N/m³)")
plt.ylabel("mean sinking (mm)")
plt.legend(frameon=False)
plt.show()
