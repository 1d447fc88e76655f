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
from ril.learners.normalization import CLIP, Normalization
from ril.learners.topology import tanh_mlp
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.descent import descent
from ril.vectorized.networks import (
    ActorCritic,
    Architecture,
    Network,
    Parameters,
    Standardized,
    parameter_count,
)
from ril.vectorized.state import Stateful
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam, square_root


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

    observations: Floats  # (T, S·K, obs), normalized if observations are
    actions: NDArray[np.int64]  # (T, S·K)
    rewards: Floats  # (T, S·K), normalized if rewards are
    next_observations: Floats  # (T, S·K, obs); the final state where an episode is over
    terminated: NDArray[np.bool_]  # (T, S·K)
    truncated: NDArray[np.bool_]  # (T, S·K)


class PPOLearner(Stateful):
    """S agents, each a policy and a value function in K environments of its own.

    Args:
        config: hyperparameters.
        task: environment and seeds.
        total_timesteps: environment steps of each seed, rounded up to whole rollouts.
        normalize: whether to normalize observations and rewards by their running moments.
        linear_schedule: whether learning rate and clip range fall linearly to 0 over
            `total_timesteps`.

    Attributes:
        networks: policies and value functions, for observations as the agents see them.
        policy: the policies alone, for scaled observations.
        rollout_steps: N, steps of each seed in a rollout.
        rollouts: number of rollouts in `total_timesteps`.
        steps: steps of each seed so far.

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
    _CHUNK = 512  # samples of each seed that are evaluated at once, so that they fit the cache

    def __init__(
        self,
        config: PPOConfig,
        task: Task,
        total_timesteps: int,
        *,
        normalize: bool = False,
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
        architecture: Architecture = actor
        if normalize:
            first = self._environments.observations
            self._normalization = Normalization(first, len(seeds), config.gamma)
            architecture = Standardized(actor, CLIP)
        flat = torch.empty(len(seeds), parameter_count(architecture), device=task.device)
        self.policy = Network(architecture, flat)
        self._update_policy()
        self._optimizer = ClippedAdam(
            self.networks, config.learning_rate, epsilon=1e-5, max_norm=config.max_grad_norm
        )
        minibatches = config.n_epochs * self.rollout_steps // config.batch_size
        self._descend = descent(
            self._optimizer,
            self._loss,
            compile_step=worth_compiling(task.compile, self.rollouts * minibatches),
        )
        self._sampling = Streams(seeds, "actions")
        self._shuffling = Streams(seeds, "minibatches")
        self._rollout: Rollout | None = None

    def collect(self) -> tuple[Tensor, Tensor]:
        """Play T = n_steps steps in each of the K copies, with actions drawn from the policy.

        Returns:
            (S, N, obs) observations as the agents see them, and (S, N) the actions in them.
        """
        uniform = torch.from_numpy(self._sampling.uniform(self.config.n_steps, self.config.n_envs))
        observations = self._environments.observations
        if self._normalization is not None:
            observations = self._normalization.observations(observations)
        steps = []
        for numbers in uniform.to(self._device).unbind(dim=1):
            logits = self.networks.infer(observations)
            actions = sample_softmax(logits, numbers).flatten().cpu().numpy()
            step = self._environments.step(actions)
            following, rewards = self._environments.observations, step.rewards
            final = step.next_observations
            over = step.terminated | step.truncated
            if self._normalization is not None:
                self._normalization.update(following, rewards)
                following = self._normalization.observations(following)
                rewards = self._normalization.rewards(rewards)
                final = self._normalization.observations(final) if over.any() else following
                self._normalization.end(over)
            steps.append((observations, actions, rewards, final, step.terminated, step.truncated))
            observations = following
        self._rollout = Rollout(*map(np.stack, zip(*steps, strict=True)))
        self.steps += self.rollout_steps
        return self._by_seed(self._rollout.observations), self._by_seed(self._rollout.actions)

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
        measured = [
            self._descend(samples, minibatch, clip_range)[1:] for minibatch in self._minibatches()
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

    @torch.no_grad()
    def _samples(self, rollout: Rollout) -> Tensor:
        """Return what a rollout's updates need, with the N samples of a seed side by side.

        Returns:
            (S·N, obs + |A| + 3) observation, one-hot action, the action's log-probability under the
            policy that took it, advantage, and return.
        """
        config = self.config
        states, actions = self._by_seed(rollout.observations), self._by_seed(rollout.actions)
        values = self._in_chunks(self._architecture.values, states)
        next_states = self._by_seed(rollout.next_observations)
        advantages = generalized_advantages(
            rollout.rewards,
            self._by_step(values),
            self._by_step(self._in_chunks(self._architecture.values, next_states)),
            rollout.terminated,
            rollout.truncated,
            config.gamma,
            config.gae_lambda,
        )
        advantage = self._by_seed(advantages)
        one_hot = functional.one_hot(actions, self._actions).float()
        log_probs = self._in_chunks(self._architecture.forward, states).log_softmax(dim=-1)
        log_prob = (log_probs * one_hot).sum(dim=-1)
        numbers = torch.stack((log_prob, advantage, values + advantage), dim=-1)
        return torch.cat((states, one_hot, numbers), dim=-1).flatten(0, 1)

    def _minibatches(self) -> Sequence[Tensor]:
        """Draw a permutation of each seed's samples per epoch, and divide it into minibatches.

        Returns:
            Rows (S, B) of `_samples`, one entry per minibatch.
        """
        drawn = self._shuffling.permutations(self.config.n_epochs, self.rollout_steps)
        firsts = np.arange(self._seeds)[:, None, None] * self.rollout_steps
        rows = (drawn + firsts).reshape(self._seeds, -1, self.config.batch_size)
        by_minibatch = np.ascontiguousarray(rows.swapaxes(0, 1))
        return torch.from_numpy(by_minibatch).to(self._device).unbind()

    def _loss(
        self, parameters: Parameters, samples: Tensor, minibatch: Tensor, clip_range: Tensor
    ) -> tuple[Tensor, ...]:
        """Compute the loss of each sample (Schulman et al., 2017, eq. 9).

        Args:
            parameters: parameters of `networks`, by name.
            samples: (S·N, …) from `_samples`.
            minibatch: (S, B) rows of it.
            clip_range: () ε.

        Returns:
            (S, B) each: the loss, the policy's entropy, the value function's squared error, and the
            divergence of the policy from the one that took the action, estimated as Schulman's
            http://joschu.net/blog/kl-approx.html does.
        """
        config = self.config
        rows = samples.index_select(0, minibatch.flatten()).view(*minibatch.shape, -1)
        states, one_hot = rows[..., : self._size], rows[..., self._size : -3]
        old_log_prob, advantages, returns = rows[..., -3:].unbind(dim=-1)
        advantages = _standardized(advantages)

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
        if self._normalization is not None:
            seen = self._normalization.seen
            moments = torch.from_numpy(np.concatenate((seen.mean, seen.deviation), axis=1))
            self.policy.flat[:, :-actor] = moments.to(self.policy.flat)

    def _in_chunks(self, forward: Any, states: Tensor) -> Tensor:
        """Evaluate one of the networks in states (S, N, obs)."""
        chunks = torch.split(states, self._CHUNK, dim=1)
        return torch.cat([forward(self.networks.parameters, chunk) for chunk in chunks], dim=1)

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
    """Give each row of advantages (S, B) mean 0 and deviation 1."""
    centered = advantages - advantages.mean(dim=1, keepdim=True)
    # Written out, because torch's compiler fails on `std` here.
    variance = centered.square().sum(dim=1, keepdim=True) / (advantages.shape[1] - 1)
    return centered / (square_root(variance) + 1e-8)


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
