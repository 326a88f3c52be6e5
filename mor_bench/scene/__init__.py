"""The simulated body: meshes, materials, supports, load patches, and readers of their files.

Here: geometry and the input of the equations. Not here: the equations (`mor_bench.mechanics`),
samples (`mor_bench.snapshots`), or anything about methods. This package imports only `errors` and
`specs`.

Start with `scene.py`: every method is given a `Scene`, and `load_scene` builds one. Then:
`mesh.py`, `regions.py`, `loads.py` (positions of patches; `mor_bench.snapshots.sampling` draws the
forces on them), `materials.py`, `interpolation.py`, `nearest.py` and `grid.py`. Bodies:
`surfaces.py` with `voxels.py`, `tetrahedra.py`, `liver.py`. Files: `files.py`, `point_sets.py`,
`soundness.py`, `snapshot_file.py`.
"""
