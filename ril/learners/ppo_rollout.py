"""Rollouts of PPO: steps of actor-critics whose actions are drawn from their policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.environments.environment import Floats
from ril.learners.exploration import sample_softmax
from ril.learners.normalization import Normalization
from ril.vectorized.architectures import ActorCritic
from ril.vectorized.compiling import compile_graph, is_tracing, pad_rows, with_fallback
from ril.vectorized.networks import by_name
from ril.vectorized.stepping import SteppedEnvironments

#: From observations (S·K, obs) as the agents see them and random numbers (S, K) in [0, 1) to
#: actions (S·K,), their log-probabilities, and the states' values.
Act = Callable[[Floats, Tensor], tuple[NDArray[np.int64], Floats, Floats]]


class Rollout(NamedTuple):
    """T steps in S·K environments."""

    observations: Floats  # (T, S·K, obs), as the agents see them
    actions: NDArray[np.int64]  # (T, S·K)
    log_probs: Floats  # (T, S·K) log-probabilities of the actions
    values: Floats  # (T, S·K)
    rewards: Floats  # (T, S·K), normalized if rewards are
    terminated: NDArray[np.bool_]  # (T, S·K)
    truncated: NDArray[np.bool_]  # (T, S·K)
    next_values: Floats  # (T, S·K); of the final state where an episode was truncated


def collect_rollout(
    environments: SteppedEnvironments,
    act: Act,
    uniform: Tensor,
    seen: Callable[[Floats], Floats],
    normalization: Normalization | None,
) -> Rollout:
    """Take T steps in each of S·K environments, from the states that they are in.

    Args:
        environments: S·K environments.
        act: draws the actions.
        uniform: (T, S, K) random numbers in [0, 1).
        seen: maps scaled observations (S·K, obs) to those that the agents see.
        normalization: is updated by each step, and normalizes its rewards; None keeps rewards.
    """
    observations = seen(environments.observations)
    steps = []
    final_values = {}  # of the steps in which the step limit truncated an episode
    for t, numbers in enumerate(uniform.unbind()):
        actions, log_probs, values = act(observations, numbers)
        step = environments.step(actions)
        following, rewards = environments.observations, step.rewards
        if normalization is not None:
            normalization.update(following, rewards)
            rewards = normalization.rewards(rewards)
            normalization.end(step.terminated | step.truncated)
        following = seen(following)
        if step.truncated.any():
            final = seen(step.next_observations)
            final_values[t] = act(final, numbers)[2]
        ends = step.terminated, step.truncated
        steps.append((observations, actions, log_probs, values, rewards, *ends))
        observations = following
    played = [np.stack(column) for column in zip(*steps, strict=True)]
    values, truncated = played[3], played[6]
    last = act(observations, numbers)[2]
    next_values = np.concatenate((values[1:], last[None]))
    for t, of_final in final_values.items():
        next_values[t] = np.where(truncated[t], of_final, next_values[t])
    return Rollout._make((*played, next_values))


def acting(architecture: ActorCritic, flat: Tensor, *, compiled: bool) -> Act:
    """Make the function that draws actions from the policies and evaluates the states.

    Args:
        architecture: of the S networks.
        flat: (S, P) their parameters, read at each call.
        compiled: whether drawing and evaluating are one compiled graph. Its outputs differ from
            the eager ones in the last bits.
    """

    def decide(
        flat: Tensor, observations: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        parameters = by_name(architecture, flat)
        copies = observations.shape[1]
        if is_tracing():
            observations, uniform = pad_rows(observations), pad_rows(uniform)
        log_probs = architecture.forward(parameters, observations).log_softmax(dim=-1)
        actions = sample_softmax(log_probs, uniform)
        log_prob = log_probs.gather(-1, actions[..., None]).squeeze(-1)
        values = architecture.values(parameters, observations)
        return actions[:, :copies], log_prob[:, :copies], values[:, :copies]

    answer = with_fallback(compile_graph(decide), decide) if compiled else decide

    @torch.no_grad()
    def act(observations: Floats, uniform: Tensor) -> tuple[NDArray[np.int64], Floats, Floats]:
        by_seed = torch.from_numpy(observations).to(flat.device)
        by_seed = by_seed.view(len(flat), -1, observations.shape[-1])
        answers = answer(flat, by_seed, uniform)
        actions, log_probs, values = (each.flatten().cpu().numpy() for each in answers)
        return actions, log_probs, values

    return act
