"""
Where on the body is a method wrong?
====================================

Each dot is a test load at the centre of its patch on the top face. A median over all loads hides
where the errors are large. The beam is held at x = 0.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

data = mor_bench.load_dataset("beam-tiny", split="sample")
u = data.test.displacements
figure, axes = plt.subplots(2, 1, figsize=(6, 5.6), layout="constrained", sharex=True)
for name, sub in zip(("pod", "pca-regression-linear"), axes, strict=True):
    method = mor_bench.load_method(name).fit(data.scene, data.train)
    off = np.linalg.norm(method.predict(data.test.forces) - u, axis=(1, 2))
    error = 100 * off / np.linalg.norm(u, axis=(1, 2))
    size = np.abs(data.test.forces).sum(axis=2)
    centre = np.einsum("sn,nd->sd", size / size.sum(axis=1, keepdims=True), data.scene.mesh.points)
    colours = {"c": np.log10(error), "vmin": -1, "vmax": 2, "cmap": "magma_r"}
    shown = sub.scatter(centre[:, 0], centre[:, 1], **colours)
    sub.set(title=name, ylabel="y (m)", aspect="equal", xlim=(0, 2), ylim=(0, 1))
axes[1].set_xlabel("x (m)")
figure.colorbar(shown, ax=axes, label="log10 of the error (%)")
plt.show()
