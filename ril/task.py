"""A task: the environment, expert and seeds that a method is trained with."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ril.config.schema import AblationConfig
from ril.demonstrations.trajectories import StateTransitions
from ril.environments.environment import Environment


@dataclass(frozen=True)
class Task:
    """An environment, an expert in it, and the seeds to train.

    Attributes:
        environment: the environment to train in.
        expert: the expert's transitions T^e; with actions only for methods that see them.
        seeds: the S seeds, trained together.
        ablation: k and n of eq. 2.
        device: device of all tensors.
        compile: whether updates are compiled: True, False, or "auto" for long trainings only.
    """

    environment: Environment
    expert: StateTransitions
    seeds: tuple[int, ...]
    ablation: AblationConfig
    device: torch.device
    compile: bool | str = False
