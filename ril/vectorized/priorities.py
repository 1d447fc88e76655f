"""Proportional prioritisation of S replay memories (Schaul et al., 2015, §3.3 and appendix B)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_LEAST = 1e-6  # ε of their §3.3: no transition is never drawn again


class Priorities:
    """How likely each slot of each seed's memory is drawn: in proportion to (|δ| + ε)^α.

    In place of a binary sum-tree the slots lie in √N blocks of √N, with a sum for each block. A
    draw looks through the sums, then through one block: a handful of array operations for all
    seeds and draws at once, where a tree takes one after another for each of its levels.

    Args:
        seeds: S.
        capacity: N, slots per seed.
        alpha: how much the errors count; 0 draws uniformly.
        device: where the arrays live.
    """

    def __init__(self, seeds: int, capacity: int, alpha: float, device: torch.device) -> None:
        self.alpha = alpha
        block = math.ceil(math.sqrt(capacity))
        self._blocks = torch.zeros(seeds, block, block, dtype=torch.float64, device=device)
        self._sums = torch.zeros(seeds, block, dtype=torch.float64, device=device)
        self._highest: Tensor = torch.ones(seeds, dtype=torch.float64, device=device)
        self._rows = torch.arange(seeds, device=device)[:, None]

    @property
    def weights(self) -> Tensor:
        """(S, ≥ N) what the chance of each slot is proportional to; 0 where none is stored."""
        return self._blocks.flatten(1)

    def add(self, slots: Tensor) -> None:
        """Give new transitions at slots (S, C) the highest priority that any has had."""
        self._set(slots, self._highest[:, None].expand(slots.shape))

    def update(self, slots: Tensor, errors: Tensor) -> None:
        """Set the priorities of slots (S, B) by the errors δ (S, B) just seen there."""
        priorities = errors.abs().double() + _LEAST
        self._highest = torch.maximum(self._highest, priorities.amax(dim=1))
        self._set(slots, priorities)

    def _set(self, slots: Tensor, priorities: Tensor) -> None:
        self.weights[self._rows, slots] = priorities**self.alpha
        touched = slots // self._sums.shape[1]
        self._sums[self._rows, touched] = self._blocks[self._rows, touched].sum(dim=-1)

    def draw(self, uniform: NDArray[np.float32], sizes: NDArray[np.int64]) -> Tensor:
        """Slots in proportion to their weights, one from each of B equal shares of the whole.

        Args:
            uniform: (S, B) random numbers in [0, 1).
            sizes: (S,) slots that are filled.

        Returns:
            (S, B).
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
        drawn: Tensor = slots.minimum(last)  # where rounding leads past the last filled one
        return drawn

    def importance(self, slots: Tensor, sizes: NDArray[np.int64], beta: float) -> Tensor:
        """Weights (N·P)^−β that undo the bias of such draws, the largest of each batch being 1.

        Args:
            slots: (S, B) as drawn.
            sizes: (S,) slots that are filled.
            beta: how much of the bias is undone, 0 to 1.

        Returns:
            (S, B).
        """
        stored = torch.from_numpy(sizes).to(slots.device)[:, None]
        chance = self.weights[self._rows, slots] / self._sums.sum(dim=-1, keepdim=True)
        weights = (stored * chance) ** -beta
        return (weights / weights.amax(dim=1, keepdim=True)).float()

    def state_dict(self) -> dict[str, Any]:
        """Priorities of all slots."""
        return {"blocks": self._blocks, "sums": self._sums, "highest": self._highest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self._blocks.copy_(state["blocks"])
        self._sums.copy_(state["sums"])
        self._highest = state["highest"].clone()
