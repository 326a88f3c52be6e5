"""Orchestration: what a comparison or a single fit does, step by step.

Lives here: the public `run` (`compare.py`), `fit` (`single_fit.py`) and `pick` (`pick.py`), the dry
run, the cache of fits and scores, and the stages of a run on one dataset.
Does not live here: measuring (`measure`), worker processes (`sandbox`), inference (`analysis`) and
tables (`report`).
Start with `compare.py`, then `dataset_run.py`; one configuration goes through `cached_fit.py`,
`fitting.py`, `scoring.py` and `timing_stage.py`.
"""
