"""What is simulated: meshes, materials, supports, load patches, and the files they are read from.

Here: geometry and the input of the equations. Not here: the equations (`mor_bench.mechanics`),
samples (`mor_bench.snapshots`), or anything about methods. This package imports only `errors` and
`specs`.

Start with `scene.py`: `Scene` is what every method is given, and `load_scene` builds it. Then:
`mesh.py`, `regions.py`, `loads.py` (where patches lie; `mor_bench.snapshots.sampling` draws the
forces on them), `materials.py`, `interpolation.py` and `grid.py`. Bodies: `surfaces.py` with
`voxels.py`, `tetrahedra.py`, `liver.py`. Files: `files.py`, `point_sets.py`, `soundness.py`,
`snapshot_file.py`.
"""
