"""Doors to other tools and formats, each in a module of its own.

Here: objects and files that another tool reads or made, such as models of pyMOR and data sets in
the layout of The Well. Not here: this package's own files (`mor_bench.snapshots`,
`mor_bench.results`), and files that are only looked at (`mor_bench.export`).

A module may need an extra. No other package imports from here, so nobody pays for a door unused.
"""
