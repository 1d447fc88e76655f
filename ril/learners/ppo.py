"""Proximal Policy Optimization (Schulman et al., 2017), with the semantics of Stable-Baselines3."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import at_least, within
from ril.environments import Floats
from ril.io.errors import UserError
from ril.learners.advantages import generalized_advantages
from ril.learners.exploration import sample_softmax
from ril.learners.normalization import CLIP, Normalization, RunningMoments, Standardization
from ril.learners.topology import tanh_mlp
from ril.task import Task
from ril.vectorized.compiling import (
    LEAST_ROWS,
    compile_graph,
    is_tracing,
    with_fallback,
    worth_compiling,
)
from ril.vectorized.descent import descent
from ril.vectorized.networks import (
    ActorCritic,
    Architecture,
    Network,
    Parameters,
    Standardized,
    by_name,
    parameter_count,
)
from ril.vectorized.state import Stateful
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class PPOConfig:
    """Stable-Baselines3's names; `hidden` applies to policy and value function each."""

    hidden: list[int] = MISSING
    n_envs: int = MISSING
    n_steps: int = MISSING
    batch_size: int = MISSING
    n_epochs: int = MISSING
    learning_rate: float = MISSING
    gamma: float = within(0, 1)
    gae_lambda: float = within(0, 1)
    clip_range: float = MISSING
    ent_coef: float = at_least(0)
    vf_coef: float = at_least(0)
    max_grad_norm: float = MISSING


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


class PPOLearner(Stateful):
    """S agents, each a policy and a value function in K environments of its own.

    Args:
        config: hyperparameters.
        task: environment and seeds.
        total_timesteps: environment steps of each seed, rounded up to whole rollouts.
        normalize: whether to normalize observations and rewards by their running moments.
        standardize: standardizes observations by fixed moments; not with `normalize`.
        linear_schedule: whether learning rate and clip range fall linearly to 0 over
            `total_timesteps`.

    Attributes:
        networks: policies and value functions, for observations as the agents see them.
        policy: the policies alone, for scaled observations.
        rollout_steps: N, steps of each seed in a rollout.
        rollouts: number of rollouts in `total_timesteps`.
        steps: steps of each seed so far.
        compiled: whether acting and updates are compiled.

    Raises:
        UserError: minibatches do not fit a rollout, or the budget is below one rollout.
    """

    STATE: ClassVar = (
        "steps",
        "networks",
        "policy",
        "_optimizer",
        "_environments",
        "_normalization",
        "_sampling",
        "_shuffling",
    )

    def __init__(
        self,
        config: PPOConfig,
        task: Task,
        total_timesteps: int,
        *,
        normalize: bool = False,
        standardize: Standardization | None = None,
        linear_schedule: bool = False,
    ) -> None:
        environment, seeds = task.environment, task.seeds
        self.config = config
        self.rollout_steps = config.n_envs * config.n_steps
        _check_steps(config, self.rollout_steps, total_timesteps)
        self.rollouts = math.ceil(total_timesteps / self.rollout_steps)
        self.steps = 0
        self._total_timesteps = total_timesteps
        self._linear_schedule = linear_schedule
        self._seeds, self._device = len(seeds), task.device
        self._size, self._actions = environment.observation_size, environment.action_count
        actor = tanh_mlp(self._size, config.hidden, self._actions)
        self._architecture = ActorCritic(actor, tanh_mlp(self._size, config.hidden, 1))
        self.networks = orthogonal(self._architecture, seeds, "ppo", task.device)
        self._environments = SteppedEnvironments(environment, seeds, config.n_envs, "ppo")
        self._normalization = None
        self._standardize = standardize
        if normalize:
            first = self._environments.observations
            self._normalization = Normalization(first, len(seeds), config.gamma)
        sees_otherwise = normalize or standardize is not None
        architecture: Architecture = Standardized(actor, CLIP) if sees_otherwise else actor
        flat = torch.empty(len(seeds), parameter_count(architecture), device=task.device)
        self.policy = Network(architecture, flat)
        self._update_policy()
        self._optimizer = ClippedAdam(
            self.networks, config.learning_rate, epsilon=1e-5, max_norm=config.max_grad_norm
        )
        minibatches = config.n_epochs * self.rollout_steps // config.batch_size
        worthwhile = worth_compiling(task.compile, self.rollouts * minibatches)
        self.compiled = worthwhile and config.batch_size >= LEAST_ROWS
        self._descend = descent(self._optimizer, self._loss, compile_step=self.compiled)
        self._act = self._decide
        if self.compiled:
            self._act = with_fallback(compile_graph(self._decide), self._decide)
        self._sampling = Streams(seeds, "actions")
        self._shuffling = Streams(seeds, "minibatches")
        self._rollout: Rollout | None = None

    def collect(self) -> tuple[Tensor, Tensor]:
        """Play T = n_steps steps in each of the K copies, with actions drawn from the policy.

        Returns:
            (S, N, obs) observations as the agents see them, and (S, N) the actions in them.
        """
        uniform = torch.from_numpy(self._sampling.uniform(self.config.n_steps, self.config.n_envs))
        by_step = uniform.to(self._device).transpose(0, 1).contiguous()
        observations = self._seen(self._environments.observations)
        steps = []
        final_values = {}  # of the steps in which the step limit truncated an episode
        for t, numbers in enumerate(by_step.unbind()):
            actions, log_probs, values = self._answers(observations, numbers)
            step = self._environments.step(actions)
            following, rewards = self._environments.observations, step.rewards
            if self._normalization is not None:
                self._normalization.update(following, rewards)
                rewards = self._normalization.rewards(rewards)
                self._normalization.end(step.terminated | step.truncated)
            following = self._seen(following)
            if step.truncated.any():
                final = self._seen(step.next_observations)
                final_values[t] = self._answers(final, numbers)[2]
            ends = step.terminated, step.truncated
            steps.append((observations, actions, log_probs, values, rewards, *ends))
            observations = following
        played = [np.stack(column) for column in zip(*steps, strict=True)]
        values, truncated = played[3], played[6]
        last = self._answers(observations, numbers)[2]
        next_values = np.concatenate((values[1:], last[None]))
        for t, of_final in final_values.items():
            next_values[t] = np.where(truncated[t], of_final, next_values[t])
        self._rollout = Rollout._make((*played, next_values))
        self.steps += self.rollout_steps
        return self._by_seed(self._rollout.observations), self._by_seed(self._rollout.actions)

    def _seen(self, observations: Floats) -> Floats:
        """Return scaled observations (S·K, obs) as the agents see them."""
        if self._normalization is not None:
            return self._normalization.observations(observations)
        return observations if self._standardize is None else self._standardize(observations)

    def _answers(
        self, observations: Floats, uniform: Tensor
    ) -> tuple[NDArray[np.int64], Floats, Floats]:
        """Return (S·K,) actions in observations (S·K, obs), their log-probabilities, and values."""
        by_seed = torch.from_numpy(observations).to(self._device)
        by_seed = by_seed.view(self._seeds, -1, self._size)
        with torch.no_grad():
            answers = self._act(self.networks.flat, by_seed, uniform)
        actions, log_probs, values = (each.flatten().cpu().numpy() for each in answers)
        return actions, log_probs, values

    def _decide(
        self, flat: Tensor, observations: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw actions, and evaluate the states.

        Args:
            flat: (S, P) parameters of `networks`.
            observations: (S, K, obs) as the agents see them.
            uniform: (S, K) random numbers in [0, 1).

        Returns:
            (S, K) actions, their log-probabilities, and the states' values.
        """
        parameters = by_name(self._architecture, flat)
        copies = observations.shape[1]
        if is_tracing():
            padding = max(0, LEAST_ROWS - copies)
            observations = functional.pad(observations, (0, 0, 0, padding))
            uniform = functional.pad(uniform, (0, padding))
        log_probs = self._architecture.forward(parameters, observations).log_softmax(dim=-1)
        actions = sample_softmax(log_probs, uniform)
        log_prob = log_probs.gather(-1, actions[..., None]).squeeze(-1)
        values = self._architecture.values(parameters, observations)
        return actions[:, :copies], log_prob[:, :copies], values[:, :copies]

    def improve(self, rewards: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Update policies and value functions on the last rollout.

        Args:
            rewards: (S, N) rewards of the pairs from `collect`; None for the environment's.

        Returns:
            Diagnostics by name, (S,) each: means over the minibatches' samples, of the last epoch
            for the divergence.
        """
        config, rollout = self.config, self._rollout
        assert rollout is not None
        if rewards is not None:
            rollout = rollout._replace(rewards=self._by_step(rewards))
        samples = self._samples(rollout)
        remaining = 1.0
        if self._linear_schedule:
            # At least 0, because the last rollout may exceed the budget (docs/methods/ppo.md, P4).
            remaining = max(0.0, 1.0 - self.steps / self._total_timesteps)
        self._optimizer.learning_rate = remaining * config.learning_rate
        clip_range = torch.tensor(remaining * config.clip_range, device=self._device)
        rows = self._minibatches()
        advantages = _standardized(samples[:, -2][rows])
        measured = [
            self._descend(samples, *minibatch, clip_range)[1:]
            for minibatch in zip(rows, advantages, strict=True)
        ]
        entropy, value_loss, divergence = zip(*measured, strict=True)
        of_last_epoch = divergence[-(len(divergence) // config.n_epochs) :]
        self._update_policy()
        return {
            name: torch.cat(parts, dim=1).mean(dim=1).double().cpu().numpy()
            for name, parts in (
                ("entropy", entropy),
                ("value_loss", value_loss),
                ("approximate_kl", of_last_epoch),
            )
        }

    def _samples(self, rollout: Rollout) -> Tensor:
        """Return what a rollout's updates need, with the N samples of a seed side by side.

        Returns:
            (S·N, obs + |A| + 3) observation, one-hot action, the action's log-probability under the
            policy that took it, advantage, and return.
        """
        config = self.config
        advantages = generalized_advantages(
            rollout.rewards,
            rollout.values,
            rollout.next_values,
            rollout.terminated,
            rollout.truncated,
            config.gamma,
            config.gae_lambda,
        )
        numbers = np.stack((rollout.log_probs, advantages, rollout.values + advantages), axis=-1)
        one_hot = np.eye(self._actions, dtype=np.float32)[rollout.actions]
        rows = np.concatenate((rollout.observations, one_hot, numbers), axis=-1)
        return self._by_seed(rows).flatten(0, 1)

    def _minibatches(self) -> Tensor:
        """Draw a permutation of each seed's samples per epoch, and divide it into minibatches.

        Returns:
            (M, S, B) the rows of `_samples` in each of M minibatches.
        """
        drawn = self._shuffling.permutations(self.config.n_epochs, self.rollout_steps)
        firsts = np.arange(self._seeds)[:, None, None] * self.rollout_steps
        rows = (drawn + firsts).reshape(self._seeds, -1, self.config.batch_size)
        by_minibatch = np.ascontiguousarray(rows.swapaxes(0, 1))
        return torch.from_numpy(by_minibatch).to(self._device)

    def _loss(
        self,
        parameters: Parameters,
        samples: Tensor,
        minibatch: Tensor,
        advantages: Tensor,
        clip_range: Tensor,
    ) -> tuple[Tensor, ...]:
        """Compute the loss of each sample (Schulman et al., 2017, eq. 9).

        Args:
            parameters: parameters of `networks`, by name.
            samples: (S·N, …) from `_samples`.
            minibatch: (S, B) rows of it.
            advantages: (S, B) standardized advantages of these samples.
            clip_range: () ε.

        Returns:
            (S, B) each: the loss, the policy's entropy, the value function's squared error, and the
            divergence of the policy from the one that took the action, estimated as Schulman's
            http://joschu.net/blog/kl-approx.html does.
        """
        config = self.config
        rows = samples.index_select(0, minibatch.flatten()).view(*minibatch.shape, -1)
        states, one_hot = rows[..., : self._size], rows[..., self._size : -3]
        old_log_prob, _, returns = rows[..., -3:].unbind(dim=-1)

        log_probs = self._architecture.forward(parameters, states).log_softmax(dim=-1)
        log_ratio = (log_probs * one_hot).sum(dim=-1) - old_log_prob
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
        surrogate = torch.minimum(advantages * ratio, advantages * clipped)
        entropy = -(log_probs.exp() * log_probs).sum(dim=-1)
        errors = (returns - self._architecture.values(parameters, states)).square()
        losses = config.vf_coef * errors - surrogate - config.ent_coef * entropy
        return losses, entropy, errors, ratio - 1 - log_ratio

    def _update_policy(self) -> None:
        """Copy the actors, and the normalization of their inputs, to `policy`."""
        actor = parameter_count(self._architecture.actor)
        self.policy.flat[:, -actor:] = self.networks.flat[:, :actor]
        seen: Standardization | RunningMoments | None = self._standardize
        if self._normalization is not None:
            seen = self._normalization.seen
        if seen is not None:
            moments = torch.from_numpy(np.concatenate((seen.mean, seen.deviation), axis=-1))
            self.policy.flat[:, :-actor] = moments.to(self.policy.flat)

    def _by_seed(self, array: NDArray[Any]) -> Tensor:
        """Turn (T, S·K, …) into (S, N, …)."""
        steps, _, *rest = array.shape
        split = torch.from_numpy(array).view(steps, self._seeds, -1, *rest)
        return split.transpose(0, 1).flatten(1, 2).to(self._device)

    def _by_step(self, tensor: Tensor) -> Floats:
        """Turn (S, N) into (T, S·K)."""
        split = tensor.view(self._seeds, self.config.n_steps, -1)
        array: Floats = split.transpose(0, 1).flatten(1).cpu().numpy()
        return array


def _standardized(advantages: Tensor) -> Tensor:
    """Give the advantages (M, S, B) of each minibatch mean 0 and deviation 1.

    Not part of `_loss`: a compiled mean's rounding would depend on the number of seeds.
    """
    deviation = advantages.std(dim=-1, keepdim=True)
    return (advantages - advantages.mean(dim=-1, keepdim=True)) / (deviation + 1e-8)


def orthogonal(
    architecture: ActorCritic, seeds: Sequence[int], purpose: str, device: torch.device
) -> Network:
    """Make networks with orthogonal weights, as Stable-Baselines3 initializes them.

    Rows or columns, whichever are fewer, are orthogonal. Their norm is √2 in hidden layers, 0.01
    in the policy's last layer, so that all actions are about equally likely at first, and 1 in the
    value function's. Biases are 0.

    Args:
        architecture: the architecture of each network.
        seeds: S seeds; equal seeds and purpose give equal networks.
        purpose: names the stream of random numbers.
        device: device of the parameters.
    """
    streams = Streams(seeds, purpose)
    network = Network(architecture, torch.zeros(len(seeds), parameter_count(architecture)))
    gains = {"output.actor.weight": 0.01, "output.critic.weight": 1.0}
    with torch.no_grad():
        for name, parameter in network.parameters.items():
            if name.endswith("bias"):
                continue
            rows, columns = parameter.shape[1:]
            # torch's decomposition, not NumPy's, has the same digits on every machine.
            normal = torch.from_numpy(streams.normal(max(rows, columns), min(rows, columns)))
            q, r = torch.linalg.qr(normal)
            # With the signs of R's diagonal, Q is uniform over all orthogonal matrices.
            q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
            parameter.copy_(gains.get(name, math.sqrt(2)) * (q if rows >= columns else q.mT))
    return Network(architecture, network.flat.to(device))


def _check_steps(config: PPOConfig, rollout: int, total_timesteps: int) -> None:
    """Refuse minibatches that do not divide a rollout, and a budget below one rollout."""
    if config.batch_size < 2 or rollout % config.batch_size:
        raise UserError(
            f"method.ppo.batch_size={config.batch_size}: must be above 1 and divide a rollout, "
            f"n_envs · n_steps = {rollout}"
        )
    if total_timesteps < rollout:
        raise UserError(
            f"method.total_timesteps={total_timesteps}: must be at least one rollout, "
            f"n_envs · n_steps = {rollout}"
        )
