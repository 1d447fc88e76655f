"""The goal of an environment: which episodes succeed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ril.config.schema import GoalConfig


def reaches_goal(
    goal: GoalConfig,
    *,
    returns: NDArray[np.floating],
    final_rewards: NDArray[np.floating],
    terminated: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return which episodes reach the environment's goal (§3.2).

    Args:
        goal: conditions, all of which an episode must meet.
        returns: (...) undiscounted returns of episodes.
        final_rewards: (...) rewards of their last steps.
        terminated: (...) whether the environment ended them, not the step limit.

    Returns:
        (...) whether each episode meets every condition that is set.
    """
    reached = np.ones(np.shape(returns), dtype=bool)
    if goal.minimum_return is not None:
        reached &= returns >= goal.minimum_return
    if goal.minimum_final_reward is not None:
        reached &= final_rewards >= goal.minimum_final_reward
    if goal.terminated is not None:
        reached &= terminated == goal.terminated
    return reached
