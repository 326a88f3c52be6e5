"""
Stress in the hot elements
==========================

A reduced model that is right in the displacements can be less right in the stresses. Each dot is
the centre of a cell under the test load that bends the beam most.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench
from mor_bench.mechanics.elements import H8, shape_gradients

data = mor_bench.load_dataset("beam-tiny")
mesh, law = data.scene.mesh, data.scene.generated.material
lame = law.young_pa * law.poisson / ((1 + law.poisson) * (1 - 2 * law.poisson))
shear = law.young_pa / (2 * (1 + law.poisson))
gradients, _ = shape_gradients(mesh.points, mesh.cells, H8.centre[None])


def von_mises(u):
    """Cauchy stress of Saint Venant-Kirchhoff at the centres of the cells."""
    f = np.eye(3) + np.einsum("cai,caj->cij", u[mesh.cells], gradients[:, 0])
    e = 0.5 * (np.swapaxes(f, 1, 2) @ f - np.eye(3))
    s = lame * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * shear * e
    cauchy = f @ s @ np.swapaxes(f, 1, 2) / np.linalg.det(f)[:, None, None]
    deviator = cauchy - np.trace(cauchy, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * np.sum(deviator**2, axis=(1, 2)))


strongest = np.linalg.norm(data.test.displacements, axis=(1, 2)).argmax()
exact = von_mises(data.test.displacements[strongest])
for n_modes in (5, 20):
    method = mor_bench.load_method("pod", n_modes=n_modes).fit(data.scene, data.train)
    u = method.predict(data.test.forces[strongest])
    off = np.linalg.norm(u - data.test.displacements[strongest])
    share = 100 * off / np.linalg.norm(data.test.displacements[strongest])
    stress = von_mises(u)
    off = 100 * np.linalg.norm(stress - exact) / np.linalg.norm(exact)
    label = f"{n_modes} modes: u off by {share:.1f} %, stress by {off:.1f} %"
    plt.plot(exact, stress, "o", label=label)
plt.plot([0, exact.max()], [0, exact.max()], color="grey", lw=1)
plt.xlabel("von Mises stress, full order (Pa)")
plt.ylabel("von Mises stress, pod (Pa)")
plt.legend(frameon=False)
plt.show()
