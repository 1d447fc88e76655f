"""Replay memories of S seeds: one ring buffer per seed, in arrays of fixed size."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.environments.environment import Floats
from ril.vectorized.rollout import Episodes
from ril.vectorized.state import Stateful


def random_indices(uniform: NDArray[np.float32], sizes: NDArray[np.int64]) -> Tensor:
    """Turn uniform numbers (S, …) in [0, 1) into indices (S, …) below each seed's size (S,)."""
    return indices_below(torch.from_numpy(sizes), torch.from_numpy(uniform))


def indices_below(sizes: Tensor, uniform: Tensor) -> Tensor:
    """Turn uniform numbers (S, …) in [0, 1) into indices (S, …) below each seed's size (S,)."""
    ceiling = sizes.view(-1, *[1] * (uniform.ndim - 1))
    return torch.minimum((uniform.double() * ceiling).long(), ceiling - 1)


def gather_by_seed(values: Tensor, indices: Tensor) -> Tensor:
    """Select each seed's own entries.

    Args:
        values: (S, N, …).
        indices: (S, C) below N.

    Returns:
        (S, C, …).
    """
    seeds, stored = values.shape[:2]
    firsts = torch.arange(0, seeds * stored, stored, device=indices.device)[:, None]
    chosen = values.flatten(0, 1).index_select(0, (indices + firsts).flatten())
    return chosen.view(*indices.shape, *values.shape[2:])


class Batch(NamedTuple):
    """B transitions of each seed."""

    observations: Tensor  # (S, B, obs)
    actions: Tensor  # (S, B)
    rewards: Tensor  # (S, B)
    next_observations: Tensor  # (S, B, obs)
    terminated: Tensor  # (S, B), 1.0 where the environment ended the episode

    def at(self, indices: Tensor) -> Batch:
        """Return the transitions at indices (S, C) of each seed's B."""
        return Batch(*(gather_by_seed(field, indices) for field in self))


class Replay(Stateful):
    """The newest `capacity` transitions of each seed.

    Args:
        seeds: S.
        capacity: transitions kept per seed.
        observation_size: entries of one observation.
        device: device of the arrays.

    Attributes:
        sizes: (S,) stored transitions.
    """

    STATE: ClassVar = ("sizes", "_positions", *Batch._fields)

    def __init__(
        self, seeds: int, capacity: int, observation_size: int, device: torch.device
    ) -> None:
        self.capacity = capacity
        self.sizes = np.zeros(seeds, dtype=np.int64)
        self._positions = np.zeros(seeds, dtype=np.int64)
        # A transition's numbers lie side by side, so that drawing it reads one place in memory.
        size = observation_size
        rows = torch.zeros(seeds, capacity, 2 * size + 2, device=device)
        self.observations, self.next_observations = rows[..., :size], rows[..., size : 2 * size]
        self.rewards, self.terminated = rows[..., -2], rows[..., -1]
        self.actions = torch.zeros(seeds, capacity, dtype=torch.int64, device=device)
        # NumPy's views of the same memory: it writes five times as fast as torch.
        self._shared = [each.numpy() for each in self.everything() if each.is_cpu]

    def append(self, episodes: Episodes, keep: NDArray[np.bool_] | None = None) -> None:
        """Append whole episodes; where a memory is full, they replace its oldest transitions.

        Args:
            episodes: S·N episodes, the N of one seed side by side.
            keep: (S·N,) mask of the episodes to append; None for all.
        """
        per_seed = len(episodes.lengths) // len(self.sizes)
        for episode, length in enumerate(episodes.lengths):
            if keep is not None and not keep[episode]:
                continue
            seed = episode // per_seed
            steps = np.arange(max(0, length - self.capacity), length)
            slots = torch.from_numpy((self._positions[seed] + steps) % self.capacity)
            for name in Batch._fields:
                array: Tensor = getattr(self, name)
                values = torch.from_numpy(getattr(episodes, name)[episode, steps])
                array[seed, slots] = values.to(array)
            self._positions[seed] = (self._positions[seed] + length) % self.capacity
            self.sizes[seed] = min(self.sizes[seed] + length, self.capacity)

    def add(
        self,
        observations: Floats,
        actions: NDArray[np.int64],
        rewards: Floats,
        next_observations: Floats,
        terminated: NDArray[np.bool_],
    ) -> int:
        """Append one transition to each seed's memory; all must hold equally many.

        Args:
            observations: (S, obs) scaled states.
            actions: (S,).
            rewards: (S,).
            next_observations: (S, obs) scaled next states.
            terminated: (S,) whether the environment ended the episode.

        Returns:
            The slot that holds them.
        """
        slot = int(self._positions[0])
        columns = (observations, actions, rewards, next_observations, terminated)
        if self._shared:
            for shared, values in zip(self._shared, columns, strict=True):
                shared[:, slot] = values
        else:
            for array, values in zip(self.everything(), columns, strict=True):
                array[:, slot] = torch.from_numpy(values)
        self._positions[:] = (slot + 1) % self.capacity
        self.sizes = np.minimum(self.sizes + 1, self.capacity)
        return slot

    def newest(self, uniform: NDArray[np.float32], count: int) -> Tensor:
        """Turn numbers (S, …) in [0, 1) into slots of each seed's `count` newest transitions."""
        ages = random_indices(uniform, np.minimum(self.sizes, count)).numpy()
        newest = self._positions.reshape(-1, *[1] * (uniform.ndim - 1)) - 1
        return torch.from_numpy((newest - ages) % self.capacity)

    def clear(self) -> None:
        """Remove all transitions."""
        self.sizes[:] = 0
        self._positions[:] = 0

    def everything(self) -> Batch:
        """Return all slots (S, capacity, …), including the empty ones."""
        return Batch(*(getattr(self, name) for name in Batch._fields))
