"""What every method learns from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ril.config.schema import AblationConfig
from ril.demonstrations.trajectories import StateTransitions
from ril.environments import Environment


@dataclass(frozen=True)
class Task:
    """An environment, an expert in it, and the seeds to train.

    Attributes:
        environment: the task itself.
        expert: the expert's transitions T^e; with actions only for methods that need them.
        seeds: the S seeds that are trained together.
        ablation: eq. 2's k and n.
        device: where tensors live.
        compile: whether long trainings are compiled: True, False, or "auto" where it pays.
        processes: over which seeds may be spread that do not train as one batch.
    """

    environment: Environment
    expert: StateTransitions
    seeds: tuple[int, ...]
    ablation: AblationConfig
    device: torch.device
    compile: bool | str = False
    processes: int = 1
