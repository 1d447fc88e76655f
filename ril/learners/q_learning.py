"""Q-learning on the policy's own episodes (§3.3, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, one_of, within
from ril.learners.td import td_errors, td_losses
from ril.vectorized.descent import descent
from ril.vectorized.networks import Network, Parameters, by_name
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class TemporalDifferenceConfig:
    """Q-learning from replay (eq. 1)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING
    discount: float = within(0, 1)
    loss: str = one_of("huber", "mse")


@dataclass
class TargetNetworkConfig(TemporalDifferenceConfig):
    """With a target network that is copied from time to time."""

    target_interval: int = at_least(0)


class QLearning:
    """S policies read as Q-functions, trained from replay.

    Args:
        policy: from obs features to |A| values.
        replay: each seed's memory, filled by the method.
        config: `method.q_learning`.
        streams: from which minibatches are drawn.
        priorities: of the memory's slots, which the method gives to new ones; None draws uniformly.
        double: whether the policy, not the target network, chooses the next action.
        fused: whether each step is one compiled graph; the same but for rounding.
    """

    def __init__(
        self,
        policy: Network,
        replay: Replay,
        config: TargetNetworkConfig,
        streams: Streams,
        *,
        priorities: Priorities | None = None,
        double: bool = False,
        fused: bool = False,
    ) -> None:
        self.policy = policy
        self.replay = replay
        self.config = config
        self.priorities = priorities
        self.double = double
        self._streams = streams
        self._target = policy.copy() if config.target_interval else policy
        self._optimizer = ClippedAdam(policy, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, fused=fused)

    def train(self, updates: int, beta: float = 1.0) -> Tensor:
        """Algorithm 1, line 13: minibatch steps of the temporal-difference loss.

        Args:
            updates: how many steps.
            beta: how much of the bias of prioritised draws is undone.

        Returns:
            (S,) mean loss over them.
        """
        config, device = self.config, self.policy.flat.device
        uniform = self._streams.uniform(updates, config.batch_size)
        memory = self.replay.everything()
        total = torch.zeros(len(uniform), device=device)
        for update in range(updates):
            if config.target_interval and self._optimizer.steps % config.target_interval == 0:
                self._target.flat.copy_(self.policy.flat)
            slots = self._draw(uniform[:, update])
            weights = None
            if self.priorities is not None:
                weights = self.priorities.importance(slots, self.replay.sizes, beta)
            _, losses, errors = self._descend(self._target.flat, memory, slots, weights)
            if self.priorities is not None:
                self.priorities.update(slots, errors)
            total += losses.mean(dim=1)
        return total / max(updates, 1)

    def _loss(
        self,
        parameters: Parameters,
        target: Tensor,
        memory: Batch,
        slots: Tensor,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What is descended, the losses that this weighs, and the errors δ; each (S, B).

        Args:
            parameters: the policy's, by name.
            target: (S, P) parameters of the target network.
            memory: (S, N, …) all transitions.
            slots: (S, B) those that are learnt from.
            weights: (S, B) how much each counts; None is 1.
        """
        architecture, config = self.policy.architecture, self.config
        errors = td_errors(
            partial(architecture.forward, parameters),
            partial(architecture.forward, by_name(architecture, target)),
            memory.at(slots),
            config.discount,
            double=self.double,
        )
        losses = td_losses(errors, config.loss)
        return losses if weights is None else weights * losses, losses, errors

    def _draw(self, uniform: NDArray[np.float32]) -> Tensor:
        """(S, B) random numbers in [0, 1) to as many filled slots."""
        if self.priorities is not None:
            return self.priorities.draw(uniform, self.replay.sizes)
        return random_indices(uniform, self.replay.sizes).to(self.policy.flat.device)

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, target network, replay, its priorities, and random streams."""
        state = {
            "optimizer": self._optimizer.state_dict(),
            "target": self._target.flat,
            "replay": self.replay.state_dict(),
            "streams": self._streams.state_dict(),
        }
        if self.priorities is not None:
            state["priorities"] = self.priorities.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self._optimizer.load_state_dict(state["optimizer"])
        self._target.flat.copy_(state["target"])
        self.replay.load_state_dict(state["replay"])
        self._streams.load_state_dict(state["streams"])
        if self.priorities is not None:
            self.priorities.load_state_dict(state["priorities"])
