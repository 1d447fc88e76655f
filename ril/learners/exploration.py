"""Exploration: ε-greedy episodes, with the policy's own uncertainty as ε (§3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.config.fields import one_of, within
from ril.environments.environment import Floats, Integers
from ril.task import Task
from ril.vectorized.networks import Network, greedy
from ril.vectorized.rollout import Environments, Episodes
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


@dataclass
class ExplorationConfig:
    """ε, and the distribution of exploring actions (§3.4)."""

    epsilon: float | None = within(0, 1)
    kind: str = one_of("softmax", "uniform")


def sample_softmax(logits: Tensor, uniform: Tensor) -> Tensor:
    """Sample actions from softmax(logits) by inverting its distribution function.

    Args:
        logits: (…, |A|).
        uniform: (…) random numbers in [0, 1).

    Returns:
        (…) actions.
    """
    below = logits.softmax(dim=-1).cumsum(dim=-1) <= uniform[..., None]
    return below.sum(dim=-1).clamp(max=logits.shape[-1] - 1)


def epsilon_greedy(logits: Tensor, epsilon: Tensor, uniform: Tensor, kind: str) -> Tensor:
    """Choose ε-greedy actions (§3.4).

    Args:
        logits: (S, N, |A|).
        epsilon: (S,) probability to explore instead of choosing the argmax.
        uniform: (2, S, N) random numbers in [0, 1): whether to explore, and by which action.
        kind: distribution of exploring actions: "softmax" of the logits, or "uniform".

    Returns:
        (S, N) actions.
    """
    if kind == "softmax":
        other = sample_softmax(logits, uniform[1])
    else:
        other = (uniform[1] * logits.shape[-1]).long()
    return torch.where(uniform[0] < epsilon[:, None], other, logits.argmax(dim=-1))


def exploration_ratio(logits: Tensor, uniform: NDArray[np.float32]) -> NDArray[np.float64]:
    """Measure how often an action sampled from the policy differs from its greedy one (§3.4).

    Args:
        logits: (S, M, |A|) of the policy in the expert's states.
        uniform: (S, M) random numbers in [0, 1).

    Returns:
        (S,) share of sampled actions that are not the argmax.
    """
    sampled = sample_softmax(logits, torch.from_numpy(uniform).to(logits.device))
    ratio: NDArray[np.float64] = (
        (sampled != logits.argmax(dim=-1)).double().mean(dim=1).cpu().numpy()
    )
    return ratio


class Explorer(Stateful):
    """Plays ε-greedy episodes (Alg. 1, line 11).

    The state is that of the random streams; between calls no episode is under way.

    Args:
        config: `method.exploration`.
        task: environment and seeds.
        policy: the policy that acts.
        episodes: number of episodes that each seed plays side by side. The random numbers are the
            same as for playing them one after another.
    """

    STATE: ClassVar = ("_streams",)

    def __init__(
        self, config: ExplorationConfig, task: Task, policy: Network, episodes: int = 1
    ) -> None:
        self.kind = config.kind
        self.policy = policy
        self.episodes = episodes
        self._device = task.device
        self._environments = Environments(task.environment, len(task.seeds) * episodes)
        self._max_steps = task.environment.max_episode_steps
        self._streams = {
            purpose: Streams(task.seeds, purpose) for purpose in ("resets", "exploration")
        }

    def play(self, epsilon: NDArray[np.float64]) -> Episodes:
        """Play `episodes` episodes of each seed.

        Args:
            epsilon: (S,) probability to explore at each step.

        Returns:
            S·episodes episodes, those of one seed side by side.
        """
        resets, exploration = self._streams["resets"], self._streams["exploration"]
        each = range(self.episodes)
        starts = np.stack([resets.integers(2**31) for _ in each], axis=1)
        drawn = np.stack([exploration.uniform(self._max_steps, 2) for _ in each], axis=-1)
        uniform = torch.from_numpy(drawn).to(self._device)  # (S, T, 2, episodes)
        probability = torch.from_numpy(epsilon).to(self._device)

        infer = self.policy.frozen()
        exploring = np.any(drawn[:, :, 0] < epsilon[:, None, None], axis=(0, 2)).tolist()

        def act(observations: Floats, step: int) -> Integers:
            logits = infer(observations)
            if not exploring[step]:
                return greedy(logits)
            numbers = uniform[:, step].transpose(0, 1)
            chosen = epsilon_greedy(logits, probability, numbers, self.kind)
            return chosen.flatten().cpu().numpy()

        return self._environments.play(act, starts.ravel())
