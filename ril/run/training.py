"""Train a method, evaluate its policies, save checkpoints, and score the best and last policies."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.config.schema import Config
from ril.io.errors import NotFiniteError
from ril.io.files import WriteError
from ril.io.locks import Claim
from ril.io.signals import Stopped, StopRequest
from ril.methods.base import Method, Progress
from ril.run.checkpoints import load_checkpoint, save_checkpoint, unreadable
from ril.run.memory import return_unused
from ril.run.prepare import Cell
from ril.run.provenance import origin
from ril.run.record import Record
from ril.vectorized.compiling import fallbacks
from ril.vectorized.evaluation import Evaluation
from ril.vectorized.networks import Architecture

CHECKPOINT_SECONDS = 5.0  # minimum time between two checkpoints
# After a checkpoint that took t seconds to write, at least 4 · 5 · t seconds of training follow.
_STRETCH = 4


class Display(Protocol):
    """The interface through which a run reports to the user; see `ril.cli.display`."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Report that training starts or resumes.

        Args:
            config: configuration of the run.
            folder: the run's folder.
            epochs: number of epochs of the whole training; 0 for a reference.
        """

    def advanced(self, progress: Progress, record: Record) -> None:
        """Report that an epoch has ended."""

    def scoring(self) -> None:
        """Report that training has ended and the best and last policies are being scored."""

    def noted(self, line: str) -> None:
        """Report an event that does not end the run, in one line."""

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """Report that the rows are written.

        Args:
            rows: the file of rows.
            skipped: whether an earlier run had already written them.
        """


@dataclass(frozen=True)
class Run:
    """One run of a cell.

    Attributes:
        cell: configuration, environment, demonstrations.
        method: the untrained method; if a checkpoint exists, training loads its state.
        claim: the lock on the run's folder.
        stop: tells whether the user has asked the run to stop.
    """

    cell: Cell
    method: Method
    claim: Claim
    stop: StopRequest


@dataclass(frozen=True)
class Outcome:
    """The result of a run.

    Attributes:
        record: the record of the training.
        best: (S, episodes) returns of each seed's best policy in fresh episodes.
        last: (S, episodes) returns of each seed's last policy in the same episodes.
        seconds: wall time of training and scoring, summed over all starts of the run.
        architecture: architecture of the policies; None for a reference.
    """

    record: Record
    best: NDArray[np.float64]
    last: NDArray[np.float64]
    seconds: float
    architecture: Architecture | None = None


def measure_reference(cell: Cell) -> Outcome:
    """Measure a reference: random actions (`performance` 0) or the expert (`performance` 1)."""
    assert cell.spec.measure is not None
    started = time.monotonic()
    seeds, episodes = cell.config.seeds, cell.config.evaluation.episodes
    returns = cell.spec.measure(cell.environment, cell.demonstrations, seeds, episodes)
    record = Record(seeds, torch.zeros(len(seeds), 0))
    return Outcome(record, best=returns, last=returns, seconds=time.monotonic() - started)


def train_and_score(run: Run, display: Display) -> Outcome:
    """Train to the end, resuming from a checkpoint if one exists; score the best and last policies.

    Raises:
        UserError: the checkpoint cannot be read, or the folder was removed.
        Stopped: the user stopped the run; the message says after which epoch.
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
        with _located("while scoring"):
            returns.append(evaluation.returns(policy, config.evaluation.episodes, "of the result"))
    best, last = returns
    seconds = before + time.monotonic() - started
    return Outcome(record, best, last, seconds, policy.architecture)


def _train(run: Run, record: Record, evaluation: Evaluation, display: Display) -> float:
    """Train and fill the record; return the seconds that earlier starts took."""
    method, settings, stop = run.method, run.cell.config.evaluation, run.stop
    interval = settings.interval(method.epochs)
    checkpoints = _Checkpoints(run, record, display)
    checkpoints.load()
    epochs = method.train()
    while True:
        with _located(f"in epoch {record.epochs.max() + 1}"):
            progress = next(epochs, None)
        if progress is None:
            break
        _check_finite(progress, method.policy.flat, record)
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
            with _located(f"in the evaluation {purpose}"):
                returns = evaluation.returns(method.policy, settings.selection_episodes, purpose)
            record.evaluated(
                returns.mean(axis=1), evaluated, metrics, may_be_best=progress.can_be_best
            )
        try:
            display.advanced(progress, record)
        except OSError:
            if stop.number is None:
                raise  # otherwise the terminal has closed, which SIGHUP has reported
        return_unused()
        if checkpoints.due() or stop.number is not None:
            checkpoints.save()
        if stop.number is not None:
            raise Stopped(f"stopped after epoch {progress.epoch}{checkpoints.fault}", stop.number)
    checkpoints.save()
    return checkpoints.seconds_before


@contextmanager
def _located(where: str) -> Iterator[None]:
    """Say where in a run the environment returned a number that is not finite.

    Raises:
        NotFiniteError: it did so within the block.
    """
    try:
        yield
    except NotFiniteError as error:
        raise NotFiniteError(f"{error}, {where}") from error


def _check_finite(progress: Progress, policies: Tensor, record: Record) -> None:
    """Refuse an epoch whose losses or policies are not finite.

    Raises:
        NotFiniteError: a number is not; the message names it, the epoch, and the seeds.
    """
    # Online Q-learning has no `td_loss` in epochs without updates. Should it diverge, the policies,
    # which it trains, show it.
    found = {
        name: np.isfinite(values) | (np.isnan(values) & (name == "td_loss"))
        for name, values in progress.metrics.items()
        if name.endswith("_loss")
    }
    found["a parameter of the policy"] = torch.isfinite(policies).all(dim=1).cpu().numpy()
    for name, is_finite in found.items():
        unfit = ~(is_finite | record.stopped)  # a stopped seed's record no longer changes
        if unfit.any():
            seeds = [seed for seed, bad in zip(record.seeds, unfit, strict=True) if bad]
            of = f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
            raise NotFiniteError(f"{name} of {of} is not finite since epoch {progress.epoch}")


class _Checkpoints:
    """A run's checkpoints: read once, then written every few seconds.

    Attributes:
        seconds_before: seconds that earlier starts took up to their last checkpoints.
        fault: why the latest checkpoint could not be written; "" if it was written.
    """

    def __init__(self, run: Run, record: Record, display: Display) -> None:
        self._run, self._record, self._display = run, record, display
        self._path = run.claim.folder / "checkpoint.pt"
        self._origin = origin(run.cell.run_id, run.cell.config)
        self._started = self._saved = time.monotonic()
        self._cost = self.seconds_before = 0.0
        self.fault = ""

    def load(self) -> None:
        """Restore the state of a stopped run, if a checkpoint exists."""
        if not self._path.exists():
            return
        state = load_checkpoint(self._path, self._origin)
        try:
            self._run.method.load_state_dict(state["method"])
            self._record.load_state_dict(state["record"])
            self.seconds_before = float(state["seconds"])
            fallbacks[:] = [*map(str, state["fallbacks"]), *fallbacks]
        except Exception as error:
            raise unreadable(self._path, error) from None

    def due(self) -> bool:
        """Return whether it is time for another checkpoint."""
        since = time.monotonic() - self._saved
        return since > CHECKPOINT_SECONDS * max(1.0, _STRETCH * self._cost)

    def save(self) -> None:
        """Write a checkpoint; if that fails, tell the user and keep the previous one.

        Raises:
            UserError: the folder was removed.
        """
        if not self._run.cell.config.resume:
            return  # a run with resume=false cannot be resumed
        self._run.claim.check()
        begun = time.monotonic()
        state = {
            "seconds": self.seconds_before + begun - self._started,
            "method": self._run.method.state_dict(),
            "record": self._record.state_dict(),
            "fallbacks": list(fallbacks),
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
