"""Files for others: VTU for ParaView, NumPy arrays, ONNX networks, results for asv, archives.

Here: one module per target, each with a function `export_…` that writes its files.
Not here: formats that this package reads (`mor_bench.snapshots`, `mor_bench.results`), and pages
and tables for readers (`mor_bench.report`).
Start with `vtu_files.py`, the simplest target. The commands are in `mor_bench.cli.export_commands`.
`archive.py`, with `archive_writer.py` and `data_card.py`, writes datasets for data repositories.
"""
