"""Temporal differences (eq. 1): targets, errors and losses as pure functions of tensors."""

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
    batch: Batch, next_values: Tensor, discount: float, choosing: Tensor | None = None
) -> Tensor:
    """R_{t+1} + γ max_a Q(S_{t+1}, a), without the second term at terminal states (eq. 1).

    Args:
        batch: B transitions per seed.
        next_values: (S, B, |A|) Q(S_{t+1}, ·).
        discount: γ, or γ^n after n steps.
        choosing: (S, B, |A|) values whose largest says which action's `next_values` count, as
            double Q-learning has it (van Hasselt et al., 2016); `next_values` themselves if None.

    Returns:
        (S, B).
    """
    if choosing is None:
        best = next_values.amax(dim=-1)
    else:
        best = taken(next_values, choosing.argmax(dim=-1))
    return batch.rewards + discount * (1 - batch.terminated) * best


def n_step(
    episodes: Episodes, steps: int, discount: float, unit: NDArray[np.floating] | None = None
) -> Episodes:
    """Episodes whose transitions go over n steps: (s_t, a_t, Σ_{i<n} γ^i r_{t+i}, s_{t+n}).

    Those that the environment's end leaves fewer steps for end there; those that a cut does are
    left out, since what would have followed is not known.

    Args:
        episodes: K of them.
        steps: n.
        discount: γ.
        unit: (K,) by which rewards are divided; 1 if None.
    """
    length = episodes.rewards.shape[1]
    rewards = np.zeros_like(episodes.rewards)
    for ahead in range(min(steps, length)):
        rewards[:, : length - ahead] += discount**ahead * episodes.rewards[:, ahead:]
    if unit is not None:
        rewards /= unit[:, None]
    last = np.minimum(np.arange(length) + steps, episodes.lengths[:, None]) - 1
    rows = np.arange(len(last))[:, None]
    whole = np.where(episodes.ends, episodes.lengths, episodes.lengths - steps + 1)
    return Episodes(
        episodes.observations,
        episodes.actions,
        rewards,
        episodes.next_observations[rows, last],
        episodes.terminated[rows, last],
        np.maximum(whole, 0),
    )


def taken(values: Tensor, actions: Tensor) -> Tensor:
    """Of values (S, B, |A|), those of actions (S, B)."""
    return values.gather(-1, actions[..., None]).squeeze(-1)


def td_losses(errors: Tensor, loss: str) -> Tensor:
    """Losses of temporal differences, element by element; "huber" (threshold 1) or "mse"."""
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
    """(S, B) temporal differences δ of eq. 1, whose gradient is Q(S_t, A_t)'s alone.

    Args:
        policy: observations (S, B, obs) to values (S, B, |A|).
        target: the same, for the values of S_{t+1}.
        batch: B transitions per seed.
        discount: γ.
        double: whether the policy chooses the action that the target says the value of.
    """
    with torch.no_grad():
        choosing = policy(batch.next_observations) if double else None
        targets = td_targets(batch, target(batch.next_observations), discount, choosing)
    return taken(policy(batch.observations), batch.actions) - targets
