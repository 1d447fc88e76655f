"""Imitating Latent Policies from Observation (Edwards et al., 2019)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import part, within
from ril.config.schema import MethodConfig
from ril.environments.environment import Environment
from ril.io.errors import UserError
from ril.learners.exploration import epsilon_greedy
from ril.learners.latent_policy import LatentPolicyConfig, latent_loss, nearest_latents
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec, Shown
from ril.task import Task
from ril.vectorized.descent import train_on_minibatches
from ril.vectorized.latent_networks import ActionRemapping, LatentDynamics, LatentPolicy
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Network, parameter_count
from ril.vectorized.replay import gather_by_seed, random_indices
from ril.vectorized.state import Stateful
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class RemappingConfig:
    """Settings of ILPO's second step, which maps latent actions to the environment's actions."""

    hidden: list[int] = MISSING
    learning_rate: float = MISSING
    batch_size: int = MISSING
    steps: int = MISSING
    steps_per_epoch: int = MISSING
    epsilon: float = within(0, 1)


@dataclass
class ILPOConfig(MethodConfig):
    """Settings of ILPO: `conf/method/ilpo.yaml`."""

    epochs: int = MISSING
    latent_policy: LatentPolicyConfig = part(LatentPolicyConfig)
    remapping: RemappingConfig = part(RemappingConfig)


class ILPO(Stateful):
    """S agents that learn a latent policy from the expert's states, then remap its actions.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.

    Raises:
        UserError: a key of the configuration is out of range or contradicts another.
    """

    STATE = (
        *("epoch", "steps", "policy", "_latent_optimizer", "_remapping_optimizer"),
        *("environments", "_streams", "_latent_loss", "_latents_seen", "_actions_seen"),
    )

    def __init__(self, config: ILPOConfig, task: Task) -> None:
        latent, remapping = config.latent_policy, config.remapping
        if len(latent.encoder) != 2 or len(remapping.hidden) != 2:
            raise UserError(
                f"method.latent_policy.encoder={latent.encoder}, "
                f"method.remapping.hidden={remapping.hidden}: must have two layers each"
            )
        if remapping.steps % remapping.steps_per_epoch:
            raise UserError(
                f"method.remapping.steps={remapping.steps}: must be a multiple of "
                f"method.remapping.steps_per_epoch={remapping.steps_per_epoch}"
            )
        self.config = config
        self.task = task
        self.epochs = config.epochs + remapping.steps // remapping.steps_per_epoch
        environment, seeds = task.environment, task.seeds
        size, actions = environment.observation_size, environment.action_count
        latents = latent.latents or actions
        encoder = (latent.encoder[0], latent.encoder[1])
        hidden = (remapping.hidden[0], remapping.hidden[1])
        self._architecture = LatentDynamics(
            size, latents, encoder, latent.generator, latent.negative_slope
        )
        remap = ActionRemapping(size, latents, actions, encoder, hidden, latent.negative_slope)

        whole = LatentPolicy(self._architecture, remap)
        self.policy = Network.initialize(whole, seeds, "policy", task.device)
        border = parameter_count(self._architecture)  # both halves are views of the policy
        self.dynamics = Network(self._architecture, self.policy.flat[:, :border])
        self.remapping = Network(remap, self.policy.flat[:, border:])
        self._latent_optimizer = ClippedAdam(
            self.dynamics, latent.learning_rate, beta1=latent.beta1
        )
        self._remapping_optimizer = ClippedAdam(self.remapping, remapping.learning_rate)

        self._states = torch.from_numpy(task.expert.observations).to(task.device)
        following = torch.from_numpy(task.expert.next_observations).to(task.device)
        self._unit = _unit_of_changes(latent.changes, environment, following - self._states)
        self._changes = (following - self._states) * self._unit
        self.environments = SteppedEnvironments(environment, seeds, 1, "remapping")
        shape = (len(seeds), remapping.steps)
        self._latents_seen = torch.zeros(*shape, size + latents, device=task.device)
        self._actions_seen = torch.zeros(shape, dtype=torch.int64, device=task.device)
        self._streams = {
            purpose: Streams(seeds, purpose)
            for purpose in ("latent batches", "remapping exploration", "remapping batches")
        }
        self._latent_loss = torch.zeros(len(seeds), device=task.device)
        self.epoch = 0
        self.steps = 0

    def train(self) -> Iterator[Progress]:
        """Train first the latent policy, then the remapping; yield after each epoch."""
        seeds = len(self.task.seeds)
        while self.epoch < self.epochs:
            self.epoch += 1
            imitating = self.epoch <= self.config.epochs
            if imitating:
                self._latent_loss = self._learn_latent_policy()
                metrics = {"latent_loss": self._latent_loss}
            else:  # only now are policies evaluated, so each point repeats the first half's loss
                remapping_loss = self._learn_remapping()
                metrics = {"latent_loss": self._latent_loss, "remapping_loss": remapping_loss}
            expert_epochs = min(self.epoch, self.config.epochs)
            yield Progress(
                self.epoch,
                env_samples=np.full(seeds, self.steps),
                expert_samples=np.full(seeds, expert_epochs * len(self._states)),
                pre_samples=0,
                stopped=np.zeros(seeds, dtype=bool),
                metrics={name: loss.double().cpu().numpy() for name, loss in metrics.items()},
                can_act=not imitating,
            )

    def _learn_latent_policy(self) -> Tensor:
        """Train on minibatches of the expert's states; return (S,) mean losses."""
        config, architecture = self.config.latent_policy, self._architecture
        uniform = self._streams["latent batches"].uniform(config.updates, config.batch_size)
        sizes = np.full(len(self.task.seeds), len(self._states))
        indices = random_indices(uniform, sizes).to(self._states.device)

        def step(chosen: Tensor) -> Tensor:
            predictions = architecture.predict(self.dynamics.parameters, self._states[chosen])
            losses = latent_loss(predictions, self._changes[chosen])
            self._latent_optimizer.step(losses)
            return losses.detach()

        return train_on_minibatches(step, indices.unbind(dim=1))

    def _learn_remapping(self) -> Tensor:
        """Act in the environment, with an update after each step; return (S,) mean losses."""
        config, device = self.config.remapping, self._latents_seen.device
        steps, seeds = config.steps_per_epoch, len(self.task.seeds)
        exploring = torch.from_numpy(
            self._streams["remapping exploration"].uniform(steps, 2, 1)
        ).to(device)
        batches = self._streams["remapping batches"].uniform(steps, config.batch_size)
        epsilon = torch.full((seeds,), config.epsilon, device=device)

        def step(uniform: Tensor, batch: NDArray[np.float32]) -> Tensor:
            self._act(uniform.transpose(0, 1), epsilon)
            chosen = random_indices(batch, np.full(seeds, self.steps)).to(device)
            logits = self.remapping(gather_by_seed(self._latents_seen, chosen))
            losses = cross_entropy(logits, gather_by_seed(self._actions_seen, chosen)).mean(dim=1)
            self._remapping_optimizer.step(losses)
            return losses.detach()

        return train_on_minibatches(step, exploring.unbind(dim=1), batches.swapaxes(0, 1))

    @torch.no_grad()
    def _act(self, uniform: Tensor, epsilon: Tensor) -> None:
        """Take one step of each seed; store the latent action that best explains the step.

        Args:
            uniform: (S, 2, 1) numbers in [0, 1) that decide the ε-greedy actions.
            epsilon: (S,) probability of a random action.
        """
        observations = self.environments.observations
        actions = epsilon_greedy(self.policy.infer(observations), epsilon, uniform, "uniform")
        step = self.environments.step(actions.flatten().cpu().numpy())
        before = torch.from_numpy(observations).to(actions.device)[:, None]
        after = torch.from_numpy(step.next_observations).to(actions.device)[:, None]
        predictions = self._architecture.predict(self.dynamics.parameters, before)
        latents = nearest_latents(predictions, (after - before) * self._unit)
        one_hot = functional.one_hot(latents, self._architecture.latents).to(before)
        self._latents_seen[:, self.steps] = torch.cat((before, one_hot), dim=-1)[:, 0]
        self._actions_seen[:, self.steps] = actions[:, 0]
        self.steps += 1


def _unit_of_changes(name: str, environment: Environment, changes: Tensor) -> Tensor:
    """Return (obs,) the factors that turn scaled changes (M, obs) into those predicted (L2)."""
    if name == "raw":
        return torch.from_numpy((environment.high - environment.low) / 2).to(changes)
    if name == "standardized":
        deviation = changes.std(dim=0)
        return torch.where(deviation > 0, 1 / deviation, torch.ones_like(deviation))
    return torch.ones_like(changes[0])


SPEC = MethodSpec(
    "ilpo",
    ILPOConfig,
    ILPO,
    expert="states",
    shown=(Shown("latent loss", "latent_loss"), Shown("remapping loss", "remapping_loss")),
)
