"""Files for other programs: VTU for ParaView, NumPy arrays, ONNX networks, results for asv.

What lives here: one module per target, each with a function `export_…` that writes its files.
What may not: formats that this package reads in again, and pages and tables for readers; those
belong to `mor_bench.snapshots`, `mor_bench.results` and `mor_bench.report`.
Start with `vtu_files.py`, the simplest target. The commands are in `mor_bench.cli.export_commands`.
"""
