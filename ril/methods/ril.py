"""Reinforced Imitation Learning: Algorithm 1, with its line numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.config import GoalConfig, RILConfig
from ril.environments import Floats, reaches_goal
from ril.errors import UserError
from ril.learners.cloning import Cloning, exploration_ratio
from ril.learners.goal_sampler import Selection, positive_limit, select
from ril.learners.inverse_dynamics import InverseDynamics
from ril.learners.q_learning import QLearning, explore, sample_softmax
from ril.methods.base import Progress, Task
from ril.methods.stopping import StoppingRule
from ril.vectorized.networks import Architecture, Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Environments, Episodes, Integers
from ril.vectorized.streams import Streams

_PRE_COPIES = 10  # environments per seed that fill I^pre side by side


class RIL:
    """S agents that imitate one expert's states and correct themselves by Q-learning.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
    """

    def __init__(self, config: RILConfig, task: Task) -> None:
        if not (config.imitation or config.reinforcement):
            raise UserError(
                "method.imitation=false method.reinforcement=false: nothing would learn"
            )
        if task.environment.config.goal == GoalConfig():
            conditions = ", ".join(field.name for field in fields(GoalConfig))
            raise UserError(f"env.goal: says of no episode that it succeeds; give {conditions}")
        self.config = config
        self.task = task
        environment, seeds = task.environment, task.seeds
        size, actions = environment.observation_size, environment.action_count

        def network(purpose: str, inputs: int) -> Network:
            shape = config.network
            hidden = tuple(shape.hidden)
            architecture = Architecture(
                inputs, hidden, actions, shape.attention, shape.layer_norm, shape.negative_slope
            )
            return Network.initialise(architecture, seeds, purpose, task.device)

        def replay(capacity: int) -> Replay:
            return Replay(len(seeds), capacity, size, task.device)

        self.inverse_dynamics = InverseDynamics(  # line 1: M_θ
            network("inverse dynamics", 2 * size),
            config.inverse_dynamics,
            Streams(seeds, "inverse dynamics batches"),
        )
        self.policy = network("policy", size)  # line 2: π_φ
        self.expert_states = torch.from_numpy(task.expert.observations).to(task.device)  # line 3
        self.expert_next = torch.from_numpy(task.expert.next_observations).to(task.device)

        self.cloning = Cloning(self.policy, config.cloning, Streams(seeds, "cloning batches"))
        memory = round(config.q_learning.replay_trajectories * task.expert.mean_length)
        self.q_learning = QLearning(
            self.policy, replay(max(memory, 1)), config.q_learning, Streams(seeds, "replay batches")
        )
        pre_steps = config.goal_sampler.pre_steps_per_action * actions
        self.pre, self.pos = replay(pre_steps), replay(pre_steps)
        self.environments = Environments(environment, len(seeds))
        self.stopping = StoppingRule(config.stopping, len(seeds))
        self._streams = {
            purpose: Streams(seeds, purpose)
            for purpose in ("pre", "resets", "exploration", "exploration ratio", "goal sampler")
        }
        self.epoch = 0
        self.positive_share = np.zeros(len(seeds))
        self.env_samples = np.zeros(len(seeds), dtype=np.int64)

    def train(self) -> Iterator[Progress]:
        """Algorithm 1, from line 4 on; yields after each epoch."""
        if self.config.imitation and not self.pre.sizes.any():
            self._generate_pre()  # lines 4–5
        while self.epoch < self.config.epochs and not self.stopping.stopped.all():  # line 6
            self.epoch += 1
            metrics: dict[str, NDArray[np.float64]] = {}
            labels = None
            if self.config.imitation:
                dataset = self._goal_sampler()  # line 14 of the epoch before; I^pre at first
                metrics["inverse_dynamics_loss"] = _numpy(self.inverse_dynamics.train(dataset))  # 7
                labels = self.inverse_dynamics.label(  # line 8: Â
                    self._for_all_seeds(self.expert_states), self._for_all_seeds(self.expert_next)
                )
                metrics["cloning_loss"] = _numpy(  # line 9
                    self.cloning.train(self.expert_states, labels)
                )
            with torch.no_grad():
                logits = self.policy(self._for_all_seeds(self.expert_states))
            epsilon = metrics["epsilon"] = self._epsilon(logits)
            if self.config.imitation:
                actions = logits.argmax(dim=-1).cpu().numpy()
                self.stopping.update(actions, metrics["cloning_loss"])
            metrics |= self._solve_environments(epsilon)  # lines 10–13
            yield Progress(
                self.epoch,
                self.env_samples.copy(),
                np.full_like(self.env_samples, self._expert_samples()),
                self.pre.capacity if self.config.imitation else 0,
                self.stopping.stopped.copy(),
                metrics,
                None if labels is None else labels.cpu().numpy(),
            )

    def _solve_environments(self, epsilon: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Lines 10–13: play |E| episodes, remember them, learn from each."""
        if self.config.goal_sampler.memory == "epoch":
            self.pos.clear()
        returns, goals, losses, accuracies = [], [], [], []
        for _ in range(self.config.episodes):  # line 10
            episodes = self._play(epsilon)  # line 11
            goal = self._reaches_goal(episodes)
            self.pos.append(episodes, keep=goal)  # line 12
            self.env_samples += episodes.lengths
            if self.config.reinforcement:
                self.q_learning.replay.append(episodes)
                losses.append(_numpy(self.q_learning.train(self.config.q_learning.updates)))  # 13
            returns.append(episodes.returns)
            goals.append(goal)
            if self.config.imitation:
                accuracies.append(self._inverse_dynamics_accuracy(episodes))
        self.positive_share = np.mean(goals, axis=0)
        metrics = {"training_return": np.mean(returns, axis=0), "goals": self.positive_share}
        if accuracies:
            metrics["inverse_dynamics_accuracy"] = np.mean(accuracies, axis=0)
        if losses:
            metrics["td_loss"] = np.mean(losses, axis=0)
        return metrics

    def _goal_sampler(self) -> Selection:
        """Line 14: I^s; all of I^pre before the first success."""
        limit = positive_limit(self.epoch - 1, self.task.ablation.n, self.task.ablation.k)
        uniform = self._streams["goal sampler"].uniform(self.pre.capacity + self.pos.capacity)
        share = np.minimum(limit, self.positive_share)
        return select(self.pre, self.pos, share, self.task.environment.action_count, uniform)

    def _generate_pre(self) -> None:
        """Lines 4–5: fill I^pre with what the untrained policy does, sampled from its softmax."""
        seeds, streams = len(self.task.seeds), self._streams["pre"]
        environments = Environments(self.task.environment, seeds * _PRE_COPIES)
        steps = self.task.environment.max_episode_steps
        while (unfilled := self.pre.sizes < self.pre.capacity).any():
            uniform = torch.from_numpy(streams.uniform(steps, _PRE_COPIES)).to(self.task.device)

            def act(observations: Floats, step: int, uniform: Tensor = uniform) -> Integers:
                logits = self._logits(observations)
                return _flat(sample_softmax(logits, uniform[:, step]))

            episodes = environments.play(act, streams.integers(2**31, _PRE_COPIES).ravel())
            self.pre.append(episodes, keep=np.repeat(unfilled, _PRE_COPIES))
        if self.config.inverse_dynamics.standardise:
            self.inverse_dynamics.standardise(self.pre.everything())

    def _play(self, epsilon: NDArray[np.float64]) -> Episodes:
        """Line 11: one ε-greedy episode per seed."""
        steps = self.task.environment.max_episode_steps
        drawn = self._streams["exploration"].uniform(steps, 2, 1)
        uniform = torch.from_numpy(drawn).to(self.task.device)
        chance = torch.from_numpy(epsilon).to(self.task.device)
        kind = self.config.exploration.kind

        def act(observations: Floats, step: int) -> Integers:
            chosen = explore(
                self._logits(observations), chance, uniform[:, step].transpose(0, 1), kind
            )
            return _flat(chosen)

        return self.environments.play(act, self._streams["resets"].integers(2**31))

    def _epsilon(self, logits: Tensor) -> NDArray[np.float64]:
        """(S,) ε: the policy's own exploration ratio on the expert's states (§3.4), or fixed."""
        if self.config.exploration.epsilon is not None:
            return np.full(len(self.task.seeds), self.config.exploration.epsilon)
        uniform = self._streams["exploration ratio"].uniform(len(self.expert_states))
        return exploration_ratio(logits, uniform)

    def _reaches_goal(self, episodes: Episodes) -> NDArray[np.bool_]:
        """(S,) whether each seed's episode reached the environment's goal."""
        return reaches_goal(
            self.task.environment.config.goal,
            returns=episodes.returns,
            final_rewards=episodes.final_rewards,
            terminated=episodes.ends,
        )

    def _inverse_dynamics_accuracy(self, episodes: Episodes) -> NDArray[np.float64]:
        """(S,) share of an own episode's actions that M_θ infers from its states."""
        labels = self.inverse_dynamics.label(
            torch.from_numpy(episodes.observations).to(self.task.device),
            torch.from_numpy(episodes.next_observations).to(self.task.device),
        )
        steps = np.arange(episodes.actions.shape[1]) < episodes.lengths[:, None]
        right = (labels.cpu().numpy() == episodes.actions) & steps
        accuracy: NDArray[np.float64] = right.sum(axis=1) / episodes.lengths
        return accuracy

    def _for_all_seeds(self, shared: Tensor) -> Tensor:
        """(M, obs) to (S, M, obs), without copying."""
        return shared.expand(len(self.task.seeds), *shared.shape)

    def _expert_samples(self) -> int:
        """Expert transitions used so far: T^e once per epoch (§5.2.2)."""
        return self.epoch * len(self.expert_states) if self.config.imitation else 0

    @torch.no_grad()
    def _logits(self, observations: Floats) -> Tensor:
        """(S·N, obs) scaled observations to (S, N, |A|) outputs of the policy."""
        by_seed = torch.from_numpy(observations).to(self.task.device)
        return self.policy(by_seed.view(len(self.task.seeds), -1, observations.shape[-1]))

    def act(self, observations: Floats) -> Integers:
        """Greedy actions: (S·N, obs) scaled observations, one seed's side by side, to (S·N,)."""
        return _flat(self._logits(observations).argmax(dim=-1))

    def _stateful(self) -> dict[str, Any]:
        """The parts that keep state of their own, by name."""
        return {
            "inverse_dynamics": self.inverse_dynamics,
            "cloning": self.cloning,
            "q_learning": self.q_learning,
            "pre": self.pre,
            "pos": self.pos,
            "stopping": self.stopping,
            **{f"{purpose} stream": streams for purpose, streams in self._streams.items()},
        }

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on; episodes are whole between epochs."""
        return {
            "epoch": self.epoch,
            "policy": self.policy.flat,
            "positive_share": self.positive_share.tolist(),
            "env_samples": self.env_samples.tolist(),
            "parts": {name: part.state_dict() for name, part in self._stateful().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.epoch = state["epoch"]
        self.policy.flat.copy_(state["policy"])
        self.positive_share = np.array(state["positive_share"])
        self.env_samples = np.array(state["env_samples"], dtype=np.int64)
        for name, part in self._stateful().items():
            part.load_state_dict(state["parts"][name])


def _flat(actions: Tensor) -> Integers:
    """(S, N) actions as (S·N,) off the device."""
    return actions.flatten().cpu().numpy()


def _numpy(values: Tensor) -> NDArray[np.float64]:
    """(S,) as doubles off the device."""
    return values.double().cpu().numpy()
