"""Parts of losses that several methods share."""

from __future__ import annotations

from torch import Tensor

LEAST_SQUARE = 1e-12
"""Added to squared relative errors, because a root has no slope at zero."""


def norms(squares: Tensor) -> Tensor:
    """Return relative errors from their squares, of any shape.

    The mean of norms is the loss of the Fourier neural operator (Li et al. 2021) and of Transolver.
    A mean of squares would follow the few worst samples.
    """
    return (squares + LEAST_SQUARE).sqrt()
