"""
A bound for every single answer
===============================

Validation samples calibrate a bound that a share of new loads keeps: the level, here at least a
half. The validation samples of this small dataset lie in three load regions, which allow no bound
for 90 %. Each dot is a test load.
"""

import matplotlib.pyplot as plt
import numpy as np

import mor_bench

data = mor_bench.load_dataset("beam-tiny")
method = mor_bench.load_method("pod", n_modes=10).fit(data.scene, data.train)
bound = mor_bench.error_bound(method, data.validation, level=0.5)

u = method.predict(data.test.forces)
errors = np.linalg.norm(u - data.test.displacements, axis=(1, 2))
limits = bound.of_prediction(u)
plt.figure(layout="constrained")
plt.loglog(limits, errors, ".", alpha=0.5)
ends = [limits[limits > 0].min(), limits.max()]
plt.loglog(ends, ends, color="black", lw=1)
plt.gca().xaxis.set_minor_formatter(plt.NullFormatter())
plt.xlabel("bound of the error (m)")
plt.ylabel("error (m)")
plt.title(f"{100 * np.mean(errors <= limits):.0f} % of the test loads are below the line")
plt.show()
