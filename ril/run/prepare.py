"""Prepare a cell: check what is asked for, and load what its method is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from ril.config.schema import Config
from ril.demonstrations.files import check_level, demonstrations_path, load_demonstrations
from ril.demonstrations.trajectories import Demonstrations
from ril.environments import Environment, load_environment
from ril.io.errors import UserError
from ril.methods.base import Method
from ril.methods.registry import spec
from ril.methods.spec import MethodSpec
from ril.run.identity import run_folder
from ril.task import Task
from ril.vectorized.processes import usable_processes


@dataclass(frozen=True)
class Cell:
    """A cell that can be run.

    Attributes:
        config: of the run.
        spec: of its method.
        environment: the task.
        demonstrations: all trajectories of the expert.
        given: those that the method is trained on.
        demonstrations_path: of the file that they come from.
        folder: `<output_dir>/<env>/<method>/<run_id>`.
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
        """The hash of all that can change the run's numbers."""
        return self.folder.name

    def build_method(self) -> Method | None:
        """Make the method; a reference has none, since it is not trained.

        Raises:
            UserError: the method cannot work with a value of its configuration.
        """
        if self.spec.build is None:
            return None
        return self.spec.build(self.config.method, self.task())

    def task(self) -> Task:
        """Return what the method is given."""
        config = self.config
        return Task(
            self.environment,
            self.spec.view(self.given, self.environment),
            tuple(config.seeds),
            config.ablation,
            torch.device(config.device),
            config.compile,
            usable_processes(config.processes),
        )


def prepare(config: Config) -> Cell:
    """Check a configuration and load its environment and demonstrations.

    Raises:
        UserError: something that was asked for cannot be used; nothing has been written.
    """
    torch.set_num_threads(1)
    environment = load_environment(config.env)
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


def _check_device(name: str) -> None:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError):
        raise UserError(f"device={name}: torch cannot use it on this machine") from None
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"device={name}: must be cpu or cuda")
