"""Actor-critic with K-FAC trust regions (Wu et al., 2017): A2C with natural gradients."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, part, within
from ril.config.schema import MethodConfig
from ril.environments.environment import Floats
from ril.learners.advantages import generalized_advantages
from ril.learners.exploration import sample_softmax
from ril.learners.kfac import KFAC, KFACConfig
from ril.learners.topology import tanh_mlp
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.state import Stateful
from ril.vectorized.stepping import Step, SteppedEnvironments
from ril.vectorized.streams import Streams


@dataclass
class ACKTRConfig(MethodConfig):
    """Settings of ACKTR by Stable-Baselines' names: `conf/method/acktr.yaml`."""

    total_timesteps: int = MISSING
    hidden: list[int] = MISSING
    n_envs: int = MISSING
    n_steps: int = MISSING
    standardize_steps: int = at_least(0)
    gamma: float = within(0, 1)
    gae_lambda: float = within(0, 1)
    ent_coef: float = at_least(0)
    actor: KFACConfig = part(KFACConfig)
    critic: KFACConfig = part(KFACConfig)


class ACKTR(Stateful):
    """S agents, each a policy and a value function in K environments, trained on rewards alone.

    Args:
        config: `method` of the configuration.
        task: environment and seeds; the expert's trajectories are not used.
    """

    STATE = ("epoch", "policy", "value", "actor", "critic", "environments", "_streams")

    def __init__(self, config: ACKTRConfig, task: Task) -> None:
        environment, seeds = task.environment, task.seeds
        self.config = config
        self.rollout_steps = config.n_envs * config.n_steps
        self.random_steps = config.n_envs * config.standardize_steps
        left = max(1, config.total_timesteps - self.random_steps)
        self.epochs = math.ceil(left / self.rollout_steps)
        size = environment.observation_size
        actor = tanh_mlp(size, config.hidden, environment.action_count)
        critic = tanh_mlp(size, config.hidden, 1)
        self.policy = Network.initialize(actor, seeds, "policy", task.device)
        self.value = Network.initialize(critic, seeds, "value", task.device)
        self.actor = KFAC(self.policy, config.actor)
        self.critic = KFAC(self.value, config.critic)
        self.environments = SteppedEnvironments(environment, seeds, config.n_envs, "acktr")
        self._streams = Streams(seeds, "actions")
        self._random = Streams(seeds, "random actions")
        self._actions = environment.action_count
        self._seeds = len(seeds)
        self._device = task.device
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train both networks on one rollout after another; yield after each."""
        if self.epoch == 0:
            self._standardize()
        while self.epoch < self.epochs:
            self.epoch += 1
            metrics = self._update(*self._rollout())
            steps = self.random_steps + self.epoch * self.rollout_steps
            yield Progress.of_rewards(self.epoch, self._seeds, steps, metrics)

    def _standardize(self) -> None:
        """Play random actions, and standardize the networks' inputs by the states they reach."""
        shape = self.config.standardize_steps, self.config.n_envs
        chosen = self._random.integers(self._actions, *shape)
        seen = []
        for actions in chosen.swapaxes(0, 1):  # (S, K) at each step
            seen.append(self.environments.observations)
            self.environments.step(actions.ravel())
        if len(seen) * self.config.n_envs > 1:
            states = self._by_seed(np.stack(seen))
            standardize_inputs(self.policy, states)
            standardize_inputs(self.value, states)

    def _rollout(self) -> tuple[Floats, NDArray[np.int64], Step]:
        """Take T = n_steps steps in all S·K environments, with actions drawn from the policy.

        Returns:
            (T, S·K, obs) scaled states, (T, S·K) actions in them, and the resulting steps: a
            `Step` whose fields have a leading axis T.
        """
        uniform = torch.from_numpy(self._streams.uniform(self.config.n_steps, self.config.n_envs))
        observations, actions, steps = [], [], []
        for numbers in uniform.to(self._device).unbind(dim=1):
            observations.append(self.environments.observations)
            logits = self.policy.infer(observations[-1])
            actions.append(sample_softmax(logits, numbers).flatten().cpu().numpy())
            steps.append(self.environments.step(actions[-1]))
        followed = Step(
            np.stack([step.next_observations for step in steps]),
            np.stack([step.rewards for step in steps]),
            np.stack([step.terminated for step in steps]),
            np.stack([step.truncated for step in steps]),
        )
        return np.stack(observations), np.stack(actions), followed

    def _update(
        self, observations: Floats, actions: NDArray[np.int64], followed: Step
    ) -> dict[str, NDArray[np.float64]]:
        """Take one K-FAC step of each network on a rollout.

        Args:
            observations: (T, S·K, obs) scaled states.
            actions: (T, S·K) actions in them.
            followed: the resulting steps, with a leading axis T.

        Returns:
            Diagnostics by name, each (S,).
        """
        config = self.config
        states = self._by_seed(observations)
        values = self.critic(states).squeeze(-1)
        with torch.no_grad():
            next_values = self.value(self._by_seed(followed.next_observations)).squeeze(-1)
        advantages = self._by_seed(
            generalized_advantages(
                followed.rewards,
                self._by_step(values),
                self._by_step(next_values),
                followed.terminated,
                followed.truncated,
                config.gamma,
                config.gae_lambda,
            )
        )
        targets = values.detach() + advantages
        value_loss = (values - targets).square().mean(dim=1) / 2
        # V(s) is the mean of a Gaussian of unit variance, whose −log p has the gradient ε∂v for
        # a sample V(s) + ε; E[ε²] = 1, so that ∂v has the same Fisher matrix without the noise.
        self.critic.step(value_loss, log_prob=values)

        log_probs = self.actor(states).log_softmax(dim=-1)
        chosen = log_probs.gather(-1, self._by_seed(actions)[..., None]).squeeze(-1)
        entropy = -(log_probs.exp() * log_probs).sum(dim=-1).mean(dim=1)
        policy_loss = -(chosen * advantages).mean(dim=1) - config.ent_coef * entropy
        # The rollout's actions are samples of the policy, which has not changed since.
        self.actor.step(policy_loss, log_prob=chosen)
        metrics = {"entropy": entropy, "value_loss": value_loss}
        return {name: each.detach().double().cpu().numpy() for name, each in metrics.items()}

    def _by_seed(self, array: NDArray[Any]) -> Tensor:
        """Turn (T, S·K, …) into (S, T·K, …)."""
        steps, _, *rest = array.shape
        split = torch.from_numpy(array).view(steps, self._seeds, -1, *rest)
        return split.transpose(0, 1).flatten(1, 2).to(self._device)

    def _by_step(self, tensor: Tensor) -> Floats:
        """Turn (S, T·K) into (T, S·K)."""
        split = tensor.detach().view(self._seeds, self.config.n_steps, -1)
        array: Floats = split.transpose(0, 1).flatten(1).cpu().numpy()
        return array


@torch.no_grad()
def standardize_inputs(network: Network, states: Tensor) -> None:
    """Fold a standardization of the inputs into the first layer, in place.

    Args:
        network: networks of S seeds.
        states: (S, N, obs) whose mean and standard deviation standardize each seed's inputs.
    """
    weight, bias = network.parameters["linear0.weight"], network.parameters["linear0.bias"]
    mean, deviation = states.mean(dim=1, keepdim=True), states.std(dim=1, keepdim=True)
    weight.div_(deviation.mT + 1e-3)  # a deviation may be 0
    bias.sub_((mean.mT * weight).sum(dim=1, keepdim=True))


SPEC = MethodSpec("acktr", ACKTRConfig, ACKTR, budget="total_timesteps")
