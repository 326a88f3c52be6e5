"""Samples as a data set of PyTorch."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from mor_bench.errors import InvalidInputError
from mor_bench.snapshots.dataset import Snapshots

Sample = tuple[torch.Tensor, ...]


class TorchSnapshots(Dataset[Sample]):
    """Pairs of forces, N, and displacements, m, as float32 tensors of shape (n_nodes, 3).

    Tensors are made when they are asked for, a whole batch at once, and nothing is kept. So memory
    holds the samples once, in the compact form that `Snapshots` has.

    In a scene with observed nodes, their displacements replace the forces. In a scene with sampled
    parameters, each sample has these between the forces and the displacements, (n_parameters,).

    Parameters
    ----------
    snapshots : Snapshots
        For example `Dataset.train`.

    Examples
    --------
    >>> import mor_bench
    >>> forces, displacements = TorchSnapshots(mor_bench.load_dataset("beam-tiny").train)[0]
    >>> tuple(forces.shape), displacements.dtype
    ((63, 3), torch.float32)
    """

    def __init__(self, snapshots: Snapshots) -> None:
        if not isinstance(snapshots, Snapshots):
            raise InvalidInputError(
                f"`snapshots` must be Snapshots, such as `data.train`; "
                f"got {type(snapshots).__name__}."
            )
        self.snapshots = snapshots

    def __len__(self) -> int:
        return len(self.snapshots)

    def __getitem__(self, index: int) -> Sample:
        """Return one sample; negative numbers count from the end.

        Raises
        ------
        IndexError
            If there is no such sample.
        InvalidInputError
            If the index is no integer. For several samples, slice the snapshots.
        """
        n = len(self.snapshots)
        try:
            index = operator.index(index)  # also of NumPy and PyTorch
        except TypeError:
            raise InvalidInputError(
                f"the number of a sample must be an integer; got {index!r}. "
                "TorchSnapshots(snapshots[0:3]) holds several."
            ) from None
        if not -n <= index < n:
            raise IndexError(f"sample {index} of {n}")
        return self.__getitems__([index % n])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Return several samples; `DataLoader` asks for each batch in this way.

        Raises
        ------
        InvalidInputError
            If the numbers are no integers.
        """
        numbers = np.asarray(indices)
        if len(numbers) and numbers.dtype.kind not in "iu":
            raise InvalidInputError(f"the numbers of samples must be integers; got {indices!r}.")
        # A part of the samples computes its own forces, and is dropped with them.
        part = self.snapshots[numbers.astype(np.int64)]
        columns = [part.given.values, part.displacements]
        if part.scene.parameter_names:
            columns.insert(1, part.parameters)
        return list(zip(*map(_tensor, columns), strict=True))


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))
