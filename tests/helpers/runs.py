"""Small runs for tests: their overrides, their configurations, and a silent display."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import hydra
import numpy as np
from omegaconf import DictConfig

from ril.cli.configuration import store_schemas
from ril.config.schema import Config
from ril.environments import Environment
from ril.experts.collection import Episode
from ril.io.paths import config_folder
from ril.methods.base import Progress
from ril.run.record import Record

#: What makes a run one of a second, whatever the method …
QUICK_RUN = (
    "seeds=2",
    "evaluation.episodes=3",
    "evaluation.selection_episodes=2",
    "evaluation.every=2",
    "processes=1",  # others take seconds to start
)
QUICK_CLONING = ("method.epochs=3", "method.cloning.updates=4", "method.cloning.batch_size=16")
QUICK_IMITATION = (
    *QUICK_CLONING,
    "method.goal_sampler.pre_steps_per_action=60",
    "method.inverse_dynamics.updates=4",
    "method.inverse_dynamics.batch_size=16",
)
QUICK_Q_LEARNING = (
    "method.total_timesteps=60",
    "method.q_learning.learning_starts=10",
    "method.q_learning.train_freq=4",
    "method.q_learning.updates=2",
    "method.q_learning.batch_size=16",
    "evaluation.every=50%",  # a method of steps has an epoch for each
)
QUICK_DQN = (
    *QUICK_Q_LEARNING,
    "method.q_learning.target_interval=5",
    "method.q_learning.replay.capacity=40",  # so that the oldest transitions give way
    "method.exploration.steps=40",
)
#: … and by method; of a method that is not here, its budget alone.
QUICK_BUDGETS = ("quick={epochs: 3, total_timesteps: 60}",)
QUICK_METHODS = {
    "acktr": (
        "method.total_timesteps=100",  # 20 at random and 4 updates
        "method.n_envs=2",
        "method.n_steps=10",
        "method.standardize_steps=10",
        "method.actor.eigen_interval=2",
        "method.critic.eigen_interval=2",
    ),
    "bc": QUICK_CLONING,
    "dqn": QUICK_DQN,
    "dqn_prioritized": QUICK_DQN,
    "gail": (
        "method.total_timesteps=256",  # 4 rounds
        "method.discriminator.batch_size=16",
        "method.ppo.n_envs=2",
        "method.ppo.n_steps=32",
        "method.ppo.batch_size=16",
        "method.ppo.n_epochs=2",
    ),
    "ilpo": (
        "method.epochs=2",
        "method.latent_policy.updates=4",
        "method.latent_policy.batch_size=16",
        "method.remapping.steps=20",
        "method.remapping.steps_per_epoch=10",
        "method.remapping.batch_size=16",
    ),
    "iupe": (*QUICK_IMITATION, "method.episodes=2"),
    "ppo": (
        "method.total_timesteps=256",  # 4 rollouts
        "method.ppo.n_envs=2",
        "method.ppo.n_steps=32",
        "method.ppo.batch_size=16",
        "method.ppo.n_epochs=2",
        "method.ppo.normalize=true",
        "method.ppo.linear_schedule=true",
    ),
    "ril": (
        *QUICK_IMITATION,
        "method.q_learning.target_interval=5",
        "method.q_learning.updates=4",
        "method.q_learning.batch_size=16",
    ),
    "ril_consistent": (
        *QUICK_IMITATION,
        "method.q_learning.updates=4",
        "method.q_learning.batch_size=16",
        "method.q_learning.value_hidden=[6]",
        "method.q_learning.min_confidence=0.6",  # of what M_θ learns in so short a run: some labels
    ),
    "ril_sequential": (*QUICK_IMITATION, *QUICK_Q_LEARNING),
}
#: A run of RIL of a second.
QUICK = (*QUICK_RUN, *QUICK_METHODS["ril"])
#: CartPole with a goal that some of an untrained policy's episodes reach, and others do not.
CARTPOLE = ("env=cartpole", "env.goal.minimum_return=11", "ablation.n=4")

#: How the expert of the tests acts on a raw observation.
RULES: dict[str, Callable[[np.ndarray], int]] = {
    "mountaincar": lambda observation: 2 if observation[1] >= 0 else 0,  # pump energy
    "cartpole": lambda observation: int(observation[3] > 0),  # push towards the fall
}


@cache
def composed(*overrides: str) -> DictConfig:
    """What Hydra makes of a command line; not to be changed."""
    store_schemas()
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        return hydra.compose("config", list(overrides))


def follow_rule(environment: Environment, seeds: Sequence[int]) -> list[Episode]:
    """An episode per reset seed of the environment's rule, by a plain Gymnasium loop."""
    rule = RULES[environment.config.name]
    copy = environment.make()
    episodes = []
    for seed in seeds:
        observation, _ = copy.reset(seed=seed)
        observations, actions, rewards = [observation], [], []
        terminated = truncated = False
        while not (terminated or truncated):
            actions.append(rule(observation))
            observation, reward, terminated, truncated, _ = copy.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        arrays = np.array(observations), np.array(actions), np.array(rewards, dtype=np.float32)
        episodes.append(Episode(seed, *arrays, terminated))
    return episodes


class Silence:
    """A display that shows nothing."""

    def started(self, config: Config, folder: Path, epochs: int) -> None: ...

    def advanced(self, progress: Progress, record: Record) -> None: ...

    def scoring(self) -> None: ...

    def noted(self, line: str) -> None: ...

    def finished(self, rows: Path, *, skipped: bool) -> None: ...


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it wrote."""

    status: int
    output: str
    errors: str
