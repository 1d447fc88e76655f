"""One loss for both halves of RIL: path consistency, anchored to the expert's labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, within
from ril.learners.q_learning import TemporalDifferenceConfig
from ril.learners.td import n_step, taken, td_losses, td_targets
from ril.vectorized.descent import descent
from ril.vectorized.networks import Consistent, Network, Parameters, by_name, parameter_count
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class ConsistencyConfig(TemporalDifferenceConfig):
    """Both halves in one descent, of `ril_consistent`."""

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


class ConsistentLearning:
    """S pairs of value and policy that learn from transitions and from labels in one descent.

    Args:
        network: Q(s, a) = V(s) + τ·log π(a | s).
        replay: each seed's memory of its own episodes.
        config: `method.q_learning`.
        seeds: S.
        recent: how many of the newest transitions half of each minibatch is of; None draws from
            all alike.
        fused: whether each step is one compiled graph; the same but for rounding.

    Attributes:
        average: of the networks over the last updates, whose values are the targets.
        policy: the average's π alone, as logits; it is what acts.
        unit: (S,) by which rewards are divided; 0 until the first episodes.
    """

    def __init__(
        self,
        network: Network,
        replay: Replay,
        config: ConsistencyConfig,
        seeds: tuple[int, ...],
        *,
        recent: int | None = None,
        fused: bool = False,
    ) -> None:
        assert isinstance(network.architecture, Consistent)
        self.network = network
        self.replay = replay
        self.recent = recent
        self.config = config
        self.unit = torch.zeros(len(seeds), device=network.flat.device)
        self.average = network.copy()
        of_value = parameter_count(network.architecture.value)
        self.policy = Network(network.architecture.policy, self.average.flat[:, of_value:])
        self._streams = {
            purpose: Streams(seeds, purpose) for purpose in ("replay batches", "cloning batches")
        }
        self._optimizer = ClippedAdam(network, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, fused=fused)

    def remember(self, episodes: Episodes) -> None:
        """Keep the transitions of S·N episodes, as many of each seed, those of one side by side.

        Rewards are counted in units of their mean size in the first episodes of each seed.
        """
        config, seeds = self.config, len(self.unit)
        if not self.unit.any():
            size = np.abs(episodes.rewards).reshape(seeds, -1).sum(axis=1, dtype=np.float64)
            mean = size / episodes.lengths.reshape(seeds, -1).sum(axis=1)
            self.unit.copy_(torch.from_numpy(np.where(mean > 0, mean, 1.0)))
        unit = self.unit.cpu().numpy().repeat(len(episodes.lengths) // seeds)
        self.replay.append(n_step(episodes, config.n_steps, config.discount, unit))

    def train(
        self,
        updates: int,
        states: Tensor,
        labels: Tensor | None,
        weights: Tensor | None,
        learning_rate: float,
    ) -> tuple[Tensor, Tensor]:
        """Minibatch steps of the temporal-difference loss and, beside it, of cross-entropy.

        Args:
            updates: how many steps.
            states: (M, obs) of the expert, the same for all seeds.
            labels: (S, M) the actions given for them; None learns from the transitions alone.
            weights: (S, M) of their cross-entropy; None where there are no labels.
            learning_rate: of these steps.

        Returns:
            (S,) mean temporal-difference loss over the steps, and mean cross-entropy, of labels
            without weight, too.
        """
        self._optimizer.learning_rate = learning_rate
        config, device = self.config, self.network.flat.device
        numbers = self._streams["replay batches"].uniform(updates, config.batch_size)
        slots = self._slots(numbers).to(device)
        numbers = self._streams["cloning batches"].uniform(updates, config.batch_size)
        shown = random_indices(numbers, np.full(len(numbers), len(states))).to(device)
        stored = self.replay.everything()
        totals = torch.zeros(2, len(self.unit), device=device)
        for update in range(updates):
            anchor: tuple[Tensor | None, ...] = (None, None, None)
            if labels is not None and weights is not None:
                chosen = shown[:, update]
                anchor = states[chosen], labels.gather(1, chosen), weights.gather(1, chosen)
            # A compiled graph refuses other strides than its first.
            at = slots[:, update].contiguous()
            _, *losses = self._descend(self.average.flat, stored, at, *anchor)
            totals += torch.stack([each.mean(dim=1) for each in losses])
            self.average.flat.lerp_(self.network.flat, config.tau)
        td_loss, cloning_loss = totals / max(updates, 1)
        return td_loss, cloning_loss

    def _slots(self, numbers: NDArray[np.float32]) -> Tensor:
        """Slots of the memory for uniform numbers (S, updates, B): half of the newest."""
        if self.recent is None:
            return random_indices(numbers, self.replay.sizes)
        whole, newest = np.split(numbers, [numbers.shape[-1] // 2], axis=-1)
        parts = random_indices(whole, self.replay.sizes), self.replay.newest(newest, self.recent)
        return torch.cat(parts, dim=-1)

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
        """What is descended, and its two parts; each (S, B).

        Args:
            parameters: of value and policy, by name.
            average: (S, P) parameters whose values are the targets.
            memory: (S, N, …) all transitions.
            slots: (S, B) those that are learnt from.
            states: (S, B, obs) of the expert; None leaves the second part out.
            labels: (S, B) their actions.
            weights: (S, B) of the second part.
        """
        architecture, config = self.network.architecture, self.config
        assert isinstance(architecture, Consistent)
        batch = memory.at(slots)
        values = architecture.forward(parameters, batch.observations)
        errors = taken(values, batch.actions) - self._targets(average, batch)
        td = td_losses(errors, config.loss)
        if states is None or labels is None or weights is None:
            return td, td, torch.zeros_like(td)
        logits = architecture.logits(parameters, states)
        # Cross-entropy; compiled together with the above, torch's own is rounded otherwise for
        # one seed alone than for several.
        cloning = logits.logsumexp(dim=-1) - taken(logits, labels)
        return td + weights * cloning, td, cloning

    @torch.no_grad()
    def _targets(self, average: Tensor, batch: Batch) -> Tensor:
        """(S, B) what the values of the actions taken are drawn to.

        An action that is not the best one is not drawn further than `gap` below the best: how bad
        it is need not be known, and π could say it by improbable logits alone.
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
        is_best = taken(here, batch.actions) >= best
        return torch.where(is_best, targets, torch.maximum(targets, best - config.gap))

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, replay, and random streams."""
        return {
            "network": self.network.flat,
            "average": self.average.flat,
            "unit": self.unit,
            "optimizer": self._optimizer.state_dict(),
            "replay": self.replay.state_dict(),
            "streams": {name: each.state_dict() for name, each in self._streams.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.network.flat.copy_(state["network"])
        self.average.flat.copy_(state["average"])
        self.unit.copy_(state["unit"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.replay.load_state_dict(state["replay"])
        for name, each in self._streams.items():
            each.load_state_dict(state["streams"][name])
