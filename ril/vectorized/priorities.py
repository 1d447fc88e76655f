"""Proportional prioritized replay for S memories (Schaul et al., 2015, §3.3 and appendix B)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from ril.vectorized.state import Stateful

_EPSILON = 1e-6  # ε of their §3.3: a transition without error can still be drawn again
_LEVELS = 3

#: From the top down, (S, F), (S, F²), (S, F³): the children of a node lie side by side.
Levels = tuple[Tensor, ...]


class Priorities(Stateful):
    """Sampling weights (|δ| + ε)^α of each slot of each seed's memory, in a sum tree.

    The tree has three levels, and every node F = ∛N children, instead of two as in the paper's: a
    level costs a few array operations for all seeds and draws at once, in eager mode and as part of
    a compiled graph. A node is always summed from its children, so that no rounding accumulates.

    Args:
        seeds: S.
        capacity: N, slots per seed.
        alpha: α, how strongly the errors count; 0 draws uniformly.
        device: device of the arrays.

    Attributes:
        levels: the sums of the tree, of which the last level are the weights.
    """

    STATE: ClassVar = ("levels", "_highest")

    def __init__(self, seeds: int, capacity: int, alpha: float, device: torch.device) -> None:
        self.alpha = alpha
        self._children = next(f for f in range(1, capacity + 1) if f**_LEVELS >= capacity)
        self.levels: Levels = tuple(
            torch.zeros(seeds, self._children ** (level + 1), dtype=torch.float64, device=device)
            for level in range(_LEVELS)
        )
        self._highest = torch.ones(seeds, dtype=torch.float64, device=device)
        self._rows = torch.arange(seeds, device=device)[:, None]

    @property
    def weights(self) -> Tensor:
        """(S, ≥ N) weights: a slot is drawn in proportion to its weight; 0 for empty slots."""
        return self.levels[-1]

    def add(self, slots: Tensor) -> None:
        """Give new transitions at slots (S, C) the highest priority of their seed so far."""
        self._set(slots, self._highest[:, None].expand(slots.shape))

    def update(self, slots: Tensor, errors: Tensor) -> None:
        """Set the priorities of slots (S, B) from their newest errors δ (S, B)."""
        priorities = errors.abs().double() + _EPSILON
        self._highest.copy_(torch.maximum(self._highest, priorities.amax(dim=1)))
        self._set(slots, priorities)

    def _set(self, slots: Tensor, priorities: Tensor) -> None:
        """Write priorities (S, C) at slots (S, C), and update the sums above them."""
        self.weights[self._rows, slots] = priorities**self.alpha
        nodes = slots
        for level in reversed(range(1, _LEVELS)):
            nodes = nodes // self._children
            sums = _below(self.levels, level, nodes).sum(dim=-1)
            self.levels[level - 1][self._rows, nodes] = sums


def draw(levels: Levels, uniform: Tensor, sizes: Tensor) -> Tensor:
    """Draw slots in proportion to their weights, one from each of B equal shares of the sum.

    Args:
        levels: of the sum tree.
        uniform: (S, B) random numbers in [0, 1).
        sizes: (S,) filled slots.

    Returns:
        (S, B) slots.
    """
    children = levels[0].shape[1]
    count, last = uniform.shape[1], sizes[:, None] - 1
    positions = torch.arange(children, device=uniform.device)
    nodes = torch.zeros_like(last)  # the root
    share = torch.arange(count, device=uniform.device) + uniform.double()
    sought = share / count * levels[0].cumsum(dim=-1)[:, -1:]
    for level in range(_LEVELS):
        ends = _below(levels, level, nodes).cumsum(dim=-1)
        child = (ends <= sought[..., None]).sum(dim=-1)
        # Rounding may lead past the last filled slot.
        last_node = last // children ** (_LEVELS - 1 - level)
        child = torch.minimum(child, last_node - nodes * children)
        before = torch.where(positions < child[..., None], ends, 0.0).amax(dim=-1)
        sought = sought - before
        nodes = nodes * children + child
    return nodes


def importance(levels: Levels, slots: Tensor, sizes: Tensor, beta: Tensor) -> Tensor:
    """Compute importance-sampling weights (N·P)^−β, scaled so that each batch's largest is 1.

    Args:
        levels: of the sum tree.
        slots: (S, B) drawn slots.
        sizes: (S,) filled slots.
        beta: β in [0, 1], how much of the bias of prioritized draws is corrected; (1,).

    Returns:
        (S, B).
    """
    chance = levels[-1].gather(1, slots) / levels[0].sum(dim=-1, keepdim=True)
    weights = (sizes[:, None] * chance) ** -beta
    return (weights / weights.amax(dim=1, keepdim=True)).float()


def _below(levels: Levels, level: int, nodes: Tensor) -> Tensor:
    """Return the children (S, C, F), on a level, of nodes (S, C) of the level above."""
    groups = levels[level].view(len(nodes), -1, levels[0].shape[1])
    return groups[torch.arange(len(nodes), device=nodes.device)[:, None], nodes]
