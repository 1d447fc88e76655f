"""Where a run's curve goes besides `curve.csv`, while it is being trained."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
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
    """What `logging=…` names by its `_target_`, whose other keys its constructor is given."""

    def start(self, config: Config, folder: Path) -> None:
        """A run begins or goes on in its folder, whose name is its run_id."""

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Some seeds were looked at after an epoch; a point is never given twice in one start."""

    def finish(self) -> None:
        """The run is over or stopped, or was never started."""


def make_logger(settings: Mapping[str, Any] | None, name: str | None) -> Logger | None:
    """The logger that `logging` names, before anything is trained.

    Args:
        settings: `_target_`, and what its constructor is given; None for no logger.
        name: by which the user chose it.

    Raises:
        UserError: it is none, cannot be imported or made.
    """
    if settings is None:
        return None
    given = dict(settings)
    target = str(given.pop("_target_", ""))
    try:
        kind = pkgutil.resolve_name(target)
        if not (isinstance(kind, type) and issubclass(kind, Logger)):  # any program else
            raise TypeError(f"{target} is no class with start, log and finish")
        return kind(**given)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise UserError(f"logging={name or target}: cannot be used ({one_line(error)})") from None


class LoggedDisplay:
    """A display that hands what is new of the curve to a logger.

    Args:
        display: what shows the run.
        logger: what keeps its curve.
    """

    def __init__(self, display: Display, logger: Logger) -> None:
        self._display, self._logger = display, logger
        self._seen: int | None = None
        self.scoring, self.noted, self.finished = display.scoring, display.noted, display.finished

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """See `Display`."""
        self._display.started(config, folder, epochs)
        self._logger.start(config, folder)

    def advanced(self, progress: Progress, record: Record) -> None:
        """See `Display`."""
        self._display.advanced(progress, record)
        if self._seen is None:  # what an earlier start has seen before its checkpoint
            self._seen = sum(point.epoch < progress.epoch for point in record.curve)
        if new := record.curve[self._seen :]:
            self._logger.log(new)
        self._seen = len(record.curve)


class TensorBoard:
    """Scalars in `<run>/tensorboard/`: a TensorBoard run per seed, and `mean` over all of them.

    The step is the samples learnt from (§5.2.2), so that methods can be compared by them. Points
    that a stopped run had written after its last checkpoint are purged.

    Raises:
        ImportError: the package is missing.
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
        if len(points) == len(self._seeds):  # none has stopped
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
    return {"aer": point.aer, "epoch": point.epoch, "samples": point.samples, **point.metrics}
