"""Output for readers: console tables, figures and one HTML page.

Here: sentences and tables made from a comparison and its analysis, drawings, and the page's
templates in `templates/`.
Not here: conclusions and statistics (`mor_bench.analysis`), and measurements.
Start with `entries.py`, which joins rows and conclusions; then `page.py` and `console_tables.py`.
`console_columns.py` and `page_columns.py` define the columns of the large table.
"""
