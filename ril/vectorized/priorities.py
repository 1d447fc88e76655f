"""Proportional prioritized replay for S memories (Schaul et al., 2015, §3.3 and appendix B)."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.vectorized.state import Stateful

_EPSILON = 1e-6  # ε of their §3.3: a transition without error can still be drawn again


class Priorities(Stateful):
    """Sampling weights (|δ| + ε)^α of each slot of each seed's memory.

    The slots lie in √N blocks of √N slots, with a sum for each block, instead of in a binary
    sum-tree. A draw searches the sums, then one block: a few array operations for all seeds and
    draws at once, where a tree needs one after another for each of its levels.

    Args:
        seeds: S.
        capacity: N, slots per seed.
        alpha: α, how strongly the errors count; 0 draws uniformly.
        device: device of the arrays.
    """

    STATE: ClassVar = ("_blocks", "_sums", "_highest")

    def __init__(self, seeds: int, capacity: int, alpha: float, device: torch.device) -> None:
        self.alpha = alpha
        block = math.ceil(math.sqrt(capacity))
        self._blocks = torch.zeros(seeds, block, block, dtype=torch.float64, device=device)
        self._sums = torch.zeros(seeds, block, dtype=torch.float64, device=device)
        self._highest: Tensor = torch.ones(seeds, dtype=torch.float64, device=device)
        self._rows = torch.arange(seeds, device=device)[:, None]

    @property
    def weights(self) -> Tensor:
        """(S, ≥ N) weights: a slot is drawn in proportion to its weight; 0 for empty slots."""
        return self._blocks.flatten(1)

    def add(self, slots: Tensor) -> None:
        """Give new transitions at slots (S, C) the highest priority of their seed so far."""
        self._set(slots, self._highest[:, None].expand(slots.shape))

    def update(self, slots: Tensor, errors: Tensor) -> None:
        """Set the priorities of slots (S, B) from their newest errors δ (S, B)."""
        priorities = errors.abs().double() + _EPSILON
        self._highest = torch.maximum(self._highest, priorities.amax(dim=1))
        self._set(slots, priorities)

    def _set(self, slots: Tensor, priorities: Tensor) -> None:
        """Write priorities (S, C) at slots (S, C), and update the sums of their blocks."""
        self.weights[self._rows, slots] = priorities**self.alpha
        touched = slots // self._sums.shape[1]
        self._sums[self._rows, touched] = self._blocks[self._rows, touched].sum(dim=-1)

    def draw(self, uniform: NDArray[np.float32], sizes: NDArray[np.int64]) -> Tensor:
        """Draw slots in proportion to their weights, one from each of B equal shares of the sum.

        Args:
            uniform: (S, B) random numbers in [0, 1).
            sizes: (S,) filled slots.

        Returns:
            (S, B) slots.
        """
        count = uniform.shape[1]
        up_to = self._sums.cumsum(dim=-1)
        share = torch.arange(count, device=up_to.device) + torch.from_numpy(uniform).to(up_to)
        sought = share / count * up_to[:, -1:]
        last = torch.from_numpy(sizes - 1).to(up_to.device)[:, None]
        block: Tensor = torch.searchsorted(up_to, sought, right=True)
        block = block.minimum(last // self._sums.shape[1])
        within = sought - (up_to - self._sums).gather(1, block)
        below = self._blocks[self._rows, block].cumsum(dim=-1) <= within[..., None]
        slots = block * self._sums.shape[1] + below.sum(dim=-1)
        drawn: Tensor = slots.minimum(last)  # rounding may lead past the last filled slot
        return drawn

    def importance(self, slots: Tensor, sizes: NDArray[np.int64], beta: float) -> Tensor:
        """Compute importance-sampling weights (N·P)^−β, scaled so that each batch's largest is 1.

        Args:
            slots: (S, B) drawn slots.
            sizes: (S,) filled slots.
            beta: β in [0, 1], how much of the bias of prioritized draws is corrected.

        Returns:
            (S, B).
        """
        stored = torch.from_numpy(sizes).to(slots.device)[:, None]
        chance = self.weights[self._rows, slots] / self._sums.sum(dim=-1, keepdim=True)
        weights = (stored * chance) ** -beta
        return (weights / weights.amax(dim=1, keepdim=True)).float()
