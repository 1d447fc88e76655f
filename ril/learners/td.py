"""Temporal differences (eq. 1): targets, errors and losses as pure functions of tensors."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from ril.vectorized.replay import Batch


def td_targets(
    batch: Batch, next_values: Tensor, discount: float, choosing: Tensor | None = None
) -> Tensor:
    """R_{t+1} + γ max_a Q(S_{t+1}, a), without the second term at terminal states (eq. 1).

    Args:
        batch: B transitions per seed.
        next_values: (S, B, |A|) Q(S_{t+1}, ·).
        discount: γ.
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
