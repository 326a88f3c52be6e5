"""
Error against time of a stored run
==================================

Every run is a folder. This one ships with the suite; read it, and draw what you need.
"""

import matplotlib.pyplot as plt

import mor_bench
from mor_bench.specs.suite_folder import find_suite

folder = find_suite() / "reports" / "quick-start"
comparison = mor_bench.Comparison.read(folder)
for method in ("fem", "linear-fem", "pod-tensor", "hpod", "pca-regression-linear", "umesh-linear"):
    rows = [row for row in comparison.rows if row.method == method and row.ok]
    plt.loglog(
        [row.latency_ms.median for row in rows],
        [100 * row.error.rel_l2_p95 for row in rows],
        "o-",
        label=method,
    )
plt.xlabel("latency of a query, median (ms)")
plt.ylabel("relative error, 95th percentile (%)")
plt.ylim(bottom=0.1)
plt.legend(frameon=False)
plt.show()
