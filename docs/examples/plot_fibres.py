"""
Fibres of an artery wall
========================

A cube of the law of Holzapfel, Gasser and Ogden with two families of fibres. They stiffen it along
their mean direction, and carry no compression. A press out of their plane stretches them, too.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

angle = np.deg2rad(30.0)
fibres = [[np.cos(angle), sign * np.sin(angle), 0.0] for sign in (1, -1)]
loads = np.linspace(-2e3, 8e3, 21)


def stretches(axis):
    """Pull a face of a cube; the opposite face and two others lie on planes of symmetry."""
    scene = mor_bench.load_scene(
        {
            "geometry": {"shape": "box", "size_m": [1.0, 1.0, 1.0], "cells": [1, 1, 1]},
            "material": {
                "law": "holzapfel-gasser-ogden",
                "c10_pa": 3e3,
                "k1_pa": 2e4,
                "k2": 2.0,
                "fibres": fibres,
                "bulk_pa": 1e6,
            },
            "supports": [{"region": f"{name}-min", "components": [name]} for name in "xyz"],
            "discretisation": {"integration": "selective"},
        }
    )
    end = np.flatnonzero(scene.mesh.points[:, axis] == 1.0)
    forces = np.zeros((len(loads), scene.mesh.n_nodes, 3))
    forces[:, end, axis] = loads[:, None] / len(end)
    u = mor_bench.load_method("fem").fit(scene).predict(forces)
    return 1 + u[:, end, axis].mean(axis=1)


names = ("along the fibres' mean direction", "across it", "out of their plane")
for axis, name in enumerate(names):
    plt.plot(stretches(axis), 1e-3 * loads, label=name)
plt.xlabel("stretch")
plt.ylabel("nominal stress (kPa)")
plt.legend(frameon=False)
plt.show()
