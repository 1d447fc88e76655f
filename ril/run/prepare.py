"""Prepare a cell: check its configuration, and load its environment and demonstrations."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch

from ril.config.schema import Config
from ril.demonstrations.files import check_level, demonstrations_path, load_demonstrations
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment, load_environment
from ril.io.errors import UserError
from ril.methods.base import Method
from ril.methods.registry import spec
from ril.methods.spec import MethodSpec
from ril.run.identity import run_folder
from ril.run.memory import keep_memory
from ril.task import Task
from ril.vectorized.evaluation import RANDOM_COPIES


@dataclass(frozen=True)
class Cell:
    """A cell with everything that its run needs.

    Attributes:
        config: configuration of the run.
        spec: specification of its method.
        environment: the environment in which it is trained and evaluated.
        demonstrations: all trajectories of the expert.
        given: the first `ablation.trajectories` of them, on which the method is trained.
        demonstrations_path: the file of the demonstrations.
        folder: the run's folder, `<output_dir>/<env>/<method>/<run_id>`.
    """

    config: Config
    spec: MethodSpec
    environment: Environment
    demonstrations: Demonstrations
    given: Demonstrations
    demonstrations_path: Path
    folder: Path

    @property
    def run_id(self) -> str:
        """The hash of everything that can change the run's numbers."""
        return self.folder.name

    def build_method(self) -> Method | None:
        """Make the method; return None for a reference (`random`, `expert`), which has no training.

        Raises:
            UserError: the method does not accept a value of its configuration.
        """
        if self.spec.build is None:
            return None
        return self.spec.build(self.config.method, self.task())

    def task(self) -> Task:
        """Return the task that the method is given."""
        config = self.config
        return Task(
            self.environment,
            self.spec.view(self.given, self.environment),
            tuple(config.seeds),
            config.ablation,
            torch.device(config.device),
            config.compile,
        )


def prepare(config: Config) -> Cell:
    """Check a configuration and load its environment and demonstrations.

    Raises:
        UserError: a value or file cannot be used; nothing has been written.
    """
    torch.set_num_threads(1)
    keep_memory()
    environment = load_environment(config.env)
    _check_memory(config, environment)
    _check_device(config.device)
    path = demonstrations_path(config)
    demonstrations = load_demonstrations(path, environment)
    check_level(config, demonstrations)
    return Cell(
        config,
        spec(config.method.name),
        environment,
        demonstrations,
        demonstrations.first(config.ablation.trajectories),
        path,
        run_folder(config, demonstrations.sha256),
    )


def _check_memory(config: Config, environment: Environment) -> None:
    """Refuse episodes whose random actions, drawn before they are played, do not fit in memory."""
    seeds, of_scale = len(config.seeds), min(config.evaluation.episodes, RANDOM_COPIES)
    numbers = max(
        of_scale * (seeds if config.method.name == "random" else 1),
        2 * seeds * getattr(config.method, "episodes", 0),
    )
    needed = 16 * numbers * environment.max_episode_steps  # twice while they are stacked
    if (available := _physical_memory()) and needed > available / 2:
        raise UserError(
            f"env.id={config.env.id}: max_episode_steps={environment.max_episode_steps}: random "
            f"episodes need {needed / 2**30:.0f} GiB of memory, half of {available / 2**30:.0f} "
            "GiB is allowed; give a smaller env.kwargs.max_episode_steps"
        )


def _physical_memory() -> int | None:
    """Return the machine's memory in bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def _check_device(name: str) -> None:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError):
        raise UserError(f"device={name}: torch cannot use it on this machine") from None
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"device={name}: must be cpu or cuda")
