"""
How many modes does a beam need?
================================

The singular values of the snapshots bound the error of every linear basis. Galerkin projection
comes close to that bound.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench
from mor_bench.reduction.basis import pod

data = mor_bench.load_dataset("beam-tiny")
values = pod(data.train.free_displacements).singular_values
tail = np.sqrt(1 - np.cumsum(values**2) / np.sum(values**2))
ranks = [1, 2, 3, 5, 10, 20]


def error(n_modes):
    method = mor_bench.load_method("pod", n_modes=n_modes).fit(data.scene, data.train)
    u = data.test.displacements
    off = np.linalg.norm(method.predict(data.test.forces) - u, axis=(1, 2))
    return np.sqrt(np.sum(off**2) / np.sum(u**2))


plt.semilogy(np.arange(1, 31), tail[:30], label="best basis, training samples")
plt.semilogy(ranks, [error(r) for r in ranks], "o", label="pod, test samples")
plt.xlabel("number of modes")
plt.ylabel("relative error (root mean square)")
plt.legend(frameon=False)
plt.show()
