"""Small runs for tests: their overrides, their configurations, and a silent display."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig, OmegaConf

from ril.cli.configuration import store_schemas
from ril.config.schema import Config
from ril.environments.environment import Environment
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
)
#: … and the values of a method's keys, by the end of the key, or by method and key where a test
#: needs another; a method that is not named here has these values too.
_SMALL: dict[str, object] = {
    "epochs": 3,
    "total_timesteps": 60,
    "updates": 4,
    "batch_size": 16,
    "pre_steps_per_action": 60,
    "target_interval": 5,
    "learning_starts": 10,
    "train_freq": 4,
    "replay.capacity": 40,  # so that the oldest transitions give way
    "exploration.steps": 40,
    "remapping.steps": 20,
    "steps_per_epoch": 10,
    "n_envs": 2,
    "ppo.n_steps": 32,
    "n_epochs": 2,
    "normalize": True,
    "linear_schedule": True,
    "standardize_steps": 10,
    "eigen_interval": 2,
    "value_hidden": [6],
    "min_confidence": 0.6,  # some of the labels of an M_θ that has hardly been trained
    "acktr n_steps": 10,
    "acktr total_timesteps": 100,  # 20 at random and 4 updates
    "dqn q_learning.updates": 2,
    "dqn_prioritized q_learning.updates": 2,
    "gail total_timesteps": 256,  # 4 rounds
    "gail discriminator.updates": None,
    "ilpo epochs": 2,
    "iupe episodes": 2,
    "ppo total_timesteps": 256,  # 4 rollouts
    "ril_consistent target_interval": None,
    "ril_sequential q_learning.updates": 2,
    "ril_sequential replay.capacity": None,
    "ril_sequential target_interval": None,
}


@cache
def quick_method(name: str) -> tuple[str, ...]:
    """The overrides that make a run of any method one of a second; None leaves the default."""
    found = {}
    for key in leaves(OmegaConf.to_container(composed(f"method={name}").method)):
        ends = [".".join(key.split(".")[start:]) for start in range(key.count(".") + 1)]
        for end in (*(f"{name} {end}" for end in ends), *ends):
            if end in _SMALL:
                found[key] = _SMALL[end]
                break
    by_steps = ("evaluation.every=50%",) if "total_timesteps" in found else ()
    small = (f"method.{key}={value}" for key, value in found.items() if value is not None)
    return (*small, *by_steps)


def leaves(node: Any, key: str = "") -> dict[str, Any]:
    """All values of a configuration by full key; an empty dict is a value."""
    if is_dataclass(node):
        node = {field.name: getattr(node, field.name) for field in fields(node)}
    if not isinstance(node, dict) or not node:
        return {key: node}
    found: dict[str, Any] = {}
    for name, value in node.items():
        found |= leaves(value, f"{key}.{name}" if key else name)
    return found


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


#: A run of RIL of a second.
QUICK = (*QUICK_RUN, *quick_method("ril"))
