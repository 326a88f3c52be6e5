"""Samples: drawing, generation, storage, reading, splits, and import from other programs.

Here: sampling plans, the store of HDF5 shards, generation on this machine or a cluster, splits,
test sets, and the queries of methods. Not here: methods, errors of predictions, or reports.
This package imports only `errors`, `specs`, `scene` and `mechanics`.

Start with `dataset.py`: `load_dataset` reads a dataset as `Snapshots`. Then `sampling.py` (which
forces act in sample i: kinds of load and sampling plans), `generate.py` with `solve.py` and
`executors.py`, `store.py` and `manifest.py` (files), `split.py` and `test_sets.py`.
`archive_files.py` and `archive_import.py` read archives of other people.
"""
