"""The goal sampler: the share of I^s that comes from the policy's own successes (§3.4, eq. 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import one_of
from ril.vectorized.replay import Batch, Replay


@dataclass
class GoalSamplerConfig:
    """The composition of I^s (Alg. 1, line 14)."""

    pre_steps_per_action: int = MISSING
    memory: str = one_of("run", "epoch", "none")
    upper_limit: bool = MISSING
    keep_pre: bool = MISSING


def positive_limit(epoch: float, n: float, k: float) -> float:
    """Compute the upper limit on the share of I^pos in I^s (eq. 2; docs/deviations.md, D12).

    Equation 2 is 1 − 1 / (1 + (n/e − 1)^(−k)), which is 0/0 or complex outside 0 < e < n. There
    it is replaced by its limits: 0 at e = 0, and 1 from e = n on.

    Args:
        epoch: e ≥ 0.
        n: epoch from which the limit is 1; n > 0.
        k: slope of the curve; k > 0.

    Returns:
        A share in [0, 1], which does not decrease with e.
    """
    if epoch <= 0:
        return 0.0
    if epoch >= n:
        return 1.0
    # (n/e − 1)^(−k), or its inverse where it is above 1, so that no power overflows.
    odds = epoch / (n - epoch)
    if odds <= 1:
        return math.pow(odds, k) / (1 + math.pow(odds, k))
    return 1 / (1 + math.pow(odds, -k))


class Selection(NamedTuple):
    """I^s: the transitions that the inverse dynamics model is trained on, padded per seed."""

    transitions: Batch  # (S, N, …)
    sizes: NDArray[np.int64]  # (S,) how many of the N are in I^s


def choose_per_action(
    memory: Replay, share: NDArray[np.float64], action_count: int, uniform: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Choose a share of each action's transitions at random, without replacement.

    Args:
        memory: the transitions to choose from.
        share: (S,) share of each action's transitions, in [0, 1]; their number is rounded up.
        action_count: |A|.
        uniform: (S, capacity) random numbers in [0, 1), which decide the choice.

    Returns:
        (S, capacity) true where a slot is chosen.
    """
    actions = memory.actions.cpu().numpy()
    chosen = np.zeros(actions.shape, dtype=bool)
    for seed, size in enumerate(memory.sizes.tolist()):
        for action in range(action_count):
            slots = np.flatnonzero(actions[seed, :size] == action)
            quota = math.ceil(share[seed] * len(slots))
            if quota:
                chosen[seed, _lowest(slots, uniform[seed, slots], quota)] = True
    return chosen


def _lowest(
    slots: NDArray[np.int64], numbers: NDArray[np.float32], quota: int
) -> NDArray[np.int64]:
    """Return the `quota` ≥ 1 slots with the lowest numbers; of equal ones, the first."""
    # Selection needs a tenth of a sort's time; NumPy's order of equal numbers depends on the
    # processor.
    highest = np.partition(numbers, quota - 1)[quota - 1]
    below = slots[numbers < highest]
    equal = slots[numbers == highest]
    return np.concatenate((below, equal[: quota - len(below)]))


def select(
    pre: Replay,
    pos: Replay,
    share: NDArray[np.float64],
    action_count: int,
    uniform: NDArray[np.float32],
    *,
    keep_pre: bool,
) -> Selection:
    """Select I^s from I^pre and I^pos (Algorithm 1, line 14).

    Of each action, I^s has a `share` of the transitions of I^pos, and all or 1 − `share` of those
    of I^pre.

    Args:
        pre: I^pre, the random policy's transitions.
        pos: I^pos, transitions of episodes that reached the goal.
        share: (S,) share of I^pos, in [0, 1]; counts as 0 for seeds whose I^pos is empty.
        action_count: |A|.
        uniform: (S, capacity of pre + capacity of pos) random numbers in [0, 1).
        keep_pre: whether I^s has all of I^pre, for every share.

    Returns:
        I^s of each seed.
    """
    share = np.where(pos.sizes > 0, share, 0.0)
    share_of_pre = np.ones_like(share) if keep_pre else 1 - share
    chosen = np.concatenate(
        (
            choose_per_action(pre, share_of_pre, action_count, uniform[:, : pre.capacity]),
            choose_per_action(pos, share, action_count, uniform[:, pre.capacity :]),
        ),
        axis=1,
    )
    sizes = chosen.sum(axis=1)
    packed = np.zeros((len(sizes), sizes.max()), dtype=np.int64)
    for row, of_seed, size in zip(packed, chosen, sizes, strict=True):
        row[:size] = np.flatnonzero(of_seed)
    indices = torch.from_numpy(packed).to(pre.actions.device)
    both = zip(pre.everything(), pos.everything(), strict=True)
    return Selection(Batch(*(torch.cat(fields, dim=1) for fields in both)).at(indices), sizes)
