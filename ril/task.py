"""What every method learns from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ril.demonstrations.trajectories import StateTransitions
from ril.environments import Environment
from ril.schema import AblationConfig


@dataclass(frozen=True)
class Task:
    """An environment, an expert in it, and the seeds to train.

    Attributes:
        environment: the task itself.
        expert: the expert's transitions T^e; with actions only for methods that need them.
        seeds: the S seeds that are trained together.
        ablation: eq. 2's k and n.
        device: where tensors live.
    """

    environment: Environment
    expert: StateTransitions
    seeds: tuple[int, ...]
    ablation: AblationConfig
    device: torch.device
