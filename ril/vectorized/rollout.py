"""Episodes of many copies of one environment, played side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats

Integers = NDArray[np.int64]
#: (K, obs) scaled observations and the step number to (K,) actions.
Act = Callable[[Floats, int], Integers]


@dataclass(frozen=True)
class Episodes:
    """K episodes, padded to the longest.

    Attributes:
        observations: (K, T, obs) scaled states s_t.
        actions: (K, T).
        rewards: (K, T), 0 beyond an episode's end.
        next_observations: (K, T, obs) scaled states s_{t+1}.
        terminated: (K, T), true at a last step that the environment itself ended.
        lengths: (K,) steps of each.
    """

    observations: Floats
    actions: Integers
    rewards: Floats
    next_observations: Floats
    terminated: NDArray[np.bool_]
    lengths: Integers

    @property
    def returns(self) -> NDArray[np.float64]:
        """(K,) undiscounted returns."""
        total: NDArray[np.float64] = self.rewards.sum(axis=1, dtype=np.float64)
        return total

    @property
    def ends(self) -> NDArray[np.bool_]:
        """(K,) whether the environment ended the episode, rather than the step limit."""
        return self.terminated[np.arange(len(self.lengths)), self.lengths - 1]

    @property
    def final_rewards(self) -> Floats:
        """(K,) reward of each episode's last step."""
        return self.rewards[np.arange(len(self.lengths)), self.lengths - 1]


class Environments:
    """K copies of an environment, each stepped only while its own episode lasts.

    Args:
        environment: of which copies are made.
        copies: K.
    """

    def __init__(self, environment: Environment, copies: int) -> None:
        self.environment = environment
        self._copies = [environment.make() for _ in range(copies)]

    def play(self, act: Act, reset_seeds: Integers, max_steps: int | None = None) -> Episodes:
        """Play one episode in each copy.

        Args:
            act: chooses all copies' actions; its answer for copies that have ended is ignored.
            reset_seeds: (K,) what each copy is reset with.
            max_steps: T, the step at which all episodes are cut; the environment's own limit
                if None.
        """
        count = len(self._copies)
        limit = max_steps or self.environment.max_episode_steps
        size = self.environment.observation_size
        states = np.zeros((limit + 1, count, size), dtype=np.float32)
        actions = np.zeros((limit, count), dtype=np.int64)
        rewards = np.zeros((limit, count), dtype=np.float32)
        terminated = np.zeros((limit, count), dtype=bool)
        lengths = np.zeros(count, dtype=np.int64)

        raw = np.zeros((count, size), dtype=np.float32)
        for index, (copy, seed) in enumerate(zip(self._copies, reset_seeds, strict=True)):
            raw[index] = copy.reset(seed=int(seed))[0]
        states[0] = self.environment.scale(raw)
        running = list(enumerate(self._copies))
        step = 0
        while running and step < limit:
            actions[step] = act(states[step], step)
            chosen = actions[step].tolist()
            going_on = []
            for index, copy in running:
                raw[index], reward, ended, cut, _ = copy.step(chosen[index])
                rewards[step, index] = reward
                terminated[step, index] = ended
                if ended or cut:
                    lengths[index] = step + 1
                else:
                    going_on.append((index, copy))
            running = going_on
            step += 1
            states[step] = self.environment.scale(raw)
        for index, _ in running:
            lengths[index] = step

        by_copy = np.ascontiguousarray(states[: step + 1].swapaxes(0, 1))
        return Episodes(
            by_copy[:, :-1],
            np.ascontiguousarray(actions[:step].T),
            np.ascontiguousarray(rewards[:step].T),
            by_copy[:, 1:],
            np.ascontiguousarray(terminated[:step].T),
            lengths,
        )
