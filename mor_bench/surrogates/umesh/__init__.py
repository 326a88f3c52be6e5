"""U-Mesh: a 3D U-Net from nodal forces to nodal displacements.

Here: the network, the map between mesh nodes and its regular grid, the surrogate, and its ONNX
graph. Not here: code shared by all networks. Training and inference are in `mor_bench.learning`;
scales, linear response and files are in `mor_bench.surrogates.field_surrogate`. Start with
`method.UMesh`. The network, the grid and the graph can be used without the surrogate.
"""
