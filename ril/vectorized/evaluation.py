"""Scoring policies: many greedy episodes, all seeds at once."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Environment, Floats, Integers
from ril.vectorized.networks import Network, greedy
from ril.vectorized.rollout import Environments
from ril.vectorized.streams import Streams

_COPIES = 50  # environments per seed that are played side by side
#: Environments per seed for random actions; another number would draw other actions.
RANDOM_COPIES = 25


class Evaluation:
    """Average episodic reward of S policies (AER, §4).

    Args:
        environment: the environment in which they are scored.
        seeds: S; each has its own stream of episodes, apart from all that training draws.
    """

    def __init__(self, environment: Environment, seeds: Sequence[int]) -> None:
        self.environment = environment
        self.seeds = seeds
        self._environments: dict[int, Environments] = {}

    def returns(self, policy: Network, episodes: int, purpose: str) -> NDArray[np.float64]:
        """Returns of whole, greedy episodes.

        Args:
            policy: the policies of the S seeds.
            episodes: how many per seed.
            purpose: names the episodes; the same purpose gives the same starts.

        Returns:
            (S, episodes) undiscounted returns.
        """
        starts = Streams(self.seeds, f"evaluation {purpose}").integers(2**31, episodes)
        infer = policy.frozen()
        rounds = [
            self._copies(part.shape[1])
            .play(lambda observations, _: greedy(infer(observations)), part.ravel())
            .returns.reshape(part.shape)
            for part in np.split(starts, range(_COPIES, episodes, _COPIES), axis=1)
        ]
        return np.concatenate(rounds, axis=1)

    def _copies(self, per_seed: int) -> Environments:
        if per_seed not in self._environments:
            self._environments[per_seed] = Environments(
                self.environment, len(self.seeds) * per_seed
            )
        return self._environments[per_seed]


def random_returns(
    environment: Environment, seeds: Sequence[int], episodes: int
) -> NDArray[np.float64]:
    """(S, episodes) returns of random actions; `performance` counts from seed 0's (§4)."""
    streams = Streams(seeds, "random policy")
    copies = min(episodes, RANDOM_COPIES)
    environments = Environments(environment, len(seeds) * copies)
    rounds = []
    for _ in range(math.ceil(episodes / copies)):
        drawn = streams.uniform(environment.max_episode_steps, copies)
        actions = (drawn * environment.action_count).astype(np.int64)
        starts = streams.integers(2**31, copies).ravel()

        def act(_: Floats, step: int, actions: Integers = actions) -> Integers:
            return actions[:, step].ravel()

        rounds.append(environments.play(act, starts).returns.reshape(len(seeds), copies))
    return np.concatenate(rounds, axis=1)[:, :episodes]
