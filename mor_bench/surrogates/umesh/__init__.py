"""U-Mesh: a 3D U-Net from nodal forces to nodal displacements.

Here: the network, the map between mesh nodes and its regular grid, the surrogate, and its ONNX
graph. Not here: what all networks share, which is in `mor_bench.learning` (training, inference) and
`mor_bench.surrogates.field_surrogate` (scales, linear response, files). Start with `method.UMesh`.

It is a package because the network, the grid and the graph are of use without the surrogate.
"""
