"""Send a run's curve to a logger, such as TensorBoard, while it trains."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ril.config.schema import Config
from ril.io.errors import UserError, one_line
from ril.io.rows import CurvePoint
from ril.methods.base import Progress
from ril.run.record import Record
from ril.run.training import Display


@runtime_checkable
class Logger(Protocol):
    """The interface of a logger, the class that `_target_` in `conf/logging/*.yaml` names.

    Its constructor gets the other keys of that file.
    """

    def start(self, config: Config, folder: Path) -> None:
        """Start or resume a run; the folder's name is its run_id."""

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Log the evaluations of one epoch, a point per evaluated seed.

        A resumed run logs the points after its checkpoint again.
        """

    def finish(self) -> None:
        """Close the log after the run has finished, stopped or failed to start."""


def make_logger(settings: Mapping[str, Any] | None, name: str | None) -> Logger | None:
    """Make the logger that `logging` names.

    Args:
        settings: `_target_` and the arguments of its constructor; None for no logger.
        name: the value of `logging=` on the command line, for messages.

    Raises:
        UserError: the class cannot be imported, is not a logger, or refuses its arguments.
    """
    if settings is None:
        return None
    given = dict(settings)
    target = str(given.pop("_target_", ""))
    try:
        kind = pkgutil.resolve_name(target)
        # Checked before it is called, so that `_target_` cannot run an arbitrary function.
        if not (isinstance(kind, type) and issubclass(kind, Logger)):
            raise TypeError(f"{target} is not a class with start, log and finish")
        return kind(**given)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise UserError(f"logging={name or target}: cannot be used ({one_line(error)})") from None


class LoggedDisplay:
    """A display that also passes each new point of the curve to a logger, until that fails.

    Args:
        display: shows the run to the user.
        logger: gets the points.
    """

    def __init__(self, display: Display, logger: Logger) -> None:
        self._display = display
        self._logger: Logger | None = logger
        self._logged: int | None = None  # points of the curve
        self.scoring, self.noted, self.finished = display.scoring, display.noted, display.finished

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """See `Display`."""
        self._display.started(config, folder, epochs)
        self._pass(lambda logger: logger.start(config, folder))

    def advanced(self, progress: Progress, record: Record) -> None:
        """See `Display`."""
        self._display.advanced(progress, record)
        if self._logged is None:  # earlier starts have logged the points in the checkpoint
            self._logged = sum(point.epoch < progress.epoch for point in record.curve)
        if new := record.curve[self._logged :]:
            self._pass(lambda logger: logger.log(new))
        self._logged = len(record.curve)

    def end(self) -> None:
        """Close the log."""
        self._pass(lambda logger: logger.finish())

    def _pass(self, what: Callable[[Logger], None]) -> None:
        """Pass something to the logger, which is dropped if it cannot write."""
        if self._logger is None:
            return
        try:
            what(self._logger)
        except OSError as error:
            self._logger = None
            why = error.strerror or one_line(error)
            self.noted(f"logging: cannot be written ({why}); training continues without it")


class TensorBoard:
    """A logger to `<run>/tensorboard/`: a TensorBoard run per seed, and one of their `mean`.

    The step is the number of samples (§5.2.2), so that imitation and reinforcement learning can be
    compared. A resumed run purges the points after its checkpoint, which it writes again.

    Raises:
        ImportError: the package is not installed.
    """

    def __init__(self) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ImportError(f"{error}; pip install -e '.[tensorboard]'") from None
        self._make = SummaryWriter
        self._writers: dict[str, Any] = {}
        self._seeds: Sequence[int] = ()
        self._folder = Path()

    def start(self, config: Config, folder: Path) -> None:
        """See `Logger`."""
        self._seeds, self._folder = config.seeds, folder / "tensorboard"

    def log(self, points: Sequence[CurvePoint]) -> None:
        """See `Logger`."""
        for point in points:
            self._add(f"seed_{point.seed}", point.samples, _values(point))
        if len(points) == len(self._seeds):  # no seed has stopped
            every = [_values(point) for point in points]
            means = {name: float(np.mean([values[name] for values in every])) for name in every[0]}
            self._add("mean", int(means["samples"]), means)

    def _add(self, run: str, step: int, values: dict[str, float]) -> None:
        if run not in self._writers:
            self._writers[run] = self._make(str(self._folder / run), purge_step=step)
        for name, value in values.items():
            if not np.isnan(value):
                self._writers[run].add_scalar(name, value, step)
        self._writers[run].flush()

    def finish(self) -> None:
        """See `Logger`."""
        for writer in self._writers.values():
            writer.close()


def _values(point: CurvePoint) -> dict[str, float]:
    """Return the scalars of a point by name."""
    return {"aer": point.aer, "epoch": point.epoch, "samples": point.samples, **point.metrics}
