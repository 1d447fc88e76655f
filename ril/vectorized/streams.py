"""One stream of random numbers per seed, so that no seed can affect another."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Streams:
    """S independent generators, one per seed, all for one purpose.

    The purpose is part of each generator's seed: the numbers that one part of a method draws do
    not depend on what another part drew before.

    Args:
        seeds: the S seeds of the run.
        purpose: what the numbers are drawn for, for example "exploration".
    """

    def __init__(self, seeds: Sequence[int], purpose: str) -> None:
        key = zlib.crc32(purpose.encode())
        self._generators = [np.random.Generator(np.random.PCG64DXSM([s, key])) for s in seeds]

    def uniform(self, *shape: int) -> NDArray[np.float32]:
        """Draw (S, *shape) numbers in [0, 1)."""
        numbers = np.empty((len(self._generators), *shape), dtype=np.float32)
        for generator, of_seed in zip(self._generators, numbers, strict=True):
            generator.random(dtype=np.float32, out=of_seed)
        return numbers

    def normal(self, *shape: int) -> NDArray[np.float64]:
        """Draw (S, *shape) numbers of the standard normal distribution."""
        return np.stack([g.standard_normal(shape) for g in self._generators])

    def permutations(self, count: int, size: int) -> NDArray[np.int64]:
        """Draw (S, count, size): permutations of 0, 1, …, size − 1."""
        return np.stack([[g.permutation(size) for _ in range(count)] for g in self._generators])

    def integers(self, high: int, *shape: int) -> NDArray[np.int64]:
        """Draw (S, *shape) integers in [0, high)."""
        return np.stack([g.integers(high, size=shape) for g in self._generators])

    def state_dict(self) -> list[Any]:
        """Return the generators' states, as plain numbers."""
        return [g.bit_generator.state for g in self._generators]

    def load_state_dict(self, states: list[Any]) -> None:
        """Resume from states that `state_dict` returned."""
        for generator, state in zip(self._generators, states, strict=True):
            generator.bit_generator.state = state
