"""The published numbers: evidence in `reports/`, and the pages that are regenerated from it.

    python -m tests.published.record NAME     # run an experiment of reports/sources.toml, store it
    python -m tests.published.write           # write its numbers into README and docs

`stored.py` reads the evidence, `compact.py` makes it from a run's folder. `blocks.py` regenerates
tables, `pictures.py` pictures, and `claims.py` numbers in sentences. The tables themselves are in
`run_tables.py` and `other_tables.py`.
"""
