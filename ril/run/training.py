"""Training a method: look at its policies on the way, keep checkpoints, score them at the end."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ril.config.checks import epochs_between_looks
from ril.config.schema import Config
from ril.environments import Environment
from ril.io.files import WriteError
from ril.io.locks import Claim
from ril.io.signals import Stopped, StopRequest
from ril.methods.base import Method, Progress
from ril.run.checkpoints import load_checkpoint, save_checkpoint, unreadable
from ril.run.evaluation import Evaluation
from ril.run.provenance import origin
from ril.run.record import Record

CHECKPOINT_SECONDS = 5.0
_STRETCH = 4  # times longer between two, per second that one takes: they cost 5 % at most


class Display(Protocol):
    """What shows a run to a person; see `ril.cli.display`."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Training for that many epochs begins or goes on."""

    def advanced(self, progress: Progress, record: Record) -> None:
        """An epoch is done."""

    def scoring(self) -> None:
        """Training is over; the best and last policies are being scored."""

    def noted(self, line: str) -> None:
        """Something happened that does not end the run, or made it needless."""

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """The rows are written; skipped says that an earlier run had written them."""


@dataclass(frozen=True)
class Cell:
    """What is trained, how it is looked at, and where it is kept.

    Attributes:
        config: of the run.
        identifier: of the run.
        environment: the task.
        method: fresh; its state is loaded if the run was stopped before.
        expert_actions: (M,) by which pseudo-labels are judged; the method itself is not given them.
        claim: on the run's folder.
        stop: whether the user wants it to end.
    """

    config: Config
    identifier: str
    environment: Environment
    method: Method
    expert_actions: NDArray[np.int64]
    claim: Claim
    stop: StopRequest


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
        UserError: the checkpoint cannot be read, or the folder is gone.
        Stopped: the user stopped it; the message says after which epoch.
    """
    started = time.monotonic()
    record = Record(cell.config.seeds, cell.method.policy.flat)
    evaluation = Evaluation(cell.environment, cell.config.seeds)
    before = _train(cell, record, evaluation, display)
    cell.stop.immediate = True  # what is left to do can be done again
    if cell.stop.number is not None:
        raise Stopped("stopped before scoring", cell.stop.number)
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
    method, settings, stop = cell.method, cell.config.evaluation, cell.stop
    every = epochs_between_looks(settings.every, method.epochs)
    checkpoints = _Checkpoints(cell, record, display)
    checkpoints.load()
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
        try:
            display.advanced(progress, record)
        except OSError:
            if stop.number is None:
                raise  # else the terminal has closed, and has said so by SIGHUP
        if checkpoints.due() or stop.number is not None:
            checkpoints.save()
        if stop.number is not None:
            raise Stopped(f"stopped after epoch {progress.epoch}{checkpoints.fault}", stop.number)
    checkpoints.save()
    return checkpoints.seconds_before


class _Checkpoints:
    """A run's checkpoints: read once, then written every few seconds.

    Attributes:
        seconds_before: what earlier starts had taken by their last checkpoints.
        fault: why the last one could not be written; "" if it could.
    """

    def __init__(self, cell: Cell, record: Record, display: Display) -> None:
        self._cell, self._record, self._display = cell, record, display
        self._path = cell.claim.folder / "checkpoint.pt"
        self._origin = origin(cell.identifier)
        self._started = self._saved = time.monotonic()
        self._cost = self.seconds_before = 0.0
        self.fault = ""

    def load(self) -> None:
        """Restore a run that was stopped, if it was."""
        if not self._path.exists():
            return
        state = load_checkpoint(self._path, self._origin)
        try:
            self._cell.method.load_state_dict(state["method"])
            self._record.load_state_dict(state["record"])
            self.seconds_before = float(state["seconds"])
        except Exception as error:
            raise unreadable(self._path, error) from None

    def due(self) -> bool:
        """Whether it is time for another one."""
        since = time.monotonic() - self._saved
        return since > CHECKPOINT_SECONDS * max(1.0, _STRETCH * self._cost)

    def save(self) -> None:
        """Write one; if that fails for now, say so, and leave the one before.

        Raises:
            UserError: the folder is gone.
        """
        if not self._cell.config.resume:
            return  # nothing could go on from it
        self._cell.claim.check()
        begun = time.monotonic()
        state = {
            "seconds": self.seconds_before + begun - self._started,
            "method": self._cell.method.state_dict(),
            "record": self._record.state_dict(),
        }
        try:
            save_checkpoint(self._path, self._origin, state)
        except WriteError as error:
            if not self.fault:
                self._display.noted(f"{error}; training goes on, the last one that could be stays")
            self.fault = f"; {error}"
        else:
            self.fault = ""
        self._saved = time.monotonic()
        self._cost = self._saved - begun
