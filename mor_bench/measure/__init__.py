"""Measure fitted methods: errors, latency, work per query, error indicators, and range flags.

Here live the measurements and the session in which a method runs while it is measured. What a
measurement means for a choice of method lives in `mor_bench.analysis`, and which configurations are
measured when in `mor_bench.runs`.

Start reading at `method_session` (what happens in the method's process), then `latency` (who takes
a turn, and how long it lasts). `timing` keeps what was measured and judges whether it is stable.
`error_metrics` compares answers with the reference.
"""
