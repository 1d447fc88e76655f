"""Train a method: evaluate its policies on the way, keep checkpoints, score them at the end."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ril.config.schema import Config
from ril.io.files import WriteError
from ril.io.locks import Claim
from ril.io.signals import Stopped, StopRequest
from ril.methods.base import Method, Progress
from ril.run.checkpoints import load_checkpoint, save_checkpoint, unreadable
from ril.run.prepare import Cell
from ril.run.provenance import origin
from ril.run.record import Record
from ril.vectorized.evaluation import Evaluation
from ril.vectorized.networks import Architecture

CHECKPOINT_SECONDS = 5.0  # between two checkpoints at least
_STRETCH = 4  # seconds between two per second that one takes, in units of CHECKPOINT_SECONDS


class Display(Protocol):
    """What shows a run to a person; see `ril.cli.display`."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Training for that many epochs starts or resumes."""

    def advanced(self, progress: Progress, record: Record) -> None:
        """An epoch has ended."""

    def scoring(self) -> None:
        """Training has ended; the best and last policies are being scored."""

    def noted(self, line: str) -> None:
        """Something happened that the user should know and that does not end the run."""

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """The rows are written; skipped says that an earlier run had written them."""


@dataclass(frozen=True)
class Run:
    """One run of a cell.

    Attributes:
        cell: configuration, environment, demonstrations.
        method: new; its state is loaded if the run was stopped before.
        claim: on the run's folder.
        stop: whether the user wants it to stop.
    """

    cell: Cell
    method: Method
    claim: Claim
    stop: StopRequest


@dataclass(frozen=True)
class Outcome:
    """What a run found.

    Attributes:
        record: of the training.
        best: (S, episodes) returns of new episodes of each seed's best policy.
        last: (S, episodes) returns of the last policy in the same episodes.
        seconds: that it took, of all its starts together.
        architecture: of the policies; None for a reference.
    """

    record: Record
    best: NDArray[np.float64]
    last: NDArray[np.float64]
    seconds: float
    architecture: Architecture | None = None


def measure_reference(cell: Cell) -> Outcome:
    """Measure what `performance` counts from (random) or to (expert); nothing is trained."""
    assert cell.spec.measure is not None
    started = time.monotonic()
    seeds, episodes = cell.config.seeds, cell.config.evaluation.episodes
    returns = cell.spec.measure(cell.environment, cell.demonstrations, seeds, episodes)
    record = Record(seeds, torch.zeros(len(seeds), 0))
    return Outcome(record, best=returns, last=returns, seconds=time.monotonic() - started)


def train_and_score(run: Run, display: Display) -> Outcome:
    """Train to the end, from the checkpoint if there is one; score the best and last policies.

    Raises:
        UserError: the checkpoint cannot be read, or the folder was removed.
        Stopped: the user stopped it; the message says after which epoch.
    """
    started = time.monotonic()
    config = run.cell.config
    record = Record(config.seeds, run.method.policy.flat)
    evaluation = Evaluation(run.cell.environment, config.seeds)
    before = _train(run, record, evaluation, display)
    run.stop.immediate = True  # scoring can be repeated
    if run.stop.number is not None:
        raise Stopped("stopped before scoring", run.stop.number)
    display.scoring()
    policy, returns = run.method.policy, []
    for parameters in (record.best, record.last):
        policy.flat.copy_(parameters)
        returns.append(evaluation.returns(policy, config.evaluation.episodes, "of the result"))
    best, last = returns
    seconds = before + time.monotonic() - started
    return Outcome(record, best, last, seconds, policy.architecture)


def _train(run: Run, record: Record, evaluation: Evaluation, display: Display) -> float:
    """Train and fill the record; return the seconds of earlier starts."""
    method, settings, stop = run.method, run.cell.config.evaluation, run.stop
    interval = settings.interval(method.epochs)
    checkpoints = _Checkpoints(run, record, display)
    checkpoints.load()
    for progress in method.train():
        live = ~record.stopped
        just_stopped = record.advance(progress, method.policy.flat)
        regular = progress.epoch == method.epochs or progress.epoch % interval == 0
        # A seed that stops is evaluated alone: the others' evaluations must not depend on it.
        evaluated = live if regular else just_stopped
        if evaluated.any() and progress.can_act:
            metrics = dict(progress.metrics)
            if progress.pseudo_labels is not None:
                right = progress.pseudo_labels == run.cell.given.actions
                metrics["label_accuracy"] = right.mean(axis=1)
            purpose = f"after epoch {progress.epoch}"
            returns = evaluation.returns(method.policy, settings.selection_episodes, purpose)
            record.evaluated(
                returns.mean(axis=1), evaluated, metrics, may_be_best=progress.can_be_best
            )
        try:
            display.advanced(progress, record)
        except OSError:
            if stop.number is None:
                raise  # otherwise the terminal has closed, which SIGHUP has reported
        if checkpoints.due() or stop.number is not None:
            checkpoints.save()
        if stop.number is not None:
            raise Stopped(f"stopped after epoch {progress.epoch}{checkpoints.fault}", stop.number)
    checkpoints.save()
    return checkpoints.seconds_before


class _Checkpoints:
    """A run's checkpoints: read once, then written every few seconds.

    Attributes:
        seconds_before: that earlier starts had taken by their last checkpoints.
        fault: why the last one could not be written; "" if it could.
    """

    def __init__(self, run: Run, record: Record, display: Display) -> None:
        self._run, self._record, self._display = run, record, display
        self._path = run.claim.folder / "checkpoint.pt"
        self._origin = origin(run.cell.run_id)
        self._started = self._saved = time.monotonic()
        self._cost = self.seconds_before = 0.0
        self.fault = ""

    def load(self) -> None:
        """Restore the state of a stopped run, if there is a checkpoint."""
        if not self._path.exists():
            return
        state = load_checkpoint(self._path, self._origin)
        try:
            self._run.method.load_state_dict(state["method"])
            self._record.load_state_dict(state["record"])
            self.seconds_before = float(state["seconds"])
        except Exception as error:
            raise unreadable(self._path, error) from None

    def due(self) -> bool:
        """Return whether it is time for another one."""
        since = time.monotonic() - self._saved
        return since > CHECKPOINT_SECONDS * max(1.0, _STRETCH * self._cost)

    def save(self) -> None:
        """Write one; if that fails, say so and keep the one before.

        Raises:
            UserError: the folder was removed.
        """
        if not self._run.cell.config.resume:
            return  # resume=false never resumes
        self._run.claim.check()
        begun = time.monotonic()
        state = {
            "seconds": self.seconds_before + begun - self._started,
            "method": self._run.method.state_dict(),
            "record": self._record.state_dict(),
        }
        try:
            save_checkpoint(self._path, self._origin, state)
        except WriteError as error:
            if not self.fault:
                self._display.noted(f"{error}; training continues, and the last checkpoint is kept")
            self.fault = f"; {error}"
        else:
            self.fault = ""
        self._saved = time.monotonic()
        self._cost = self._saved - begun
