"""Tools for reduced models: bases, cubatures, and reduced problems for the nonlinear solve.

Start with `basis.pod` and `galerkin.GalerkinProblem`. Hyper-reduction begins at `cubature` (ECSW),
`empirical_cubature` (ECM) and `discrete_interpolation` (DEIM); `points` integrates over the chosen
points. `tensors` evaluates Saint Venant-Kirchhoff as a polynomial, without a mesh.
`greedy` chooses training loads by the estimated errors of a method.

Methods do not belong here: a surrogate combines these tools in `mor_bench.surrogates`.
Compiled kernels check no bounds, so callers must check shapes.
"""
