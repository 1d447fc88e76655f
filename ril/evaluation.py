"""Scoring policies: many greedy episodes, all seeds at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats
from ril.vectorized.rollout import Environments
from ril.vectorized.streams import Streams

_COPIES = 25  # environments per seed that are played side by side


class Evaluation:
    """Average episodic reward of S policies (AER, §4).

    Args:
        environment: in which they are scored.
        seeds: S; each has its own stream of episodes, apart from all that training draws.
    """

    def __init__(self, environment: Environment, seeds: Sequence[int]) -> None:
        self.environment = environment
        self.seeds = seeds
        self._environments: dict[int, Environments] = {}

    def returns(
        self, act: Callable[[Floats], NDArray[np.int64]], episodes: int, purpose: str
    ) -> NDArray[np.float64]:
        """Returns of whole episodes.

        Args:
            act: (S·N, obs) scaled observations, one seed's side by side, to (S·N,) actions.
            episodes: how many per seed.
            purpose: names the episodes; the same purpose gives the same starts.

        Returns:
            (S, episodes) undiscounted returns.
        """
        starts = Streams(self.seeds, f"evaluation {purpose}").integers(2**31, episodes)
        rounds = [
            self._copies(part.shape[1])
            .play(lambda observations, _: act(observations), part.ravel())
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


def random_returns(environment: Environment, episodes: int) -> NDArray[np.float64]:
    """(episodes,) returns of uniformly random actions, which `performance` counts from (§4)."""
    stream = Streams([0], "random policy")
    count = min(episodes, _COPIES)
    environments = Environments(environment, count)
    returns: list[float] = []
    while len(returns) < episodes:
        drawn = stream.uniform(environment.max_episode_steps, count)[0]
        actions = (drawn * environment.action_count).astype(np.int64)
        starts = stream.integers(2**31, count).ravel()

        def act(_: Floats, step: int, actions: NDArray[np.int64] = actions) -> NDArray[np.int64]:
            chosen: NDArray[np.int64] = actions[step]
            return chosen

        returns.extend(environments.play(act, starts).returns)
    return np.array(returns[:episodes])
