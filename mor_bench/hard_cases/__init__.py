"""The stress suite: where simulations and surrogates usually go wrong, and what they should do.

Here live the cases, bodies with a known answer, and the code that tries every case on every method
that it concerns. A case judges what it computed; it never looks at a method's name. Measuring for a
comparison lives in `mor_bench.measure`.

Start reading at `case` (what a case is), then `method_cases` (of any method), `mechanics_cases` (of
the full-order model) and `reduction_cases` (of the algebra behind reduced bases).

To add a case, write a function from a `Subject` to an `Outcome`, decorate it with `hard_case`, and
name it in the ``CASES`` of its file.
"""
