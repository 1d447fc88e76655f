"""What a person sees of a run: a live panel on a terminal, plain lines in a log file."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from ril.config.schema import Config
from ril.io.rows import load_results
from ril.methods import base
from ril.methods.registry import spec
from ril.methods.spec import MethodSpec
from ril.run.record import Record

_LINE_SECONDS = 10.0  # between two lines of a log file


class ConsoleDisplay:
    """Shows one run on a console.

    Args:
        console: where to write.
        live: a panel that is redrawn, for terminals; otherwise a line every few seconds.
        alone: a finished run has a table of its seeds; as one of a sweep's cells only a line.
    """

    def __init__(
        self,
        console: Console,
        *,
        live: bool,
        alone: bool = True,
        paper_number: Callable[[pd.DataFrame], str | None] = lambda _: None,
    ) -> None:
        self._console = console
        self._paper_number = paper_number
        self._is_alone = alone
        self._is_live = live
        self._live: Live | None = None
        self._bar = Progress(TextColumn("{task.description}"), BarColumn(None), expand=True)
        self._task = self._bar.add_task("")
        self._config: Config | None = None
        self._folder = Path()
        self._epochs = 0
        self._epochs_at_start: int | None = None
        self._first_look = (0.0, 0)  # the time after the first epoch, and the samples by then
        self._started = self._printed = 0.0

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Say what is run and for how long."""
        self._config, self._folder, self._epochs = config, folder, epochs
        self._started = self._printed = time.monotonic()
        cell = f"env={config.env.name} method={config.method.name}"
        going_on = ", going on from its checkpoint" if (folder / "checkpoint.pt").exists() else ""
        seeds = count(len(config.seeds), "seed") + (" together" if len(config.seeds) > 1 else "")
        self._console.print(
            f"{cell}: {seeds}, {count(epochs, 'epoch') if epochs else 'nothing to learn'}"
            f"{going_on}",
            soft_wrap=True,
        )
        if self._is_live:
            self._live = Live(console=self._console, transient=True, refresh_per_second=4)
            self._live.start()
            self._live.update("before the first epoch …")

    def advanced(self, progress: base.Progress, record: Record) -> None:
        """Show where training stands."""
        assert self._config is not None
        if self._epochs_at_start is None:
            self._epochs_at_start = progress.epoch - 1
            self._first_look = time.monotonic(), int(progress.env_samples.sum())
        now, total = time.monotonic(), self._epochs
        done = progress.epoch - self._epochs_at_start
        left = (now - self._started) / done * (total - progress.epoch)
        facts = _facts(spec(self._config.method.name), progress, record)
        since, before = self._first_look
        if now > since and (taken := int(progress.env_samples.sum()) - before):
            facts["steps/s"] = f"{taken / (now - since):,.0f} (all seeds)"
        facts["time left"] = duration(left)
        if self._live is not None:
            self._bar.update(
                self._task,
                completed=progress.epoch,
                total=total,
                description=f"epoch {progress.epoch} of {total}",
            )
            grid = Table.grid(padding=(0, 2))
            for name, value in facts.items():
                grid.add_row(name, value)
            self._live.update(Group(self._bar, grid))
        elif (
            now - self._printed >= _LINE_SECONDS
            or progress.epoch == total
            or progress.stopped.all()
        ):
            self._printed = now
            text = "  ".join(f"{name} {value}" for name, value in facts.items())
            cell = f"{self._config.env.name} {self._folder.name}"
            self._console.print(f"{cell}  epoch {progress.epoch}/{total}  {text}", soft_wrap=True)

    def scoring(self) -> None:
        """Say that training is over."""
        self.stop()
        assert self._config is not None
        episodes = self._config.evaluation.episodes
        self._console.print(f"scoring the best and the last policies on {episodes} fresh episodes")

    def noted(self, line: str) -> None:
        """Say what happened, above the panel if there is one."""
        self._console.print(line, soft_wrap=True, markup=False)

    def stop(self) -> None:
        """Give the terminal back."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """Show the rows, their mean beside the paper's number, and the folder."""
        frame, _ = load_results([rows.parent])
        spread = f"{frame.aer.mean():.2f} ± {frame.aer.std(ddof=0):.2f}"
        performance = f"performance {frame.performance.mean():.3f}"
        found = f"AER {spread} over {count(len(frame), 'seed')}, {performance}"
        paper = self._paper_number(frame)
        if not self._is_alone:
            beside = "" if paper is None else f"; the paper says {paper}"
            self._console.print(f"{rows.parent}: {found}{beside}", soft_wrap=True)
            return
        self._console.print(_seeds(frame))
        self._console.print(found)
        if paper is not None:
            self._console.print(f"the paper says {paper}", soft_wrap=True)
        if skipped:
            self._console.print("finished before, so not run again; resume=false runs it anew")
        self._console.print(str(rows.parent), soft_wrap=True)


def _seeds(frame: pd.DataFrame) -> Table:
    """The rows of one run."""
    first = frame.iloc[0]
    heads = ("seed", "AER", "± std", "last", "performance", "samples to best", "epochs")
    table = Table(*heads, title=f"{first.env} {first.method} {first.run_id}")
    for column in table.columns:
        column.justify = "right"
    for row in frame.itertuples():
        table.add_row(
            str(row.seed),
            f"{row.aer:.2f}",
            f"{row.aer_std:.2f}",
            f"{row.aer_last:.2f}",
            f"{row.performance:.3f}",
            f"{row.samples_to_best:,}",
            str(row.epochs),
        )
    return table


def _facts(method: MethodSpec, progress: base.Progress, record: Record) -> dict[str, str]:
    """Names and values of what is shown after an epoch."""
    samples = progress.env_samples + progress.expert_samples
    facts = {}
    if record.curve:
        epoch = record.curve[-1].epoch
        latest = np.array([point.aer for point in record.curve if point.epoch == epoch])
        facts["return"] = f"{mean_and_std(latest)} (best so far {record.best_aer.mean():.1f})"
    facts["samples"] = f"{samples.mean():,.0f}"
    for shown in method.shown:
        values = progress.metrics.get(shown.metric)
        if values is not None and not np.isnan(values).any():
            facts[shown.label] = format(values.mean(), shown.form)
    if progress.stopped.any():
        facts["stopped"] = f"{progress.stopped.sum()} of {len(progress.stopped)} seeds"
    return facts


def mean_and_std(values: NDArray[np.float64]) -> str:
    """A mean and its spread, in words."""
    return f"{values.mean():.1f} ± {values.std():.1f}"


def count(number: int, what: str) -> str:
    """So many of something, in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def duration(seconds: float) -> str:
    """A time in its two largest units, in words."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
