"""Q-learning from replay memories (§3.3, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, one_of, within
from ril.learners.td import td_errors, td_losses
from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.layers import Parameters
from ril.vectorized.networks import Network, by_name
from ril.vectorized.priorities import Levels, Priorities, draw, importance
from ril.vectorized.replay import Batch, Replay, indices_below
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
        loss = self._uniform_loss if priorities is None else self._prioritized_loss
        self._descend = descent(self._optimizer, loss, compile_step=compile_step)

    def train(self, updates: int, beta: float = 1.0) -> Tensor:
        """Take minibatch steps of the temporal-difference loss (Algorithm 1, line 13).

        Args:
            updates: number of steps, at least 1.
            beta: β in [0, 1], how much of the bias of prioritized draws is corrected.

        Returns:
            (S,) mean loss over the steps, unweighted.
        """
        return self.train_on(self.draw(updates), beta)

    def draw(self, updates: int) -> Tensor:
        """Draw the random numbers (updates, S, B) in [0, 1) that choose minibatches."""
        uniform = self._streams.uniform(updates, self.config.batch_size)
        return torch.from_numpy(uniform.swapaxes(0, 1).copy()).to(self.policy.flat.device)

    def train_on(self, uniform: Tensor, beta: float = 1.0) -> Tensor:
        """Do what `train` does, with numbers (updates, S, B) that `draw` returned."""
        config, device = self.config, self.policy.flat.device
        also: list[Any] = [torch.from_numpy(self.replay.sizes).to(device)]
        if self.priorities is not None:
            exponent = torch.tensor([beta], dtype=torch.float64, device=device)
            also += [self.priorities.levels, exponent]
        memory = self.replay.everything()

        def step(of_step: Tensor) -> Tensor:
            if config.target_interval and self._optimizer.steps % config.target_interval == 0:
                self._target.flat.copy_(self.policy.flat)
            _, losses, errors, slots = self._descend(self._target.flat, memory, of_step, *also)
            if self.priorities is not None:
                # Not in the graph: there, the rounding of powers would depend on S.
                self.priorities.update(slots, errors)
            return losses.mean(dim=1)

        return train_on_minibatches(step, uniform.unbind())

    def _uniform_loss(
        self, parameters: Parameters, target: Tensor, memory: Batch, uniform: Tensor, sizes: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw transitions, all equally likely, and compute what `_loss` does.

        Args:
            parameters: parameters of the policy, by name.
            target: (S, P) parameters of the target network.
            memory: (S, N, …) all stored transitions.
            uniform: (S, B) random numbers in [0, 1).
            sizes: (S,) filled slots.
        """
        return self._loss(parameters, target, memory, indices_below(sizes, uniform))

    def _loss(
        self, parameters: Parameters, target: Tensor, memory: Batch, slots: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Compute the losses, twice, the errors δ and the slots, (S, B) each.

        Args:
            parameters: parameters of the policy, by name.
            target: (S, P) parameters of the target network.
            memory: (S, N, …) all stored transitions.
            slots: (S, B) the transitions to train on.
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
        return losses, losses, errors, slots

    def _prioritized_loss(
        self,
        parameters: Parameters,
        target: Tensor,
        memory: Batch,
        uniform: Tensor,
        sizes: Tensor,
        levels: Levels,
        beta: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw transitions by priority, and compute their losses by importance.

        Args:
            parameters: parameters of the policy, by name.
            target: (S, P) parameters of the target network.
            memory: (S, N, …) all stored transitions.
            uniform: (S, B) random numbers in [0, 1).
            sizes: (S,) filled slots.
            levels: the sum tree of the priorities.
            beta: β, (1,).

        Returns:
            The weighted losses, the unweighted losses, the errors δ and the slots drawn, (S, B)
            each.
        """
        slots = draw(levels, uniform, sizes)
        weights = importance(levels, slots, sizes, beta)
        losses, _, errors, _ = self._loss(parameters, target, memory, slots)
        return weights * losses, losses, errors, slots
