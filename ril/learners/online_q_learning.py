"""Q-learning while acting: S seeds step their environments side by side and learn as they go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import at_least, part, within
from ril.environments import Floats, Integers
from ril.io.errors import UserError
from ril.learners.exploration import sample_softmax
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Replay
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams


@dataclass
class ReplayConfig:
    """What is remembered, and what is drawn of it."""

    capacity: int | None = MISSING
    alpha: float = at_least(0)
    beta: float = within(0, 1)


@dataclass
class OnlineQLearningConfig(TargetNetworkConfig):
    """Q-learning while acting, for a number of steps."""

    double: bool = MISSING
    train_freq: int = MISSING
    learning_starts: int = at_least(0)
    replay: ReplayConfig = part(ReplayConfig)


Metrics = dict[str, NDArray[np.float64]]
EPOCHS = 1000  # into which methods cut a budget, for looks, checkpoints and display


class OnlineQLearning:
    """S agents that act ε-greedily and, every few steps, learn from their replay memories.

    Args:
        config: `method.q_learning`.
        task: environment and seeds.
        policy: that acts, read as a Q-function.
        kind: what exploring draws from, softmax or uniform (`learners/exploration.py`).
        total_steps: of each seed; prioritised replay undoes all of its bias at the last.
        purpose: of the random numbers by which it explores.

    Attributes:
        steps: that each seed has taken.
    """

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
        self.kind = kind
        self.total_steps = total_steps
        self.steps = 0
        environment, seeds, replay = task.environment, task.seeds, config.replay
        if replay.capacity is None:
            raise UserError("method.q_learning.replay.capacity=null: must be given")
        self._environments = SteppedEnvironments(environment, seeds, 1, "online q-learning")
        updates = config.updates * (total_steps // config.train_freq)
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
            fused=worth_compiling(task.compile, updates),
        )
        self._action_count = environment.action_count
        self._exploration = Streams(seeds, purpose)
        self._returns = np.zeros(len(seeds))  # of the episodes under way
        self._last_returns = np.full(len(seeds), np.nan)  # of the last that ended

    def advance(self, until: int, epsilon: NDArray[np.float64]) -> Metrics:
        """Act and learn until each seed has taken so many steps.

        Args:
            until: T steps more than have been taken.
            epsilon: (T, S) chances to explore.

        Returns:
            Diagnostics by name, each (S,): NaN where nothing was learnt, or no episode has ended.
        """
        chance, choice = self._exploration.uniform(until - self.steps, 2).transpose(2, 1, 0)
        explores = chance < epsilon
        losses = [torch.full((len(epsilon[0]),), torch.nan)]
        for exploring, number in zip(explores, choice, strict=True):
            self._act(exploring, number)
            self.steps += 1
            due = self.steps % self.config.train_freq == 0
            if due and self.steps > self.config.learning_starts:
                losses.append(self.learner.train(self.config.updates, self._beta()).cpu())
        return {
            "td_loss": torch.stack(losses, dim=1).nanmean(dim=1).double().numpy(),
            "training_return": self._last_returns.copy(),
            "epsilon": epsilon[-1],
        }

    def _act(self, exploring: NDArray[np.bool_], number: NDArray[np.float32]) -> None:
        """One step of every seed's environment, remembered."""
        before = self._environments.observations
        actions = self._choose(before, exploring, number)
        step = self._environments.step(actions)
        slots = self.learner.replay.add(
            before, actions, step.rewards, step.next_observations, step.terminated
        )
        if self.learner.priorities is not None:
            self.learner.priorities.add(slots)
        self._returns += step.rewards
        over = step.terminated | step.truncated
        if over.any():
            self._last_returns[over] = self._returns[over]
            self._returns[over] = 0

    def _choose(
        self, observations: Floats, exploring: NDArray[np.bool_], number: NDArray[np.float32]
    ) -> Integers:
        """(S,) actions: greedy, or, where exploring, by random numbers (S,) in [0, 1)."""
        values = self.policy.infer(observations)[:, 0]
        greedy: Integers = values.argmax(dim=-1).cpu().numpy()
        if not exploring.any():
            return greedy
        if self.kind == "uniform":
            other = (number * self._action_count).astype(np.int64)
        else:
            uniform = torch.from_numpy(number).to(values.device)
            other = sample_softmax(values, uniform).cpu().numpy()
        return np.where(exploring, other, greedy)

    def _beta(self) -> float:
        """β, which rises to 1 along a straight line (Schaul et al., 2015, §3.4)."""
        least = self.config.replay.beta
        return least + (1 - least) * min(1.0, self.steps / self.total_steps)

    def state_dict(self) -> dict[str, Any]:
        """All that the next step depends on; the policy belongs to the method."""
        return {
            "steps": self.steps,
            "learner": self.learner.state_dict(),
            "environments": self._environments.state_dict(),
            "exploration": self._exploration.state_dict(),
            "returns": self._returns.tolist(),
            "last_returns": self._last_returns.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.steps = state["steps"]
        self.learner.load_state_dict(state["learner"])
        self._environments.load_state_dict(state["environments"])
        self._exploration.load_state_dict(state["exploration"])
        self._returns = np.array(state["returns"])
        self._last_returns = np.array(state["last_returns"])
