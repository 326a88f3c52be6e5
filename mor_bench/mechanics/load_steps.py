"""Bookkeeping of a load that is applied in increments."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class LoadSteps:
    """Increments of a load factor from 0 to 1, halved on failure and grown on success.

    Attributes
    ----------
    increment : float
        Next increment of the load factor.
    reached : float
        Largest load factor with a solution.
    cuts : int
        Number of halvings.
    growth : float
        Factor of the increment after a success.
    """

    increment: float
    reached: float = 0.0
    cuts: int = 0
    growth: float = 2.0

    @property
    def target(self) -> float:
        """The load factor to solve for next."""
        return min(1.0, self.reached + self.increment)

    @property
    def complete(self) -> bool:
        """True once the whole load has been solved for."""
        return self.reached == 1.0

    def accept(self) -> None:
        """Record that the target was reached, and let the increment grow."""
        self.reached, self.increment = self.target, self.growth * self.increment

    def cut(self) -> None:
        """Record that the target was not reached, and halve the increment."""
        self.cuts += 1
        self.increment *= 0.5

    def story(self, iterations: int) -> str:
        """Describe for an error message how far the load was followed."""
        return (
            f"stopped at {self.reached:.4g} of the load after {iterations} iterations "
            f"and {self.cuts} cut-backs"
        )
