"""Measure a fitted method: errors, latency, cost of a query, error indicators, range flags, discretisation error.

Here live the measurements and the session in which a method runs while it is measured. What a
measurement means for a choice of method lives in `mor_bench.analysis`, and which configurations are
measured when in `mor_bench.run`.

Start reading at `method_session` (what happens in the method's process), then `latency`.
"""
