"""Q-learning from replay memories (§3.3, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, one_of, within
from ril.learners.td import td_errors, td_losses
from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.networks import Network, Parameters, by_name
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.state import Stateful
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
    """Q-learning with a target network."""

    target_interval: int = at_least(0)


class QLearning(Stateful):
    """Trains S policies, whose outputs are Q-values, on their replay memories.

    The policy is not part of the state, since the methods save it.

    Args:
        policy: π_φ, from obs features to |A| values.
        replay: each seed's memory; the caller fills it.
        config: `method.q_learning`.
        streams: random streams that draw the minibatches.
        priorities: priorities of the memory's slots, to which the caller adds new transitions;
            None for uniform sampling.
        double: whether the policy instead of the target network chooses the next action.
        compile_step: whether each step is one compiled graph, which differs in the last bits.
    """

    STATE: ClassVar = ("_optimizer", "_target", "replay", "_streams", "priorities")

    def __init__(
        self,
        policy: Network,
        replay: Replay,
        config: TargetNetworkConfig,
        streams: Streams,
        *,
        priorities: Priorities | None = None,
        double: bool = False,
        compile_step: bool = False,
    ) -> None:
        self.policy = policy
        self.replay = replay
        self.config = config
        self.priorities = priorities
        self.double = double
        self._streams = streams
        self._target = policy.copy() if config.target_interval else policy
        self._optimizer = ClippedAdam(policy, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, compile_step=compile_step)

    def train(self, updates: int, beta: float = 1.0) -> Tensor:
        """Take minibatch steps of the temporal-difference loss (Algorithm 1, line 13).

        Args:
            updates: number of steps, at least 1.
            beta: β in [0, 1], how much of the bias of prioritized draws is corrected.

        Returns:
            (S,) mean loss over the steps, unweighted.
        """
        config = self.config
        uniform = self._streams.uniform(updates, config.batch_size)
        memory = self.replay.everything()

        def step(uniform: NDArray[np.float32]) -> Tensor:
            if config.target_interval and self._optimizer.steps % config.target_interval == 0:
                self._target.flat.copy_(self.policy.flat)
            slots = self._draw(uniform)
            weights = None
            if self.priorities is not None:
                weights = self.priorities.importance(slots, self.replay.sizes, beta)
            _, losses, errors = self._descend(self._target.flat, memory, slots, weights)
            if self.priorities is not None:
                self.priorities.update(slots, errors)
            return losses.mean(dim=1)

        return train_on_minibatches(step, uniform.swapaxes(0, 1))

    def _loss(
        self,
        parameters: Parameters,
        target: Tensor,
        memory: Batch,
        slots: Tensor,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the weighted losses, the unweighted losses and the errors δ, (S, B) each.

        Args:
            parameters: parameters of the policy, by name.
            target: (S, P) parameters of the target network.
            memory: (S, N, …) all stored transitions.
            slots: (S, B) the transitions to train on.
            weights: (S, B) weights of the losses; None is 1.
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
        """Turn random numbers (S, B) in [0, 1) into filled slots (S, B)."""
        if self.priorities is not None:
            return self.priorities.draw(uniform, self.replay.sizes)
        return random_indices(uniform, self.replay.sizes).to(self.policy.flat.device)
