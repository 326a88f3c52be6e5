"""The results of a run: typed rows, and the folder that holds them.

Here: `Row` and its parts, raw samples, and `Comparison`, which owns a run's folder.
Not here: measuring (`measure`), inference (`analysis`) and tables (`report`).
Start with `row.py`, then `comparison.py`. `results.schema.json` describes results.json.
"""
