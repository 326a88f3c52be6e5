"""
What a solve costs on larger meshes
===================================

A stored measurement of the full-order model. Small meshes have a banded factor of the stiffness at
rest, large ones multigrid, which saves memory.
"""

import json

import matplotlib.pyplot as plt

from mor_bench.specs.suite_folder import find_suite

folder = find_suite() / "reports" / "full-order"
sizes = json.loads((folder / "scaling.json").read_text())["sizes"]
figure, (time, memory) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for kind, marker in {"BandedFactor": "o", "MultigridFactor": "s"}.items():
    rows = [row for row in sizes if row["rest_state"] == kind]
    unknowns = [row["unknowns"] for row in rows]
    label = kind.removesuffix("Factor").lower()
    time.loglog(unknowns, [row["solve_s"] for row in rows], marker, label=label)
    memory.loglog(unknowns, [row["peak_mb"] for row in rows], marker, label=label)
time.set(xlabel="unknowns", ylabel="time of a solve (s)")
memory.set(xlabel="unknowns", ylabel="peak memory (MB)")
time.legend(frameon=False)
plt.show()
