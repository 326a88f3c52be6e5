"""Mechanics of one body: elements, laws, assembly, solvers of linear and nonlinear systems.

Start with `model.FullOrderModel`, which maps nodal forces to displacements at a stable equilibrium.
`assembly` integrates forces and tangents, `newton` solves for equilibria, `observed` handles
observed displacements instead of forces, and `stability` follows a path to its limit load.

Reduced bases and surrogates do not belong here; this package knows scenes, but no snapshots.
Compiled kernels check no bounds, so callers must check shapes. Kernels call small helpers with
`inline="always"`; ordinary calls changed the last digits after loading from numba's cache.
"""
