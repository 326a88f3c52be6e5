"""
Laws under uniaxial stress
==========================

A single element, pulled and pressed. Saint Venant-Kirchhoff softens under compression, and has a
limit point there.
"""

import matplotlib.pyplot as plt
import numpy as np

from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.scene.materials import Corotational, NeoHookean, SaintVenantKirchhoff
from mor_bench.scene.mesh import box_mesh

mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
dofs = np.arange(mesh.n_dofs).reshape(-1, 3)
stretches = np.linspace(0.35, 1.6, 40)
for law in (SaintVenantKirchhoff(1.0, 0.0), NeoHookean(1.0, 0.0), Corotational(1.0, 0.0)):
    body = Assembler(Discretisation(mesh.points, mesh.cells, law), dofs, mesh.n_dofs)
    stress = []
    for stretch in stretches:
        u = mesh.points * [stretch - 1.0, 0.0, 0.0]
        force = body.force(u.ravel()).force.reshape(-1, 3)
        stress.append(force[mesh.points[:, 0] == 1.0, 0].sum())
    plt.plot(stretches, stress, label=type(law).__name__)
plt.axhline(0, color="grey", lw=0.5)
plt.xlabel("stretch")
plt.ylabel("nominal stress over Young's modulus")
plt.legend(frameon=False)
plt.show()
