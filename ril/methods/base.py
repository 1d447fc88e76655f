"""What a method tells of its progress, and what it must be able to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ril.vectorized.networks import Network


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
        can_act: whether the policy is one yet, so that it is worth looking at.
        can_be_best: whether such a look may be the run's best.
    """

    epoch: int
    env_samples: NDArray[np.int64]
    expert_samples: NDArray[np.int64]
    pre_samples: int
    stopped: NDArray[np.bool_]
    metrics: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    pseudo_labels: NDArray[np.int64] | None = None
    can_act: bool = True
    can_be_best: bool = True


class Method(Protocol):
    """A learning algorithm over S seeds; the experiment owns time, the method only learning.

    Attributes:
        policy: scaled observations to one output per action, of which the largest is taken.
        epochs: how many `train` yields, unless the stopping rule ends it before.
    """

    policy: Network

    @property
    def epochs(self) -> int: ...  # noqa: D102

    def train(self) -> Iterator[Progress]:
        """Learn, yielding after each epoch; a loaded state goes on with the next one."""

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
