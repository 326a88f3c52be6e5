"""Measure fitted methods: errors, latency, work per query, error indicators, and range flags.

Here live the measurements and the session in which a method runs while it is measured.
`mor_bench.analysis` interprets the measurements. `mor_bench.runs` decides which configurations are
measured, and when.

Start reading at `method_session` (the method's process), then `latency` (the order and the length
of turns). `timing` stores the raw samples and judges whether they are stable.
`error_metrics` compares answers with the reference.
"""
