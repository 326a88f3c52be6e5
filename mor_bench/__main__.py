"""Run the command line: `python -m mor_bench` is the same as `mor-bench`."""

from mor_bench.cli.app import app

if __name__ == "__main__":
    app(prog_name="mor-bench")
