"""
Two methods, sample by sample
=============================

Medians hide which method wins on which load. Each dot is a test load: above the line, the
projection is worse than the regression.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

data = mor_bench.load_dataset("beam-tiny")
u = data.test.displacements
names = ("pca-regression-linear", "pod-tensor")
errors = {}
for name in names:
    method = mor_bench.load_method(name).fit(data.scene, data.train)
    off = np.linalg.norm(method.predict(data.test.forces) - u, axis=(1, 2))
    errors[name] = 100 * off / np.linalg.norm(u, axis=(1, 2))
plt.loglog(*errors.values(), "o", alpha=0.6)
ends = [min(map(np.min, errors.values())), max(map(np.max, errors.values()))]
plt.loglog(ends, ends, color="grey", lw=1)
plt.xlabel(f"relative error of {names[0]} (%)")
plt.ylabel(f"relative error of {names[1]} (%)")
plt.show()
