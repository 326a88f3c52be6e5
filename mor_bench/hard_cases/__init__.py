"""The stress suite: cases in which simulations and surrogates often fail.

Here live the cases, bodies with a known answer, and the code that tries every case on every method
that it concerns. A case judges what it computed; it never looks at a method's name. Measuring for a
comparison lives in `mor_bench.measure`.

Start reading at `case` (the classes), then `method_cases` (for any method), `mechanics_cases` (for
the full-order model) and `reduction_cases` (for the algebra behind reduced bases).

To add a case, write a function from a `Subject` to an `Outcome` and decorate it with `hard_case`.
Then name it in the ``CASES`` of its file.
"""
