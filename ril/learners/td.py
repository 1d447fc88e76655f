"""Temporal differences (eq. 1): targets, errors and losses, as pure functions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ril.vectorized.replay import Batch
from ril.vectorized.rollout import Episodes


def td_targets(
    batch: Batch, next_values: Tensor, discount: float, selection_values: Tensor | None = None
) -> Tensor:
    """Compute R_{t+1} + γ max_a Q(S_{t+1}, a), without the second term at terminal states (eq. 1).

    Args:
        batch: B transitions per seed.
        next_values: (S, B, |A|) Q(S_{t+1}, ·).
        discount: γ, or γ^n after n steps.
        selection_values: (S, B, |A|) values whose argmax is the next action, for double
            Q-learning (van Hasselt et al., 2016); `next_values` if None.

    Returns:
        (S, B).
    """
    if selection_values is None:
        best = next_values.amax(dim=-1)
    else:
        best = action_values(next_values, selection_values.argmax(dim=-1))
    return batch.rewards + discount * (1 - batch.terminated) * best


def n_step(
    episodes: Episodes,
    steps: int,
    discount: float,
    reward_scale: NDArray[np.floating] | None = None,
) -> Episodes:
    """Replace one-step transitions by n-step ones: (s_t, a_t, Σ_{i<n} γ^i r_{t+i}, s_{t+n}).

    Where the environment ends the episode in fewer than n steps, a transition ends there too.
    Where the step limit truncates it, these transitions are dropped: their next rewards are
    unknown.

    Args:
        episodes: K episodes of one-step transitions.
        steps: n.
        discount: γ.
        reward_scale: (K,) divisors of the rewards; 1 if None.

    Returns:
        K episodes of n-step transitions.
    """
    length = episodes.rewards.shape[1]
    rewards = np.zeros_like(episodes.rewards)
    for ahead in range(min(steps, length)):
        rewards[:, : length - ahead] += discount**ahead * episodes.rewards[:, ahead:]
    if reward_scale is not None:
        rewards /= reward_scale[:, None]
    last = np.minimum(np.arange(length) + steps, episodes.lengths[:, None]) - 1
    rows = np.arange(len(last))[:, None]
    kept = np.where(episodes.ends, episodes.lengths, episodes.lengths - steps + 1)
    return Episodes(
        episodes.observations,
        episodes.actions,
        rewards,
        episodes.next_observations[rows, last],
        episodes.terminated[rows, last],
        np.maximum(kept, 0),
    )


def action_values(values: Tensor, actions: Tensor) -> Tensor:
    """Select from values (S, B, |A|) those of actions (S, B)."""
    return values.gather(-1, actions[..., None]).squeeze(-1)


def td_losses(errors: Tensor, loss: str) -> Tensor:
    """Compute the elementwise losses of errors (…): "huber", with threshold 1, or "mse"."""
    distance = functional.smooth_l1_loss if loss == "huber" else functional.mse_loss
    return distance(errors, torch.zeros_like(errors), reduction="none")


def td_errors(
    policy: Callable[[Tensor], Tensor],
    target: Callable[[Tensor], Tensor],
    batch: Batch,
    discount: float,
    *,
    double: bool,
) -> Tensor:
    """Compute the temporal differences δ of eq. 1; only Q(S_t, A_t) receives a gradient.

    Args:
        policy: maps observations (S, B, obs) to values (S, B, |A|).
        target: likewise; its values are those of S_{t+1}.
        batch: B transitions per seed.
        discount: γ.
        double: whether the policy instead of the target chooses the next action.

    Returns:
        (S, B).
    """
    with torch.no_grad():
        selection_values = policy(batch.next_observations) if double else None
        next_values = target(batch.next_observations)
        targets = td_targets(batch, next_values, discount, selection_values)
    return action_values(policy(batch.observations), batch.actions) - targets
