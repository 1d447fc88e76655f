"""How the policy explores: by its own uncertainty (§3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.config.fields import one_of, within
from ril.environments import Floats, Integers
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.rollout import Environments, Episodes
from ril.vectorized.streams import Streams


@dataclass
class ExplorationConfig:
    """ε and what exploring means (§3.4)."""

    epsilon: float | None = within(0, 1)
    kind: str = one_of("softmax", "uniform")


def sample_softmax(logits: Tensor, uniform: Tensor) -> Tensor:
    """Draw from softmax(logits) by inverting its distribution function.

    Args:
        logits: (..., |A|).
        uniform: (...) random numbers in [0, 1).

    Returns:
        (...) actions.
    """
    below = logits.softmax(dim=-1).cumsum(dim=-1) <= uniform[..., None]
    return below.sum(dim=-1).clamp(max=logits.shape[-1] - 1)


def explore(logits: Tensor, epsilon: Tensor, uniform: Tensor, kind: str) -> Tensor:
    """ε-greedy actions (§3.4).

    Args:
        logits: (S, N, |A|).
        epsilon: (S,) chance to explore instead of taking the argmax.
        uniform: (2, S, N) random numbers in [0, 1): whether to explore, and with what.
        kind: "softmax" explores with an action of softmax(logits), "uniform" with any.

    Returns:
        (S, N) actions.
    """
    if kind == "softmax":
        other = sample_softmax(logits, uniform[1])
    else:
        other = (uniform[1] * logits.shape[-1]).long()
    return torch.where(uniform[0] < epsilon[:, None], other, logits.argmax(dim=-1))


def exploration_ratio(logits: Tensor, uniform: NDArray[np.float32]) -> NDArray[np.float64]:
    """How often sampling from the policy departs from its greedy action (§3.4).

    Args:
        logits: (S, M, |A|) at the expert's states.
        uniform: (S, M) random numbers in [0, 1).

    Returns:
        (S,) share of samples whose action is not the argmax.
    """
    sampled = sample_softmax(logits, torch.from_numpy(uniform).to(logits.device))
    ratio: NDArray[np.float64] = (
        (sampled != logits.argmax(dim=-1)).double().mean(dim=1).cpu().numpy()
    )
    return ratio


class Explorer:
    """Plays ε-greedy episodes (Alg. 1, line 11).

    Args:
        config: `method.exploration`.
        task: environment and seeds.
        policy: that acts.
        episodes: of each seed that are played side by side; as many one by one draw the same
            random numbers.
    """

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
        """(S·episodes), exploring with the chance epsilon (S,) at each step."""
        resets, exploration = self._streams["resets"], self._streams["exploration"]
        each = range(self.episodes)
        starts = np.stack([resets.integers(2**31) for _ in each], axis=1)
        drawn = np.stack([exploration.uniform(self._max_steps, 2) for _ in each], axis=-1)
        uniform = torch.from_numpy(drawn).to(self._device)  # (S, T, 2, episodes)
        chance = torch.from_numpy(epsilon).to(self._device)

        def act(observations: Floats, step: int) -> Integers:
            numbers = uniform[:, step].transpose(0, 1)
            chosen = explore(self.policy.infer(observations), chance, numbers, self.kind)
            return chosen.flatten().cpu().numpy()

        return self._environments.play(act, starts.ravel())

    def state_dict(self) -> dict[str, Any]:
        """Random streams; episodes are whole between calls."""
        return {purpose: streams.state_dict() for purpose, streams in self._streams.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        for purpose, streams in self._streams.items():
            streams.load_state_dict(state[purpose])
