"""Output for readers: console tables, figures and one HTML page.

Here: sentences and tables made from a comparison and its analysis, drawings, and the page: its
templates in `templates/`, its scripts in `static/`, and other people's scripts in `vendor/`.
Not here: conclusions and statistics (`mor_bench.analysis`), and measurements.
Start with `entries.py`, which joins rows and conclusions; then `page.py` and `console_tables.py`.
`console_columns.py` and `page_tables.py` define the columns of the large tables.
"""
