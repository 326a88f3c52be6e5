"""U-Mesh: a 3D U-Net from nodal forces to nodal displacements. The only package of mor_bench that imports torch."""
