"""Proximal Policy Optimization (Schulman et al., 2017), with the semantics of Stable-Baselines3."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, within
from ril.environments.environment import Floats
from ril.io.errors import UserError
from ril.learners.advantages import generalized_advantages
from ril.learners.normalization import CLIP, Normalization, RunningMoments, Standardization
from ril.learners.ppo_rollout import Rollout, acting, collect_rollout
from ril.learners.topology import tanh_mlp
from ril.task import Task
from ril.vectorized.architectures import ActorCritic, Standardized
from ril.vectorized.compiling import LEAST_ROWS, worth_compiling
from ril.vectorized.descent import descent
from ril.vectorized.layers import Parameters
from ril.vectorized.networks import Architecture, Network, parameter_count
from ril.vectorized.orthogonal import orthogonal
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
        self._act = acting(self._architecture, self.networks.flat, compiled=self.compiled)
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
        self._rollout = collect_rollout(
            self._environments, self._act, by_step, self._seen, self._normalization
        )
        self.steps += self.rollout_steps
        return self._by_seed(self._rollout.observations), self._by_seed(self._rollout.actions)

    def _seen(self, observations: Floats) -> Floats:
        """Return scaled observations (S·K, obs) as the agents see them."""
        if self._normalization is not None:
            return self._normalization.observations(observations)
        return observations if self._standardize is None else self._standardize(observations)

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
