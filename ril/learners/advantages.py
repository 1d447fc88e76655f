"""Generalized advantage estimation (Schulman et al., 2016)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Floats


def generalized_advantages(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Estimate the advantages of T steps in N environments (Schulman et al., 2016, eq. 16).

    With λ = 1, advantages plus values are n-step returns: the rewards up to the end of the
    rollout, and the value of the rollout's last state.

    Args:
        rewards: (T, N).
        values: (T, N) V(s_t).
        next_values: (T, N) V(s_{t+1}), of the final state where an episode is over.
        terminated: (T, N) whether the environment ended the episode, so that s_{t+1} is worth 0.
        truncated: (T, N) whether the step limit truncated it, so that V(s_{t+1}) counts.
        gamma: γ, the discount.
        gae_lambda: λ.

    Returns:
        (T, N).
    """
    errors = rewards + gamma * next_values * ~terminated - values  # δ
    decay = gamma * gae_lambda * ~(terminated | truncated)
    advantages = np.zeros_like(errors)
    advantage = np.zeros_like(errors[0])
    for step in reversed(range(len(errors))):
        advantage = errors[step] + decay[step] * advantage
        advantages[step] = advantage
    return advantages
