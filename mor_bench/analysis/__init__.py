"""Conclusions from a comparison's rows and raw samples, each with its uncertainty.

What lives here: the frontier of error and latency, confidence and prediction intervals, verdicts
on pairs of methods, break-even counts, and all other content of comparison.json.
What may not: running or timing a method, reading files of other formats, and any output for
readers; those belong to `mor_bench.run`, `mor_bench.results` and `mor_bench.report`.
Start with `mor_bench.analysis.analyse.analyse`, which calls everything else.
"""
