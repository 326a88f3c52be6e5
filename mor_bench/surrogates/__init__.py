"""The methods of the suite, one file each, and their shared base classes.

Here: subclasses of `mor_bench.Surrogate` with `learn`, `prepare` and `answer`. Not here: mechanics
and bases (`mechanics`, `reduction`), training loops (`learning`), or anything that runs, measures
or compares methods. No method imports the sandbox, a run or a report.

Start with `linear_fem.py` (no snapshots), then `pod.py` (a basis and its reduced problem).
`hyper_reduced.py`, `free_dofs.py`, `coordinate_regression.py` and `field_surrogate.py` are shared
by families of methods. A TOML file in `methods/` names each method.
"""
