"""The version of the package, in the one place from which every file takes it."""

__version__ = "0.1.0"
