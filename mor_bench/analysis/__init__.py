"""Conclusions from a comparison's rows and raw samples, each with its uncertainty.

Here: the frontier of error and latency, confidence and prediction intervals, verdicts on pairs of
methods, break-even counts, and all other content of comparison.json.
Not here: running or timing a method (`mor_bench.runs`), files of other formats
(`mor_bench.results`), and output for readers (`mor_bench.report`).
Start with `mor_bench.analysis.analyse.analyse`, which calls everything else.
"""
