"""`python -m mor_bench` is `mor-bench`."""

from mor_bench.cli import app

if __name__ == "__main__":
    app(prog_name="mor-bench")
