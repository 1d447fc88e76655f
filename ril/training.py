"""Training a method: look at its policies on the way, keep checkpoints, score them at the end."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ril.config import epochs_between_looks
from ril.environments import Environment
from ril.errors import UserError
from ril.evaluation import Evaluation
from ril.files import write_tensors
from ril.interrupts import stop_between_epochs
from ril.methods.base import Method, Progress
from ril.record import Record
from ril.schema import Config

CHECKPOINT_SECONDS = 30.0


class Display(Protocol):
    """What shows a run to a person; see `ril.display`."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Training for that many epochs begins or goes on."""

    def advanced(self, progress: Progress, record: Record) -> None:
        """An epoch is done."""

    def scoring(self) -> None:
        """Training is over; the best and last policies are being scored."""

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """The rows are written; skipped says that an earlier run had written them."""


@dataclass(frozen=True)
class Cell:
    """What is trained, how it is looked at, and where it is kept.

    Attributes:
        config: of the run.
        environment: the task.
        method: fresh; its state is loaded if the run was stopped before.
        expert_actions: (M,) by which pseudo-labels are judged; the method itself is not given them.
        folder: of the run.
    """

    config: Config
    environment: Environment
    method: Method
    expert_actions: NDArray[np.int64]
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """What a run found.

    Attributes:
        record: of the training.
        best: (S, episodes) returns of fresh episodes of each seed's best policy.
        last: (S, episodes) returns of the last one in the same episodes.
        seconds: that it took, of all starts together.
    """

    record: Record
    best: NDArray[np.float64]
    last: NDArray[np.float64]
    seconds: float


def train_and_score(cell: Cell, display: Display) -> Outcome:
    """Train to the end, from the checkpoint if there is one, and score the best and last policies.

    Raises:
        UserError: the checkpoint cannot be read.
        KeyboardInterrupt: the user stopped it; its message says how to go on.
    """
    started = time.monotonic()
    record = Record(cell.config.seeds, cell.method.policy.flat)
    evaluation = Evaluation(cell.environment, cell.config.seeds)
    before = _train(cell, record, evaluation, display)
    display.scoring()
    policy, episodes = cell.method.policy, cell.config.evaluation.episodes
    returns = []
    for parameters in (record.best, record.last):
        policy.flat.copy_(parameters)
        returns.append(evaluation.returns(policy, episodes, "of the result"))
    best, last = returns
    return Outcome(record, best, last, before + time.monotonic() - started)


def _train(cell: Cell, record: Record, evaluation: Evaluation, display: Display) -> float:
    """Fill the record; returns the seconds of earlier starts that were stopped."""
    method, settings = cell.method, cell.config.evaluation
    checkpoint = cell.folder / "checkpoint.pt"
    every = epochs_between_looks(settings.every, method.epochs)
    before = _load_checkpoint(checkpoint, method, record)
    started = saved = time.monotonic()
    with stop_between_epochs() as stop:
        for progress in method.train():
            live = ~record.stopped
            just_stopped = record.advance(progress, method.policy.flat)
            last = progress.epoch == method.epochs
            # A stop is looked at for its own seed only: the others' looks are not to depend on it.
            looked_at = live if last or progress.epoch % every == 0 else just_stopped
            if looked_at.any() and progress.can_act:
                metrics = dict(progress.metrics)
                if progress.pseudo_labels is not None:
                    right = progress.pseudo_labels == cell.expert_actions
                    metrics["label_accuracy"] = right.mean(axis=1)
                purpose = f"after epoch {progress.epoch}"
                returns = evaluation.returns(method.policy, settings.selection_episodes, purpose)
                aer, may_win = returns.mean(axis=1), progress.can_be_best
                record.evaluated(aer, looked_at, metrics, may_be_best=may_win)
            display.advanced(progress, record)
            # A run that may not be resumed has no use for a checkpoint.
            due = stop.is_set() or time.monotonic() - saved > CHECKPOINT_SECONDS
            if due and cell.config.resume:
                saved = time.monotonic()
                _save_checkpoint(checkpoint, method, record, before + saved - started)
            if stop.is_set():
                goes_on = "; the same command goes on from there" if cell.config.resume else ""
                raise KeyboardInterrupt(f"stopped after epoch {progress.epoch}{goes_on}")
    return before


def _save_checkpoint(checkpoint: Path, method: Method, record: Record, seconds: float) -> None:
    """Write all that the rest of the run depends on."""
    state = {"seconds": seconds, "method": method.state_dict(), "record": record.state_dict()}
    write_tensors(checkpoint, state)


def _load_checkpoint(checkpoint: Path, method: Method, record: Record) -> float:
    """Restore a stopped run; returns the seconds it had taken, 0 if there is none."""
    if not checkpoint.exists():
        return 0.0
    try:
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        method.load_state_dict(state["method"])
        record.load_state_dict(state["record"])
    except Exception as error:
        raise UserError(
            f"{checkpoint}: cannot be read ({type(error).__name__}); "
            "delete it, or give resume=false, to start again"
        ) from None
    return float(state["seconds"])
