"""The record of a run in training: its curve, and each seed's best and last policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.io.errors import NotFiniteError
from ril.io.rows import CurvePoint
from ril.methods.base import Progress


class Record:
    """The curve and the best and last policies of S seeds; those of a stopped seed do not change.

    Attributes:
        curve: all evaluations so far.
        best: (S, P) parameters of each seed's best policy.
        last: (S, P) parameters of each seed's last policy.
        best_aer: (S,) mean return of the best policy in the episodes that selected it.
        best_epoch: (S,) epoch after which the best policy was evaluated.
        samples_to_best: (S,) samples used up to that epoch (§5.2.2).
        epochs: (S,) epochs trained.
        env_samples: (S,) environment steps trained on.
        expert_samples: (S,) expert transitions trained on.
        pre_samples: random steps of I^pre, per seed.
    """

    _COUNTS = ("best_epoch", "samples_to_best", "epochs", "env_samples", "expert_samples")

    def __init__(self, seeds: Sequence[int], parameters: Tensor) -> None:
        count = len(seeds)
        self.seeds = seeds
        self.curve: list[CurvePoint] = []
        self.best, self.last = parameters.clone(), parameters.clone()
        self.best_aer = np.full(count, -np.inf)
        self.best_epoch = np.zeros(count, dtype=np.int64)
        self.samples_to_best = np.zeros(count, dtype=np.int64)
        self.epochs = np.zeros(count, dtype=np.int64)
        self.env_samples = np.zeros(count, dtype=np.int64)
        self.expert_samples = np.zeros(count, dtype=np.int64)
        self.pre_samples = 0
        self.stopped = np.zeros(count, dtype=bool)

    def advance(self, progress: Progress, parameters: Tensor) -> NDArray[np.bool_]:
        """Record one epoch; return (S,) whether each seed has just stopped."""
        live = ~self.stopped
        self.pre_samples = progress.pre_samples
        self.epochs[live] = progress.epoch
        self.env_samples[live] = progress.env_samples[live]
        self.expert_samples[live] = progress.expert_samples[live]
        self.last[torch.from_numpy(live)] = parameters[torch.from_numpy(live)]
        just_stopped = progress.stopped & live
        self.stopped = progress.stopped.copy()
        return just_stopped

    def evaluated(
        self,
        aer: NDArray[np.float64],
        evaluated: NDArray[np.bool_],
        metrics: dict[str, NDArray[np.float64]],
        *,
        may_be_best: bool = True,
    ) -> None:
        """Record an evaluation of the current policies.

        Args:
            aer: (S,) mean returns.
            evaluated: (S,) mask of the evaluated seeds, all of which trained in this epoch.
            metrics: diagnostics of the epoch by name, each (S,).
            may_be_best: whether these policies may be selected as their seeds' best.

        Raises:
            NotFiniteError: a mean return is not a finite number.
        """
        samples = self.env_samples + self.expert_samples
        for index in np.flatnonzero(evaluated).tolist():
            if not np.isfinite(aer[index]):
                raise NotFiniteError(
                    f"seed {self.seeds[index]}: the mean return after epoch {self.epochs[index]} "
                    f"is {aer[index]}; the environment's rewards must be finite"
                )
            of_seed = {name: float(values[index]) for name, values in metrics.items()}
            self.curve.append(
                CurvePoint(
                    self.seeds[index],
                    int(self.epochs[index]),
                    int(samples[index]),
                    float(aer[index]),
                    of_seed,
                )
            )
        if not may_be_best:
            return
        better = evaluated & (aer > self.best_aer)
        self.best_aer[better] = aer[better]
        self.best_epoch[better] = self.epochs[better]
        self.samples_to_best[better] = samples[better]
        self.best[torch.from_numpy(better)] = self.last[torch.from_numpy(better)]

    def state_dict(self) -> dict[str, Any]:
        """Return the record as tensors and plain values."""
        return {
            "curve": [asdict(point) for point in self.curve],
            "best": self.best,
            "last": self.last,
            "best_aer": self.best_aer.tolist(),
            "pre_samples": self.pre_samples,
            "stopped": self.stopped.tolist(),
            **{name: getattr(self, name).tolist() for name in self._COUNTS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.curve = [CurvePoint(**point) for point in state["curve"]]
        self.best.copy_(state["best"])
        self.last.copy_(state["last"])
        self.best_aer = np.array(state["best_aer"])
        self.pre_samples = state["pre_samples"]
        self.stopped = np.array(state["stopped"], dtype=bool)
        for name in self._COUNTS:
            setattr(self, name, np.array(state[name], dtype=np.int64))
