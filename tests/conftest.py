"""What several tests share: configurations, environments and small sets of expert trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from hypothesis import settings
from omegaconf import DictConfig

from ril.cli import store_schemas
from ril.config import Config, from_hydra
from ril.demonstrations import Demonstrations, load_demonstrations
from ril.environments import Environment, load_environment
from ril.methods.base import Progress, Task
from ril.paths import config_folder
from ril.record import Record

torch.set_num_threads(1)
settings.register_profile("ril", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("ril")

#: A run of a second.
QUICK = (
    "seeds=2",
    "method.epochs=3",
    "method.goal_sampler.pre_steps_per_action=60",
    "method.inverse_dynamics.updates=4",
    "method.inverse_dynamics.batch_size=16",
    "method.cloning.updates=4",
    "method.cloning.batch_size=16",
    "method.q_learning.updates=4",
    "method.q_learning.batch_size=16",
    "evaluation.episodes=3",
    "evaluation.selection_episodes=2",
    "evaluation.every=2",
)
#: CartPole with a goal that some of an untrained policy's episodes reach, and others do not.
CARTPOLE = ("env=cartpole", "env.goal.minimum_return=11", "ablation.n=4")

#: How the expert of the tests acts on a raw observation.
RULES: dict[str, Callable[[np.ndarray], int]] = {
    "mountaincar": lambda observation: 2 if observation[1] >= 0 else 0,  # pump energy
    "cartpole": lambda observation: int(observation[3] > 0),  # push towards the fall
}

Compose = Callable[..., Config]


@cache
def composed(*overrides: str) -> DictConfig:
    """What Hydra makes of a command line; not to be changed."""
    store_schemas()
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        return hydra.compose("config", list(overrides))


@pytest.fixture(scope="session")
def compose() -> Compose:
    """The checked configuration that a command line gives, a new one at each call."""
    return lambda *overrides: from_hydra(composed(*overrides))


@pytest.fixture(scope="session")
def environments(compose: Compose) -> dict[str, Environment]:
    """The paper's four environments, by name."""
    names = ("cartpole", "acrobot", "mountaincar", "lunarlander")
    return {name: load_environment(compose(f"env={name}").env) for name in names}


@pytest.fixture(scope="session")
def mountaincar(environments: dict[str, Environment]) -> Environment:
    return environments["mountaincar"]


@pytest.fixture(scope="session")
def cartpole(environments: dict[str, Environment]) -> Environment:
    return environments["cartpole"]


def follow_rule(environment: Environment, seeds: Sequence[int]) -> Demonstrations:
    """A trajectory per reset seed of the environment's rule, by a plain Gymnasium loop."""
    rule = RULES[environment.config.name]
    copy = environment.make()
    observations, actions, rewards, lengths, ends = [], [], [], [], []
    for seed in seeds:
        observation, _ = copy.reset(seed=seed)
        observations.append(observation)
        terminated = truncated = False
        length = 0
        while not (terminated or truncated):
            actions.append(rule(observation))
            observation, reward, terminated, truncated, _ = copy.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
            length += 1
        lengths.append(length)
        ends.append(terminated)
    return Demonstrations(
        np.array(observations, dtype=np.float32),
        np.array(actions),
        np.array(rewards, dtype=np.float32),
        np.array(lengths),
        np.array(ends),
    )


@pytest.fixture(scope="session")
def demonstration_files(
    environments: dict[str, Environment], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Three trajectories of a rule, by environment."""
    folder = tmp_path_factory.mktemp("demonstrations")
    files = {name: folder / f"{name}.npz" for name in RULES}
    for name, file in files.items():
        follow_rule(environments[name], seeds=(0, 1, 2)).save(file)
    return files


@pytest.fixture(scope="session")
def quick(compose: Compose, demonstration_files: dict[str, Path]) -> Compose:
    """The configuration of a small run on CartPole, or as the overrides say."""

    def quickly(*overrides: str) -> Config:
        config = compose(*QUICK, *CARTPOLE, *overrides)
        if config.demonstrations is None:
            config.demonstrations = str(demonstration_files[config.env.name])
        return config

    return quickly


@pytest.fixture(scope="session")
def make_task() -> Callable[[Config], Task]:
    """What a method learns from, for a configuration that names its demonstrations."""

    def made(config: Config) -> Task:
        environment = load_environment(config.env)
        assert config.demonstrations is not None
        demonstrations = load_demonstrations(Path(config.demonstrations), environment)
        expert = demonstrations.first(config.ablation.trajectories).states(environment)
        device = torch.device("cpu")
        return Task(environment, expert, tuple(config.seeds), config.ablation, device)

    return made


class Silence:
    """A display that shows nothing."""

    def started(self, config: Config, folder: Path) -> None: ...

    def advanced(self, progress: Progress, record: Record) -> None: ...

    def scoring(self) -> None: ...

    def finished(self, rows: Path, *, skipped: bool) -> None: ...


@pytest.fixture
def silence() -> Silence:
    return Silence()
