"""Benchmarks of asv for nearly every commit; `tests.benchmarks.asv_history` runs them."""
