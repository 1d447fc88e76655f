"""Early stopping of each seed (Algorithm 1, line 6; §3.4, step vii)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import at_least
from ril.vectorized.state import Stateful


@dataclass
class StoppingConfig:
    """When π_φ no longer improves (Alg. 1, line 6; §3.4, step vii)."""

    patience: int | None = MISSING
    loss_tolerance: float = at_least(0)


class StoppingRule(Stateful):
    """Stops a seed after `patience` epochs in a row without a change.

    "Either when no actions change between two consecutive epochs or no significant reduction
    in loss is observed in consecutive epochs" (§3.4).

    Args:
        config: `method.stopping`; a patience of None never stops.
        seeds: the number of seeds S.

    Attributes:
        stopped: (S,) mask of the seeds that have stopped.
    """

    STATE: ClassVar = ("stopped", "_unchanged", "_actions", "_loss")

    def __init__(self, config: StoppingConfig, seeds: int) -> None:
        self.config = config
        self.stopped = np.zeros(seeds, dtype=bool)
        # Epochs in a row without a change. The first epoch has none to compare with: it raises −1
        # to 0, whatever actions and loss are compared with here.
        self._unchanged = np.full(seeds, -1)
        self._actions: NDArray[np.int64] = np.zeros((seeds, 1), dtype=np.int64)
        self._loss: NDArray[np.float64] = np.zeros(seeds)

    def update(self, actions: NDArray[np.int64], loss: NDArray[np.float64]) -> None:
        """Update `stopped` after an epoch.

        Args:
            actions: (S, M) the policy's greedy actions in the expert's states.
            loss: (S,) its cloning loss.
        """
        same_actions = (actions == self._actions).all(axis=1)
        reduced = loss < self._loss * (1 - self.config.loss_tolerance)
        self._unchanged = np.where(same_actions | ~reduced, self._unchanged + 1, 0)
        self._actions, self._loss = actions, loss
        if self.config.patience is not None:
            self.stopped |= self._unchanged >= self.config.patience
