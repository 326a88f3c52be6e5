"""
A bent beam and its linear response
===================================

The linear response overestimates large deflections, because it lets the beam grow longer.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

scene = mor_bench.load_scene("beam-tiny")
tip = scene.mesh.points[:, 0].argmax()
force = np.zeros((scene.mesh.n_nodes, 3))
force[tip, 2] = -1.0

full = mor_bench.load_method("fem").fit(scene)
linear = mor_bench.load_method("linear-fem").fit(scene)
sizes = np.linspace(0.0, 2.0, 9)
for name, method in {"fem": full, "linear-fem": linear}.items():
    u = method.predict(sizes[:, None, None] * force)
    plt.plot(sizes, -u[:, tip, 2], "o-", label=name)
plt.xlabel("force at the tip (N)")
plt.ylabel("deflection of the tip (m)")
plt.legend(frameon=False)
plt.show()
