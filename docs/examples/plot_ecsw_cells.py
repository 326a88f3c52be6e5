"""
The cells that ECSW keeps
=========================

Hyper-reduction integrates over weighted cells only. Non-negative least squares chooses them, so
that the reduced forces of the snapshots are preserved. More modes need more cells.
"""

import matplotlib.pyplot as plt
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import mor_bench
from mor_bench.scene.mesh import FACES

data = mor_bench.load_dataset("beam-tiny")
mesh = data.scene.mesh
figure = plt.figure(figsize=(9, 3.6), layout="constrained")
for i, n_modes in enumerate((3, 10)):
    method = mor_bench.load_method(
        "hpod", n_modes=n_modes, sampling="cells", cubature_tolerance=0.02
    ).fit(data.scene, data.train)
    axes = figure.add_subplot(1, 2, i + 1, projection="3d")
    for cell in range(mesh.n_cells):
        kept = cell in method.cells_
        faces = mesh.points[mesh.cells[cell][FACES[8]]]
        colour = "tab:orange" if kept else "white"
        cube = Poly3DCollection(faces, facecolors=colour, edgecolors="grey")
        cube.set_alpha(0.9 if kept else 0.05)
        axes.add_collection3d(cube)
    axes.set(xlim=(0, 2), ylim=(0, 1), zlim=(0, 1))
    axes.set_title(f"{n_modes} modes: {len(method.cells_)} of {mesh.n_cells} cells")
    axes.set_box_aspect((2, 1, 1))
    axes.set_axis_off()
plt.show()
