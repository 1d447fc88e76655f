"""Self-supervised imitation (§3.2): the half of Algorithm 1 that sees the expert's states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.config.schema import GoalConfig, MethodConfig
from ril.environments.environment import Floats, Integers
from ril.environments.goal import reaches_goal
from ril.io.errors import UserError
from ril.learners.cloning import CloningConfig
from ril.learners.exploration import ExplorationConfig, exploration_ratio, sample_softmax
from ril.learners.goal_sampler import GoalSamplerConfig, Selection, select
from ril.learners.inverse_dynamics import InverseDynamics, InverseDynamicsConfig
from ril.learners.stopping import StoppingConfig, StoppingRule
from ril.learners.td import action_values
from ril.learners.topology import NetworkConfig, mlp
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Environments, Episodes
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


@dataclass
class ImitationConfig(MethodConfig):
    """Settings of self-supervised imitation; `method=iupe` has no others."""

    epochs: int = MISSING
    episodes: int = MISSING
    network: NetworkConfig = part(NetworkConfig)
    inverse_dynamics: InverseDynamicsConfig = part(InverseDynamicsConfig)
    cloning: CloningConfig = part(CloningConfig)
    exploration: ExplorationConfig = part(ExplorationConfig)
    goal_sampler: GoalSamplerConfig = part(GoalSamplerConfig)
    stopping: StoppingConfig = part(StoppingConfig)


_PRE_COPIES = 10  # copies of the environment, per seed, that fill I^pre
_CHUNK = 8192  # expert states of each seed that are passed through a network at once


class SelfSupervisedImitation(Stateful):
    """The inverse dynamics models, pseudo-labels, goal samplers and exploration of S agents.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
        policy: π_φ, which plays the episodes of I^pre and I^pos.

    Attributes:
        expert_states: (M, obs) the states s_t of the expert's trajectories T^e.
        pre: I^pre, transitions of the untrained policy.
        pos: I^pos, transitions of episodes that reached the goal.
        success_ratio: (S,) share of the last epoch's episodes that reached the goal.
        confidence: (S, M) probability that M_θ gives each of the newest pseudo-labels; not part of
            the checkpoint, since each epoch begins with new labels.
        stopping: the stopping rule, which knows the seeds that have stopped (line 6).

    Raises:
        UserError: the environment has no goal, or keys of `method.inverse_dynamics` contradict
            each other.
    """

    STATE = ("inverse_dynamics", "pre", "pos", "success_ratio", "stopping", "_streams")

    def __init__(self, config: ImitationConfig, task: Task, policy: Network) -> None:
        self.config = config
        self.task = task
        self.policy = policy
        environment, seeds = task.environment, task.seeds
        if environment.config.goal == GoalConfig():
            conditions = ", ".join(field.name for field in fields(GoalConfig))
            raise UserError(
                f"env.goal is empty: set one of {conditions}, so that ril knows which episodes "
                "succeed"
            )
        inputs = config.inverse_dynamics.inputs
        if config.inverse_dynamics.standardize == "change" and inputs != "change":
            raise UserError(
                "method.inverse_dynamics.standardize=change: needs inputs=change, not "
                f"inputs={inputs}; true scales all inputs, false none"
            )
        size, actions = environment.observation_size, environment.action_count
        self.inverse_dynamics = InverseDynamics(  # line 1: M_θ
            Network.initialize(
                mlp(config.network, 2 * size, actions), seeds, "inverse dynamics", task.device
            ),
            config.inverse_dynamics,
            Streams(seeds, "inverse dynamics batches"),
            compile_step=worth_compiling(
                task.compile, config.epochs * config.inverse_dynamics.updates
            ),
        )
        self.expert_states = torch.from_numpy(task.expert.observations).to(task.device)  # line 3
        self._expert_next = torch.from_numpy(task.expert.next_observations).to(task.device)
        capacity = config.goal_sampler.pre_steps_per_action * actions
        self.pre = Replay(len(seeds), capacity, size, task.device)
        self.pos = Replay(len(seeds), capacity, size, task.device)
        self.success_ratio = np.zeros(len(seeds))
        self.confidence = torch.zeros(len(seeds), len(self.expert_states), device=task.device)
        self.stopping = StoppingRule(config.stopping, len(seeds))
        self._streams = {
            purpose: Streams(seeds, purpose)
            for purpose in ("pre", "labels", "exploration ratio", "goal sampler")
        }

    def generate_pre(self) -> None:
        """Fill I^pre with steps of the untrained policy, sampled from its softmax (lines 4–5)."""
        if self.pre.sizes.any():
            return
        environments = Environments(self.task.environment, len(self.task.seeds) * _PRE_COPIES)
        steps, streams = self.task.environment.max_episode_steps, self._streams["pre"]
        infer = self.policy.frozen()
        while (unfilled := self.pre.sizes < self.pre.capacity).any():
            uniform = torch.from_numpy(streams.uniform(steps, _PRE_COPIES)).to(self.task.device)

            def act(observations: Floats, step: int, uniform: Tensor = uniform) -> Integers:
                sampled = sample_softmax(infer(observations), uniform[:, step])
                return sampled.flatten().cpu().numpy()

            episodes = environments.play(act, streams.integers(2**31, _PRE_COPIES).ravel())
            self.pre.append(episodes, keep=np.repeat(unfilled, _PRE_COPIES))
        if self.config.inverse_dynamics.standardize:
            self.inverse_dynamics.standardize(self.pre.everything())

    def sample_dataset(self, limit: float) -> Selection:
        """Compose I^s of I^pre and I^pos (line 14 of the previous epoch).

        Args:
            limit: the largest share of I^pos that may enter I^s (eq. 2); 1 for no limit.

        Returns:
            The transitions of I^s, chosen for each seed.
        """
        uniform = self._streams["goal sampler"].uniform(self.pre.capacity + self.pos.capacity)
        share = np.minimum(limit, self.success_ratio)
        actions = self.task.environment.action_count
        keep_pre = self.config.goal_sampler.keep_pre
        return select(self.pre, self.pos, share, actions, uniform, keep_pre=keep_pre)

    def train(self, dataset: Selection) -> Tensor:
        """Train M_θ on I^s (line 7); return each seed's mean loss (S,)."""
        return self.inverse_dynamics.train(dataset)

    @torch.no_grad()
    def infer_actions(self) -> Tensor:
        """Label the expert's transitions (line 8); return Â (S, M).

        A label is the most likely action by M_θ, or a draw from its softmax
        (`inverse_dynamics.labels`).
        """
        states, following = self._for_all_seeds(self.expert_states, self._expert_next)
        chunks = zip(_chunks(states), _chunks(following), strict=True)
        logits = torch.cat([self.inverse_dynamics(*chunk) for chunk in chunks], dim=1)
        if self.config.inverse_dynamics.labels == "argmax":
            labels = logits.argmax(dim=-1)
        else:
            uniform = self._streams["labels"].uniform(logits.shape[1])
            labels = sample_softmax(logits, torch.from_numpy(uniform).to(logits.device))
        self.confidence = action_values(logits.softmax(dim=-1), labels)
        return labels

    @torch.no_grad()
    def epsilon(self, cloning_loss: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Apply the stopping rule, and return each seed's probability of exploring.

        Args:
            cloning_loss: (S,) mean loss of this epoch's cloning; None without cloning, which
                skips the stopping rule.

        Returns:
            (S,) `exploration.epsilon`; if that is null, the policy's exploration ratio (§3.4).
        """
        (states,) = self._for_all_seeds(self.expert_states)
        logits = torch.cat([self.policy(x) for x in _chunks(states)], dim=1)
        if cloning_loss is not None:
            self.stopping.update(logits.argmax(dim=-1).cpu().numpy(), cloning_loss)
        if self.config.exploration.epsilon is not None:
            return np.full(len(self.task.seeds), self.config.exploration.epsilon)
        uniform = self._streams["exploration ratio"].uniform(len(self.expert_states))
        return exploration_ratio(logits, uniform)

    def remember(self, played: Sequence[Episodes]) -> dict[str, NDArray[np.float64]]:
        """Append the episodes that reached the goal to I^pos (line 12).

        Args:
            played: this epoch's episodes; each entry holds equally many of every seed, in the
                order of the seeds.

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
        self.success_ratio = np.concatenate(goals, axis=1).mean(axis=1)
        accuracy = np.concatenate(accuracies, axis=1).mean(axis=1)
        return {"goals": self.success_ratio, "inverse_dynamics_accuracy": accuracy}

    def _accuracy(self, episodes: Episodes) -> NDArray[np.float64]:
        """Return (S·N,) the share of each episode's actions that M_θ infers correctly."""
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
        """Expand each (M, obs) to (S, M, obs) without copying."""
        return [x.expand(len(self.task.seeds), *x.shape) for x in shared]


def _chunks(x: Tensor) -> list[Tensor]:
    """Split (S, M, obs) along M, so that activations of many trajectories fit in memory."""
    return [x[:, start : start + _CHUNK] for start in range(0, x.shape[1], _CHUNK)]
