"""Self-supervised imitation (§3.2): the half of Algorithm 1 that sees the expert's states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.config.schema import GoalConfig, MethodConfig
from ril.environments import Floats, Integers, reaches_goal
from ril.io.errors import UserError
from ril.learners.cloning import Cloning, CloningConfig
from ril.learners.exploration import ExplorationConfig, exploration_ratio, sample_softmax
from ril.learners.goal_sampler import GoalSamplerConfig, select
from ril.learners.inverse_dynamics import InverseDynamics, InverseDynamicsConfig
from ril.learners.stopping import StoppingConfig, StoppingRule
from ril.learners.td import taken
from ril.learners.topology import NetworkConfig, mlp
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Environments, Episodes
from ril.vectorized.streams import Streams


@dataclass
class ImitationConfig(MethodConfig):
    """What self-supervised imitation needs; all that `method=iupe` has."""

    epochs: int = MISSING
    episodes: int = MISSING
    network: NetworkConfig = part(NetworkConfig)
    inverse_dynamics: InverseDynamicsConfig = part(InverseDynamicsConfig)
    cloning: CloningConfig = part(CloningConfig)
    exploration: ExplorationConfig = part(ExplorationConfig)
    goal_sampler: GoalSamplerConfig = part(GoalSamplerConfig)
    stopping: StoppingConfig = part(StoppingConfig)


_PRE_COPIES = 10  # environments per seed that fill I^pre side by side
_CHUNK = 8192  # expert states of each seed that go through a network at once

Metrics = dict[str, NDArray[np.float64]]


class SelfSupervisedImitation:
    """S agents' inverse dynamics, pseudo-labels, cloning and goal sampler.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
        policy: π_φ, which is cloned and has labels from what it does.

    Attributes:
        confidence: (S, M) probability of each of the newest pseudo-labels by M_θ; 0 before the
            first, and not saved, as each epoch makes it anew.
    """

    def __init__(self, config: ImitationConfig, task: Task, policy: Network) -> None:
        self.config = config
        self.task = task
        self.policy = policy
        environment, seeds = task.environment, task.seeds
        if environment.config.goal == GoalConfig():
            conditions = ", ".join(field.name for field in fields(GoalConfig))
            raise UserError(f"env.goal: says of no episode that it succeeds; give {conditions}")
        inputs = config.inverse_dynamics.inputs
        if config.inverse_dynamics.standardise == "change" and inputs != "change":
            raise UserError(
                f"method.inverse_dynamics.standardise=change: inputs={inputs} have no change; "
                "true scales all inputs, false none"
            )
        size, actions = environment.observation_size, environment.action_count

        self.inverse_dynamics = InverseDynamics(  # line 1: M_θ
            Network.initialise(
                mlp(config.network, 2 * size, actions), seeds, "inverse dynamics", task.device
            ),
            config.inverse_dynamics,
            Streams(seeds, "inverse dynamics batches"),
            fused=worth_compiling(task.compile, config.epochs * config.inverse_dynamics.updates),
        )
        self.expert_states = torch.from_numpy(task.expert.observations).to(task.device)  # line 3
        self.expert_next = torch.from_numpy(task.expert.next_observations).to(task.device)
        self.cloning = Cloning(
            policy,
            config.cloning,
            Streams(seeds, "cloning batches"),
            fused=worth_compiling(task.compile, config.epochs * config.cloning.updates),
        )
        capacity = config.goal_sampler.pre_steps_per_action * actions
        self.pre = Replay(len(seeds), capacity, size, task.device)
        self.pos = Replay(len(seeds), capacity, size, task.device)
        self.positive_share = np.zeros(len(seeds))
        self.confidence = torch.zeros(len(seeds), len(self.expert_states), device=task.device)
        self.stopping = StoppingRule(config.stopping, len(seeds))
        self._streams = {
            purpose: Streams(seeds, purpose)
            for purpose in ("pre", "labels", "exploration ratio", "goal sampler")
        }

    def generate_pre(self) -> None:
        """Lines 4–5: fill I^pre with what the untrained policy does, sampled from its softmax."""
        if self.pre.sizes.any():
            return
        environments = Environments(self.task.environment, len(self.task.seeds) * _PRE_COPIES)
        steps, streams = self.task.environment.max_episode_steps, self._streams["pre"]
        while (unfilled := self.pre.sizes < self.pre.capacity).any():
            uniform = torch.from_numpy(streams.uniform(steps, _PRE_COPIES)).to(self.task.device)

            def act(observations: Floats, step: int, uniform: Tensor = uniform) -> Integers:
                sampled = sample_softmax(self.policy.infer(observations), uniform[:, step])
                return sampled.flatten().cpu().numpy()

            episodes = environments.play(act, streams.integers(2**31, _PRE_COPIES).ravel())
            self.pre.append(episodes, keep=np.repeat(unfilled, _PRE_COPIES))
        if self.config.inverse_dynamics.standardise:
            self.inverse_dynamics.standardise(self.pre.everything())

    def train(self, limit: float) -> tuple[Metrics, NDArray[np.int64]]:
        """Lines 14 (of the epoch before) and 7 to 9; as `infer_actions`, then `clone`."""
        metrics, labels = self.infer_actions(limit)
        metrics["cloning_loss"] = self.clone(labels)
        return metrics, labels.cpu().numpy()

    def infer_actions(self, limit: float) -> tuple[Metrics, Tensor]:
        """Lines 14 (of the epoch before), 7 and 8.

        Args:
            limit: the most of I^pos that may enter I^s, by eq. 2; 1 is no limit.

        Returns:
            Diagnostics by name, each (S,), and the pseudo-labels Â (S, M).
        """
        uniform = self._streams["goal sampler"].uniform(self.pre.capacity + self.pos.capacity)
        share = np.minimum(limit, self.positive_share)
        actions = self.task.environment.action_count
        keep_pre = self.config.goal_sampler.keep_pre
        dataset = select(  # line 14: I^s
            self.pre, self.pos, share, actions, uniform, keep_pre=keep_pre
        )
        inverse_dynamics_loss = self.inverse_dynamics.train(dataset)  # line 7
        metrics = {"inverse_dynamics_loss": inverse_dynamics_loss.double().cpu().numpy()}
        return metrics, self._label()  # line 8: Â

    def clone(self, labels: Tensor) -> NDArray[np.float64]:
        """Line 9: the policy learns labels (S, M); its (S,) mean loss."""
        return self.cloning.train(self.expert_states, labels).double().cpu().numpy()

    def _label(self) -> Tensor:
        """Line 8: (S, M) pseudo-labels Â, the likeliest or drawn from M_θ's softmax."""
        states, following = self._for_all_seeds(self.expert_states, self.expert_next)
        chunks = zip(_chunks(states), _chunks(following), strict=True)
        with torch.no_grad():
            logits = torch.cat([self.inverse_dynamics(*chunk) for chunk in chunks], dim=1)
        if self.config.inverse_dynamics.labels == "argmax":
            labels = logits.argmax(dim=-1)
        else:
            uniform = self._streams["labels"].uniform(logits.shape[1])
            labels = sample_softmax(logits, torch.from_numpy(uniform).to(logits.device))
        self.confidence = taken(logits.softmax(dim=-1), labels)
        return labels

    def look_at_expert(self, cloning_loss: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """What the policy makes of the expert's states: whether to stop, and how much to explore.

        Args:
            cloning_loss: (S,) of this epoch, for the stopping rule; None leaves it alone.

        Returns:
            (S,) ε: the policy's own exploration ratio (§3.4), or `exploration.epsilon`.
        """
        with torch.no_grad():
            (states,) = self._for_all_seeds(self.expert_states)
            logits = torch.cat([self.policy(x) for x in _chunks(states)], dim=1)
        if cloning_loss is not None:
            self.stopping.update(logits.argmax(dim=-1).cpu().numpy(), cloning_loss)
        if self.config.exploration.epsilon is not None:
            return np.full(len(self.task.seeds), self.config.exploration.epsilon)
        uniform = self._streams["exploration ratio"].uniform(len(self.expert_states))
        return exploration_ratio(logits, uniform)

    def remember(self, played: Sequence[Episodes]) -> Metrics:
        """Line 12: append to I^pos what reached the goal.

        Args:
            played: this epoch's episodes; in each of these, as many of every seed, side by side.

        Returns:
            Diagnostics by name, each (S,).
        """
        if self.config.goal_sampler.memory == "epoch":
            self.pos.clear()
        seeds = len(self.task.seeds)
        goals, accuracies = [], []
        for episodes in played:
            goal = reaches_goal(
                self.task.environment.config.goal,
                returns=episodes.returns,
                final_rewards=episodes.final_rewards,
                terminated=episodes.ends,
            )
            if self.config.goal_sampler.memory != "none":
                self.pos.append(episodes, keep=goal)
            goals.append(goal.reshape(seeds, -1))
            accuracies.append(self._accuracy(episodes).reshape(seeds, -1))
        self.positive_share = np.concatenate(goals, axis=1).mean(axis=1)
        accuracy = np.concatenate(accuracies, axis=1).mean(axis=1)
        return {"goals": self.positive_share, "inverse_dynamics_accuracy": accuracy}

    def _accuracy(self, episodes: Episodes) -> NDArray[np.float64]:
        """(S·N,) share of each own episode's actions that M_θ infers from its states."""
        size = episodes.observations.shape[-1]
        states, following = (
            torch.from_numpy(x).to(self.task.device).reshape(len(self.task.seeds), -1, size)
            for x in (episodes.observations, episodes.next_observations)
        )
        labels = self.inverse_dynamics.label(states, following).view(episodes.actions.shape)
        steps = np.arange(episodes.actions.shape[1]) < episodes.lengths[:, None]
        right = (labels.cpu().numpy() == episodes.actions) & steps
        accuracy: NDArray[np.float64] = right.sum(axis=1) / episodes.lengths
        return accuracy

    def _for_all_seeds(self, *shared: Tensor) -> list[Tensor]:
        """Each (M, obs) to (S, M, obs), without copying."""
        return [x.expand(len(self.task.seeds), *x.shape) for x in shared]

    def _stateful(self) -> dict[str, Any]:
        """The parts that keep state of their own, by name."""
        return {
            "inverse_dynamics": self.inverse_dynamics,
            "cloning": self.cloning,
            "pre": self.pre,
            "pos": self.pos,
            "stopping": self.stopping,
            **{f"{purpose} stream": streams for purpose, streams in self._streams.items()},
        }

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on; the policy belongs to the method."""
        parts = {name: part.state_dict() for name, part in self._stateful().items()}
        return {"positive_share": self.positive_share.tolist(), "parts": parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.positive_share = np.array(state["positive_share"])
        for name, part in self._stateful().items():
            part.load_state_dict(state["parts"][name])


def _chunks(x: Tensor) -> list[Tensor]:
    """(S, M, obs) in parts along M, so that activations of many trajectories fit in memory."""
    return [x[:, start : start + _CHUNK] for start in range(0, x.shape[1], _CHUNK)]
