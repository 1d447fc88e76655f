"""What several tests share: configurations, environments and small sets of expert trajectories."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hypothesis import settings
from omegaconf import DictConfig

from ril.cli import main, store_schemas
from ril.collection import Episode, save
from ril.config import from_hydra
from ril.demonstrations.files import load_demonstrations
from ril.environments import Environment, load_environment
from ril.methods.base import Progress
from ril.methods.registry import METHODS
from ril.paths import config_folder
from ril.record import Record
from ril.schema import Config
from ril.task import Task

torch.set_num_threads(1)
settings.register_profile("ril", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("ril")

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
#: … and by method.
QUICK_METHODS = {
    "acktr": (
        "method.total_timesteps=100",  # 20 at random and 4 updates
        "method.n_envs=2",
        "method.n_steps=10",
        "method.standardise_steps=10",
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


@pytest.fixture(scope="session")
def demonstration_files(
    environments: dict[str, Environment], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Three trajectories of a rule, by environment."""
    folder = tmp_path_factory.mktemp("demonstrations")
    files = {name: folder / f"{name}.npz" for name in RULES}
    for name, file in files.items():
        save(file, follow_rule(environments[name], seeds=(0, 1, 2)))
    return files


@pytest.fixture(scope="session")
def quick(compose: Compose, demonstration_files: dict[str, Path]) -> Compose:
    """The configuration of a small run of RIL on CartPole, or as the overrides say."""

    def quickly(*overrides: str) -> Config:
        named = [each.removeprefix("method=") for each in overrides if each.startswith("method=")]
        settings = QUICK_METHODS[named[-1] if named else "ril"]
        config = compose(*QUICK_RUN, *settings, *CARTPOLE, *overrides)
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
        shown = demonstrations.first(config.ablation.trajectories)
        expert = METHODS[config.method.name].shown(shown, environment)
        device = torch.device("cpu")
        return Task(environment, expert, tuple(config.seeds), config.ablation, device)

    return made


class Silence:
    """A display that shows nothing."""

    def started(self, config: Config, folder: Path, epochs: int) -> None: ...

    def advanced(self, progress: Progress, record: Record) -> None: ...

    def scoring(self) -> None: ...

    def noted(self, line: str) -> None: ...

    def finished(self, rows: Path, *, skipped: bool) -> None: ...


@pytest.fixture
def silence() -> Silence:
    return Silence()


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it wrote."""

    status: int
    output: str
    errors: str


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    """`ril-run` in this process, which is as real and faster."""

    def ran(*arguments: str) -> Ended:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["ril-run", *arguments])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # is set by the command, and put back after
        GlobalHydra.instance().clear()
        try:
            main()
            status: Any = 0
        except SystemExit as end:
            status = end.code
        captured = capfd.readouterr()
        if isinstance(status, str):  # the interpreter prints it on stderr, and ends with 1
            return Ended(1, captured.out, f"{captured.err}{status}\n")
        return Ended(status, captured.out, captured.err)

    return ran
