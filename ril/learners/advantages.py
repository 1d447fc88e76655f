"""How much better an action was than the policy's average one, from a piece of a rollout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ril.environments import Floats


def generalised_advantages(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Advantages of T steps in N environments (Schulman et al., 2016, eq. 16).

    With λ = 1, advantages plus values are n-step returns: all rewards up to the end of the
    rollout, and the value of the state that it ended in.

    Args:
        rewards: (T, N).
        values: (T, N) of the states acted in.
        next_values: (T, N) of those that followed; of an episode's end, its final state.
        terminated: (T, N) whether the environment ended the episode: nothing follows.
        truncated: (T, N) whether the step limit cut it: its final state's value follows.
        gamma: γ, the discount.
        gae_lambda: λ.

    Returns:
        (T, N).
    """
    errors = rewards + gamma * next_values * ~terminated - values  # δ of temporal differences
    goes_on = gamma * gae_lambda * ~(terminated | truncated)
    advantages = np.zeros_like(errors)
    following = np.zeros_like(errors[0])
    for step in reversed(range(len(errors))):
        following = errors[step] + goes_on[step] * following
        advantages[step] = following
    return advantages
