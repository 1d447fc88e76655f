"""Online Q-learning: S agents step their environments side by side and train every few steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, part, within
from ril.io.errors import UserError
from ril.learners.acting import acting
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Replay
from ril.vectorized.state import Stateful
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams


@dataclass
class ReplayConfig:
    """The replay memory, and the distribution of draws from it."""

    capacity: int | None = MISSING
    alpha: float = at_least(0)
    beta: float = within(0, 1)


@dataclass
class OnlineQLearningConfig(TargetNetworkConfig):
    """Online Q-learning."""

    double: bool = MISSING
    train_freq: int = MISSING
    learning_starts: int = at_least(0)
    replay: ReplayConfig = part(ReplayConfig)


Metrics = dict[str, NDArray[np.float64]]
EPOCHS = 1000  # parts of a budget, after each of which a method yields to the run


class OnlineQLearning(Stateful):
    """S agents that act ε-greedily and, every few steps, train on their replay memories.

    The policy is not part of the state, since the methods save it.

    Args:
        config: `method.q_learning`.
        task: environment and seeds.
        policy: acts; its outputs are Q-values.
        kind: distribution of exploring actions, "softmax" or "uniform".
        total_steps: budget of each seed, over which prioritized replay raises β to 1.
        purpose: name of the random streams for exploration.

    Attributes:
        steps: environment steps of each seed so far.

    Raises:
        UserError: the replay memory's capacity is not given, or does not fit into memory.
    """

    STATE: ClassVar = (
        "steps",
        "learner",
        "_environments",
        "_exploration",
        "_returns",
        "_last_returns",
    )

    def __init__(
        self,
        config: OnlineQLearningConfig,
        task: Task,
        policy: Network,
        kind: str,
        total_steps: int,
        purpose: str = "exploration",
    ) -> None:
        self.config = config
        self.policy = policy
        self.total_steps = total_steps
        self.steps = 0
        environment, seeds, replay = task.environment, task.seeds, config.replay
        self._device = task.device
        if replay.capacity is None:
            raise UserError(
                "method.q_learning.replay.capacity=null: must be a number of transitions"
            )
        self._environments = SteppedEnvironments(environment, seeds, 1, "online q-learning")
        updates = config.updates * (total_steps // config.train_freq)
        compiled = worth_compiling(task.compile, updates)
        priorities = None
        if replay.alpha > 0:
            priorities = Priorities(len(seeds), replay.capacity, replay.alpha, task.device)
        try:
            memory = Replay(len(seeds), replay.capacity, environment.observation_size, task.device)
        except RuntimeError:
            raise UserError(
                f"method.q_learning.replay.capacity={replay.capacity}: does not fit into memory"
            ) from None
        self.learner = QLearning(
            policy,
            memory,
            config,
            Streams(seeds, "replay batches"),
            priorities=priorities,
            double=config.double,
            compile_step=compiled,
        )
        self._choose = acting(policy, kind, compiled=compiled)
        self._exploration = Streams(seeds, purpose)
        self._returns = np.zeros(len(seeds))  # of the current episodes, so far
        self._last_returns = np.full(len(seeds), np.nan)  # of the last finished ones

    def advance(self, until: int, epsilon: NDArray[np.float64]) -> Metrics:
        """Act and train until each seed has made `until` environment steps.

        Args:
            until: T more than `steps`.
            epsilon: (T, S) probabilities to explore.

        Returns:
            Diagnostics by name, (S,) each; NaN without any update, or before a first episode ends.
        """
        uniform = self._exploration.uniform(until - self.steps, 2).transpose(1, 2, 0)
        choices = torch.from_numpy(np.ascontiguousarray(uniform)[..., None]).to(self._device)
        chances = torch.from_numpy(np.ascontiguousarray(epsilon)).to(self._device)
        losses = [torch.full((len(epsilon[0]),), torch.nan)]
        stored: list[int] = []  # slots of new transitions, not yet given their priority
        updates = self.config.updates
        trainings = sum(map(self._is_due, range(self.steps + 1, until + 1)))
        numbers = self.learner.draw(trainings * updates)
        minibatches = iter(numbers.view(trainings, updates, *numbers.shape[1:]).unbind())
        for chance, of_step in zip(chances.unbind(), choices.unbind(), strict=True):
            stored.append(self._act(chance, of_step))
            self.steps += 1
            if self._is_due(self.steps):
                self._prioritize(stored)
                losses.append(self.learner.train_on(next(minibatches), self._beta()).cpu())
        self._prioritize(stored)
        return {
            "td_loss": torch.stack(losses, dim=1).nanmean(dim=1).double().numpy(),
            "training_return": self._last_returns.copy(),
            "epsilon": epsilon[-1],
        }

    def _is_due(self, steps: int) -> bool:
        """Return whether the agents train after so many steps."""
        return steps % self.config.train_freq == 0 and steps > self.config.learning_starts

    def _act(self, epsilon: Tensor, uniform: Tensor) -> int:
        """Step every seed's environment once, store the transitions, and return their slot.

        Args:
            epsilon: (S,) probabilities to explore.
            uniform: (2, S, 1) random numbers in [0, 1), as for `epsilon_greedy`.
        """
        before = self._environments.observations
        actions = self._choose(before, epsilon, uniform)
        step = self._environments.step(actions)
        slot = self.learner.replay.add(
            before, actions, step.rewards, step.next_observations, step.terminated
        )
        self._returns += step.rewards
        over = step.terminated | step.truncated
        if over.any():
            self._last_returns[over] = self._returns[over]
            self._returns[over] = 0
        return slot

    def _prioritize(self, stored: list[int]) -> None:
        """Give new transitions their priority, all at once, and clear the list of their slots."""
        if self.learner.priorities is not None and stored:
            slots = torch.tensor(stored, device=self._device)
            self.learner.priorities.add(slots.expand(len(self._returns), -1))
        stored.clear()

    def _beta(self) -> float:
        """Compute β, which rises linearly to 1 (Schaul et al., 2015, §3.4)."""
        initial = self.config.replay.beta
        return initial + (1 - initial) * min(1.0, self.steps / self.total_steps)
