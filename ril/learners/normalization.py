"""Normalization: running, as in Stable-Baselines3's VecNormalize, or by fixed moments."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Floats
from ril.vectorized.state import Stateful

#: Normalized observations and rewards are clipped to ±CLIP.
CLIP = 10.0
_EPSILON = 1e-8


class RunningMoments(Stateful):
    """Mean and variance of all samples so far, by seed (Chan et al., 1979).

    Args:
        seeds: S.
        *shape: shape of a sample.

    Attributes:
        mean: (S, *shape), initially 0.
        variance: (S, *shape), initially 1.
        count: samples of each seed so far; the initial moments count as 1e-4 of a sample.
    """

    STATE: ClassVar = ("mean", "variance", "count")

    def __init__(self, seeds: int, *shape: int) -> None:
        self.mean = np.zeros((seeds, *shape))
        self.variance = np.ones((seeds, *shape))
        self.count = 1e-4

    def update(self, samples: NDArray[Any]) -> None:
        """Add samples (S, K, *shape)."""
        added = samples.shape[1]
        # In double precision and along axis 1, so that a seed's sums do not depend on the others.
        mean = samples.mean(axis=1, dtype=np.float64)
        deviations = samples - mean[:, None]
        total = self.count + added
        difference = mean - self.mean
        self.mean += difference * (added / total)
        squares = (deviations * deviations).sum(axis=1)
        squares += self.variance * self.count
        squares += difference * difference * (self.count * added / total)
        self.variance = squares / total
        self.count = total

    @property
    def deviation(self) -> NDArray[np.float64]:
        """The standard deviation (S, *shape)."""
        return np.sqrt(self.variance + _EPSILON)


class Standardization:
    """Standardizes observations by fixed moments of some states, and clips them to ±10.

    Args:
        states: (M, obs) the states; a feature that never changes has a deviation of 1.

    Attributes:
        mean: (obs,).
        deviation: (obs,).
    """

    def __init__(self, states: Floats) -> None:
        self.mean = states.mean(axis=0, dtype=np.float64)
        spread = states.std(axis=0, dtype=np.float64)
        self.deviation = np.where(spread > _EPSILON, spread, 1.0)

    def __call__(self, observations: Floats) -> Floats:
        """Standardize observations (…, obs)."""
        standardized: Floats = ((observations - self.mean) / self.deviation).clip(-CLIP, CLIP)
        return standardized.astype(np.float32)


class Normalization(Stateful):
    """Normalizes what S seeds see and earn in K environments each.

    Observations have mean 0 and variance 1 over all steps so far. Rewards are divided by the
    standard deviation of the discounted returns so far. Both are clipped to ±10.

    Args:
        observations: (S·K, obs) first observations, which count.
        seeds: S.
        gamma: γ of the returns.

    Attributes:
        seen: moments of the observations.
        earned: moments of the discounted returns.
    """

    STATE: ClassVar = ("seen", "earned", "_returns")

    def __init__(self, observations: Floats, seeds: int, gamma: float) -> None:
        self.seen = RunningMoments(seeds, observations.shape[1])
        self.earned = RunningMoments(seeds)
        self._gamma = gamma
        self._returns = np.zeros((seeds, len(observations) // seeds))
        self.seen.update(self._by_seed(observations))

    def update(self, observations: Floats, rewards: Floats) -> None:
        """Add one step of every environment to both moments.

        Args:
            observations: (S·K, obs) that the step led to; first ones where an episode is over.
            rewards: (S·K,) of the step.
        """
        self.seen.update(self._by_seed(observations))
        self._returns *= self._gamma
        self._returns += self._by_seed(rewards)
        self.earned.update(self._returns)

    def end(self, over: NDArray[np.bool_]) -> None:
        """Begin new returns where an episode is over, (S·K,)."""
        self._returns[self._by_seed(over)] = 0

    def observations(self, observations: Floats) -> Floats:
        """Normalize observations (S·K, obs) by the moments so far."""
        centered = self._by_seed(observations) - self.seen.mean[:, None]
        normalized = centered / self.seen.deviation[:, None]
        return self._flat(normalized, observations)

    def rewards(self, rewards: Floats) -> Floats:
        """Normalize rewards (S·K,) by the moments so far."""
        return self._flat(self._by_seed(rewards) / self.earned.deviation[:, None], rewards)

    def _by_seed(self, array: NDArray[Any]) -> NDArray[Any]:
        """Turn (S·K, …) into (S, K, …)."""
        return array.reshape(*self._returns.shape, *array.shape[1:])

    @staticmethod
    def _flat(normalized: NDArray[np.float64], like: Floats) -> Floats:
        """Clip (S, K, …), and turn it into single precision and (S·K, …)."""
        clipped: Floats = normalized.clip(-CLIP, CLIP).astype(np.float32).reshape(like.shape)
        return clipped
