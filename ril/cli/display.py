"""Show a run to the user: a live panel on a terminal, plain lines in a log file."""

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

_LINE_SECONDS = 10.0  # minimum time between two lines in a log file


class ConsoleDisplay:
    """The display of one run on a console.

    Args:
        console: the console to write to.
        live: whether to redraw a panel, for terminals; otherwise write a line every few seconds.
        alone: whether to end with a table of the rows; False for a cell of a sweep, which ends
            with one line.
        paper_number: returns the paper's number for the cell of some rows, or None if the paper
            has none.
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
        self._panel: Live | None = None
        self._bar = Progress(TextColumn("{task.description}"), BarColumn(None), expand=True)
        self._task = self._bar.add_task("")
        self._config: Config | None = None
        self._folder = Path()
        self._epochs = 0
        self._first_epoch: int | None = None
        self._after_first_epoch = (0.0, 0)  # time, and environment steps of all seeds
        self._printed = 0.0

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Say what is trained and for how long."""
        self._config, self._folder, self._epochs = config, folder, epochs
        self._printed = time.monotonic()
        cell = f"env={config.env.name} method={config.method.name}"
        seeds = count(len(config.seeds), "seed") + (" together" if len(config.seeds) > 1 else "")
        budget = count(epochs, "epoch") if epochs else "no training"
        resumed = ", resumed from its checkpoint" if (folder / "checkpoint.pt").exists() else ""
        self.noted(f"{cell}: {seeds}, {budget}{resumed}")
        if self._is_live:
            self._panel = Live(console=self._console, transient=True, refresh_per_second=4)
            self._panel.start()
            self._panel.update("waiting for the first epoch …")

    def advanced(self, progress: base.Progress, record: Record) -> None:
        """Show the results of the last epoch, and the time left."""
        assert self._config is not None
        now, total = time.monotonic(), self._epochs
        steps = int(progress.env_samples.sum())
        if self._first_epoch is None:
            self._first_epoch = progress.epoch
            self._after_first_epoch = now, steps
        facts = _facts(spec(self._config.method.name), progress, record)
        # Rates leave out the first epoch since the start, in which updates may be compiled.
        then, steps_before = self._after_first_epoch
        if now > then and steps > steps_before:
            facts["steps per second"] = f"{(steps - steps_before) / (now - then):,.0f} (all seeds)"
        if done := progress.epoch - self._first_epoch:
            facts["time left"] = duration((now - then) / done * (total - progress.epoch))
        if self._panel is not None:
            title = f"epoch {progress.epoch} of {total}"
            self._bar.update(self._task, completed=progress.epoch, total=total, description=title)
            grid = Table.grid(padding=(0, 2))
            for name, value in facts.items():
                grid.add_row(name, value)
            self._panel.update(Group(self._bar, grid))
            return
        is_last = progress.epoch == total or progress.stopped.all()
        if is_last or now - self._printed >= _LINE_SECONDS:
            self._printed = now
            text = ", ".join(f"{name} {value}" for name, value in facts.items())
            cell = f"{self._config.env.name} {self._config.method.name} {self._folder.name}"
            self.noted(f"{cell}: epoch {progress.epoch} of {total}, {text}")

    def scoring(self) -> None:
        """Say that training has ended and the policies are scored."""
        self.stop()
        assert self._config is not None
        episodes = self._config.evaluation.episodes
        self.noted(f"scoring the best and the last policies on {episodes} fresh episodes")

    def noted(self, line: str) -> None:
        """Write a line, above the panel if there is one."""
        self._console.print(line, soft_wrap=True, markup=False)

    def stop(self) -> None:
        """Remove the panel and release the terminal."""
        if self._panel is not None:
            self._panel.stop()
            self._panel = None

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """Show the rows, their mean beside the paper's number, and the folder."""
        frame, _ = load_results([rows.parent])
        aer = f"AER {frame.aer.mean():.2f} ± {frame.aer.std(ddof=0):.2f}"
        performance = f"performance {frame.performance.mean():.3f}"
        result = f"{aer} over {count(len(frame), 'seed')}, {performance}"
        paper = self._paper_number(frame)
        reported = "" if paper is None else f"the paper reports {paper}"
        if not self._is_alone:
            beside = f"; {reported}" if reported else ""
            self.noted(f"{rows.parent}: {result}{beside}")
            return
        self._console.print(_seeds_table(frame))
        self.noted(result)
        if reported:
            self.noted(reported)
        if skipped:
            self.noted("already finished; resume=false runs it again in a new folder")
        self.noted(str(rows.parent))


def is_live(console: Console) -> bool:
    """Return whether a console can redraw a panel."""
    return console.is_terminal and not console.is_dumb_terminal


def _seeds_table(frame: pd.DataFrame) -> Table:
    """Return a table of the rows of one run."""
    first = frame.iloc[0]
    heads = ("seed", "AER", "± std", "last policy", "performance", "samples to best", "epochs")
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
    """Return what is shown after an epoch, by label; means are over seeds."""
    samples = progress.env_samples + progress.expert_samples
    facts = {}
    if record.curve:
        epoch = record.curve[-1].epoch
        latest = np.array([point.aer for point in record.curve if point.epoch == epoch])
        best = record.best_aer.mean()
        facts["evaluation return"] = f"{mean_and_std(latest)} (best so far {best:.1f})"
    facts["samples"] = f"{samples.mean():,.0f}"
    for shown in method.shown:
        values = progress.metrics.get(shown.metric)
        if values is not None and not np.isnan(values).any():
            facts[shown.label] = format(values.mean(), shown.form)
    if progress.stopped.any():
        facts["stopped"] = f"{progress.stopped.sum()} of {len(progress.stopped)} seeds"
    return facts


def mean_and_std(values: NDArray[np.float64]) -> str:
    """Format a mean and a standard deviation."""
    return f"{values.mean():.1f} ± {values.std():.1f}"


def count(number: int, noun: str) -> str:
    """Format a number of things, such as "1 seed" or "2 seeds"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def duration(seconds: float) -> str:
    """Format a time in its two largest units, such as "3 min 05 s"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
