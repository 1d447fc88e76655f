"""What a method is given, what it gives back, and what it must be able to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ril.config import AblationConfig
from ril.demonstrations import StateTransitions
from ril.environments import Environment, Floats
from ril.vectorized.networks import Network


@dataclass(frozen=True)
class Task:
    """What all methods learn from.

    Attributes:
        environment: the task itself.
        expert: the expert's state transitions T^e; no actions.
        seeds: the S seeds that are trained together.
        ablation: eq. 2's k and n.
        device: where tensors live.
    """

    environment: Environment
    expert: StateTransitions
    seeds: tuple[int, ...]
    ablation: AblationConfig
    device: torch.device


@dataclass(frozen=True)
class Progress:
    """Where training stands after an epoch.

    Attributes:
        epoch: epochs done, from 1.
        env_samples: (S,) environment steps learnt from so far (§5.2.2).
        expert_samples: (S,) expert transitions learnt from so far, counted once per epoch.
        pre_samples: random transitions kept for training before it began, per seed.
        stopped: (S,) seeds whose training ended by the stopping rule at this epoch or before.
        metrics: named diagnostics, each (S,).
        pseudo_labels: (S, M) actions given to the expert's transitions; None without.
    """

    epoch: int
    env_samples: NDArray[np.int64]
    expert_samples: NDArray[np.int64]
    pre_samples: int
    stopped: NDArray[np.bool_]
    metrics: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    pseudo_labels: NDArray[np.int64] | None = None


class Method(Protocol):
    """A learning algorithm over S seeds; the experiment owns time, the method only learning."""

    policy: Network

    def train(self) -> Iterator[Progress]:
        """Learn, yielding after each epoch; a loaded state goes on with the next one."""

    def act(self, observations: Floats) -> NDArray[np.int64]:
        """Greedy actions: (S·N, obs) scaled observations, one seed's side by side, to (S·N,)."""

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
