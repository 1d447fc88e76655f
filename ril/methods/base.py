"""The interface of every method, and its report after each epoch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ril.vectorized.networks import Network

#: Diagnostics of an epoch by name, each (S,).
Metrics = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Progress:
    """The state of training after an epoch.

    Attributes:
        epoch: epochs done, from 1.
        env_samples: (S,) environment steps trained on so far (§5.2.2).
        expert_samples: (S,) expert transitions trained on so far, counted once per epoch.
        pre_samples: random transitions collected before training, per seed.
        stopped: (S,) seeds whose training the stopping rule ended at this epoch or before.
        metrics: named diagnostics, each (S,).
        pseudo_labels: (S, M) actions inferred for the expert's transitions; None without labels.
        can_act: whether the policy can act yet, so that it is worth evaluating.
        can_be_best: whether this policy may be selected as the run's best.
    """

    epoch: int
    env_samples: NDArray[np.int64]
    expert_samples: NDArray[np.int64]
    pre_samples: int
    stopped: NDArray[np.bool_]
    metrics: Metrics = field(default_factory=dict)
    pseudo_labels: NDArray[np.int64] | None = None
    can_act: bool = True
    can_be_best: bool = True

    @classmethod
    def of_rewards(cls, epoch: int, seeds: int, steps: int, metrics: Metrics) -> Progress:
        """Report an epoch of a method that uses no expert trajectories.

        Args:
            epoch: epochs done.
            seeds: number of seeds S.
            steps: environment steps of each seed so far.
            metrics: named diagnostics, each (S,).
        """
        return cls(
            epoch,
            env_samples=np.full(seeds, steps),
            expert_samples=np.zeros(seeds, dtype=np.int64),
            pre_samples=0,
            stopped=np.zeros(seeds, dtype=bool),
            metrics=metrics,
        )


class Method(Protocol):
    """A learning algorithm over S seeds; the run decides when it trains, is evaluated and stops.

    Attributes:
        policy: networks from scaled observations to one output per action; the greedy action is
            the one with the largest output.
        epochs: number of epochs that `train` yields, unless the stopping rule ends it earlier.
    """

    policy: Network

    @property
    def epochs(self) -> int: ...  # noqa: D102

    def train(self) -> Iterator[Progress]:
        """Train, yielding after each epoch; after `load_state_dict`, resume with the next one."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next epoch depends on."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
