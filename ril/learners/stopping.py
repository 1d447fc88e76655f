"""When a seed stops improving (Algorithm 1, line 6; §3.4, step vii)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import at_least


@dataclass
class StoppingConfig:
    """How long π_φ counts as improving (Alg. 1, line 6; §3.4, step vii)."""

    patience: int | None = MISSING
    loss_tolerance: float = at_least(0)


class StoppingRule:
    """Stops a seed once nothing has changed for `patience` epochs in a row.

    "Either when no actions change between two consecutive epochs or no significant reduction
    in loss is observed in consecutive epochs" (§3.4).

    Args:
        config: `method.stopping`; a patience of None never stops.
        seeds: S.
    """

    def __init__(self, config: StoppingConfig, seeds: int) -> None:
        self.config = config
        self.stopped = np.zeros(seeds, dtype=bool)
        self._unchanged = np.zeros(seeds, dtype=np.int64)
        self._actions: NDArray[np.int64] | None = None
        self._loss = np.full(seeds, np.inf)

    def update(self, actions: NDArray[np.int64], loss: NDArray[np.float64]) -> None:
        """Take in one epoch.

        Args:
            actions: (S, M) the policy's greedy actions at the expert's states.
            loss: (S,) its cloning loss.
        """
        same_actions, reduced = np.zeros(len(loss), dtype=bool), np.ones(len(loss), dtype=bool)
        if self._actions is not None:
            same_actions = (actions == self._actions).all(axis=1)
            reduced = loss < self._loss * (1 - self.config.loss_tolerance)
        self._unchanged = np.where(same_actions | ~reduced, self._unchanged + 1, 0)
        self._actions, self._loss = actions, loss
        if self.config.patience is not None:
            self.stopped |= self._unchanged >= self.config.patience

    def state_dict(self) -> dict[str, Any]:
        """What the next update depends on."""
        return {
            "stopped": self.stopped.tolist(),
            "unchanged": self._unchanged.tolist(),
            "actions": None if self._actions is None else self._actions.tolist(),
            "loss": self._loss.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.stopped = np.array(state["stopped"], dtype=bool)
        self._unchanged = np.array(state["unchanged"], dtype=np.int64)
        actions = state["actions"]
        self._actions = None if actions is None else np.array(actions, dtype=np.int64)
        self._loss = np.array(state["loss"])
