"""
A mesh of your own
==================

Any mesh that meshio reads becomes a scene. Here, an arch of hexahedra is written to a file, held at
its feet, and pushed sideways at its crown.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import meshio
import numpy as np

import mor_bench

# Bend a regular grid into half a ring.
i, j, k = np.meshgrid(range(25), range(3), range(3), indexing="ij")
angle, radius = np.pi * (1 - i / 24), 0.08 + 0.02 * k / 2
points = np.stack([radius * np.cos(angle), 0.02 * j / 2, radius * np.sin(angle)], axis=-1)
number = np.arange(i.size).reshape(i.shape)
corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
cells = np.stack([number[a : a + 24, b : b + 2, c : c + 2].ravel() for a, b, c in corners], axis=1)
path = Path(tempfile.mkdtemp()) / "arch.vtu"
meshio.write(path, meshio.Mesh(points.reshape(-1, 3), {"hexahedron": cells}))

scene = mor_bench.load_scene(
    {
        "geometry": {"shape": "file", "file": str(path)},
        "material": {"law": "neo-hookean", "young_pa": 5000.0, "poisson": 0.4},
        "supports": [{"region": "z-min"}],
    }
)
x, z = scene.mesh.points[:, 0], scene.mesh.points[:, 2]
crown = np.flatnonzero((np.abs(x) < 1e-9) & (z > 0.099))
force = np.zeros((scene.mesh.n_nodes, 3))
force[crown, 0] = 0.03 / len(crown)
u = mor_bench.load_method("fem").fit(scene).predict(force)
plt.plot(x, z, ".", color="lightgrey", label="at rest")
plt.plot(x + u[:, 0], z + u[:, 2], ".", label="pushed at the crown")
plt.gca().set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
plt.legend(frameon=False, loc="lower center")
plt.show()
