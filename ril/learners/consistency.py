"""One loss for both halves of RIL: temporal differences plus cross-entropy with the labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, within
from ril.learners.q_learning import TemporalDifferenceConfig
from ril.learners.td import action_values, n_step, td_losses, td_targets
from ril.vectorized.architectures import Consistent
from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.layers import Parameters
from ril.vectorized.networks import Network, by_name, parameter_count
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.rollout import Episodes
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class ConsistencyConfig(TemporalDifferenceConfig):
    """The loss of `ril_consistent`, for both halves of RIL."""

    anneal: bool = MISSING
    n_steps: int = MISSING
    tau: float = within(1e-6, 1)
    value_hidden: list[int] = MISSING
    value_scale: float = MISSING
    temperature: float = MISSING
    gap: float | None = MISSING
    imitation_weight: float = at_least(0)
    min_confidence: float = within(0, 1)
    fade: bool = MISSING
    replay_trajectories: float = MISSING
    replay_recent: float | None = MISSING


class ConsistentLearning(Stateful):
    """Trains S value functions and policies on transitions and labels, by one loss.

    Args:
        network: Q(s, a) = V(s) + τ·log π(a | s).
        replay: each seed's memory of its own episodes.
        config: `method.q_learning`.
        seeds: the S seeds of the run.
        recent: draw half of each minibatch from this many newest transitions; None draws all of
            it from the whole memory.
        compile_step: whether each step is one compiled graph, which differs in the last bits.

    Attributes:
        average: running mean of the networks' parameters, from which the targets are computed.
        policy: the average's π alone, as logits; it acts.
        reward_scale: (S,) divisor of the rewards; 0 before the first episodes.
    """

    STATE: ClassVar = ("network", "average", "reward_scale", "_optimizer", "replay", "_streams")

    def __init__(
        self,
        network: Network,
        replay: Replay,
        config: ConsistencyConfig,
        seeds: tuple[int, ...],
        *,
        recent: int | None = None,
        compile_step: bool = False,
    ) -> None:
        assert isinstance(network.architecture, Consistent)
        self.network = network
        self.replay = replay
        self.recent = recent
        self.config = config
        self.reward_scale = torch.zeros(len(seeds), device=network.flat.device)
        self.average = network.copy()
        of_value = parameter_count(network.architecture.value)
        self.policy = Network(network.architecture.policy, self.average.flat[:, of_value:])
        self._streams = {
            purpose: Streams(seeds, purpose) for purpose in ("replay batches", "cloning batches")
        }
        self._optimizer = ClippedAdam(network, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, compile_step=compile_step)

    def remember(self, episodes: Episodes) -> None:
        """Store episodes as n-step transitions.

        Rewards are divided by their mean absolute value in the seed's first episodes.

        Args:
            episodes: S·N episodes, the N of one seed side by side.
        """
        config, seeds = self.config, len(self.reward_scale)
        if not self.reward_scale.any():
            total = np.abs(episodes.rewards).reshape(seeds, -1).sum(axis=1, dtype=np.float64)
            mean = total / episodes.lengths.reshape(seeds, -1).sum(axis=1)
            self.reward_scale.copy_(torch.from_numpy(np.where(mean > 0, mean, 1.0)))
        scale = self.reward_scale.cpu().numpy().repeat(len(episodes.lengths) // seeds)
        self.replay.append(n_step(episodes, config.n_steps, config.discount, scale))

    def train(
        self,
        updates: int,
        states: Tensor,
        labels: Tensor | None,
        weights: Tensor | None,
        learning_rate: float,
    ) -> tuple[Tensor, Tensor]:
        """Take minibatch steps of the temporal-difference loss plus weighted cross-entropy.

        Args:
            updates: number of steps, at least 1.
            states: (M, obs) states of the expert, the same for all seeds.
            labels: (S, M) actions in these states; None trains on the transitions alone.
            weights: (S, M) weights of the labels' cross-entropy; None without labels.
            learning_rate: learning rate of these steps.

        Returns:
            Two means over the steps, (S,) each: the temporal-difference loss, and the unweighted
            cross-entropy.
        """
        self._optimizer.learning_rate = learning_rate
        config, device = self.config, self.network.flat.device
        numbers = self._streams["replay batches"].uniform(updates, config.batch_size)
        slots = self._slots(numbers).to(device)
        numbers = self._streams["cloning batches"].uniform(updates, config.batch_size)
        shown = random_indices(numbers, np.full(len(numbers), len(states))).to(device)
        stored = self.replay.everything()

        def step(own: Tensor, shown: Tensor) -> Tensor:
            labeled: tuple[Tensor | None, ...] = (None, None, None)
            if labels is not None and weights is not None:
                labeled = states[shown], labels.gather(1, shown), weights.gather(1, shown)
            # Contiguous, because a compiled graph accepts the strides of its first call only.
            _, *losses = self._descend(self.average.flat, stored, own.contiguous(), *labeled)
            self.average.flat.lerp_(self.network.flat, config.tau)
            return torch.stack([each.mean(dim=1) for each in losses])

        td_loss, cloning_loss = train_on_minibatches(step, slots.unbind(dim=1), shown.unbind(dim=1))
        return td_loss, cloning_loss

    def _slots(self, numbers: NDArray[np.float32]) -> Tensor:
        """Turn uniform numbers (S, updates, B) in [0, 1) into slots of the memory."""
        if self.recent is None:
            return random_indices(numbers, self.replay.sizes)
        overall, newest = np.split(numbers, [numbers.shape[-1] // 2], axis=-1)
        halves = random_indices(overall, self.replay.sizes), self.replay.newest(newest, self.recent)
        return torch.cat(halves, dim=-1)

    def _loss(
        self,
        parameters: Parameters,
        average: Tensor,
        memory: Batch,
        slots: Tensor,
        states: Tensor | None,
        labels: Tensor | None,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the loss and its two parts.

        Args:
            parameters: parameters of value function and policy, by name.
            average: (S, P) parameters from which the targets are computed.
            memory: (S, N, …) all stored transitions.
            slots: (S, B) the transitions to train on.
            states: (S, B, obs) states of the expert; None omits the cross-entropy.
            labels: (S, B) their actions.
            weights: (S, B) weights of the cross-entropy.

        Returns:
            The loss, the temporal-difference loss and the unweighted cross-entropy, (S, B) each.
        """
        architecture, config = self.network.architecture, self.config
        assert isinstance(architecture, Consistent)
        batch = memory.at(slots)
        values = architecture.forward(parameters, batch.observations)
        errors = action_values(values, batch.actions) - self._targets(average, batch)
        td = td_losses(errors, config.loss)
        if states is None or labels is None or weights is None:
            return td, td, torch.zeros_like(td)
        logits = architecture.logits(parameters, states)
        # Cross-entropy, written out: within this graph, the rounding of torch's own depends on the
        # number of seeds.
        cloning = logits.logsumexp(dim=-1) - action_values(logits, labels)
        return td + weights * cloning, td, cloning

    @torch.no_grad()
    def _targets(self, average: Tensor, batch: Batch) -> Tensor:
        """Compute the targets (S, B) of the values Q(S_t, A_t).

        The target of an action that is not the best lies at most `gap` below the best value: how
        bad it is need not be known, and π could only express it by extreme logits.

        Args:
            average: (S, P) parameters from which the values are computed.
            batch: B transitions per seed.
        """
        architecture, config = self.network.architecture, self.config
        discount = config.discount**config.n_steps
        values = partial(architecture.forward, by_name(architecture, average))
        if config.gap is None:
            return td_targets(batch, values(batch.next_observations), discount)
        both = torch.cat((batch.observations, batch.next_observations), dim=1)
        here, following = values(both).chunk(2, dim=1)
        targets = td_targets(batch, following, discount)
        best = here.amax(dim=-1)
        is_best = action_values(here, batch.actions) >= best
        return torch.where(is_best, targets, torch.maximum(targets, best - config.gap))
