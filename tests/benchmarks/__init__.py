"""Benchmarks that asv runs over the project's history; see CONTRIBUTING.md for how."""
