"""Report a sweep's progress by the rows that its cells write, which works with every launcher."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
from omegaconf import DictConfig

from ril.cli.display import count, duration, mean_and_std
from ril.cli.sweep import Cell
from ril.config.schema import Config
from ril.io.rows import load_results
from ril.io.signals import Stopped, stop_on_signals
from ril.methods.registry import spec

_WATCH_SECONDS = 1.0
_RESUME = "give the same command again to resume"
_NO_REASON = f"wrote no rows, and the launcher gave no reason; {_RESUME}"


class SweepProgress:
    """A printer of a sweep's progress: at its start, whenever cells finish, and at its end.

    Args:
        cells: the cells of the sweep.
        launcher: configuration of Hydra's launcher.
        *output_dirs: folders of earlier runs, from whose times the remaining time is estimated.

    Attributes:
        pending: the cells to run.
    """

    def __init__(self, cells: Sequence[Cell], launcher: DictConfig, *output_dirs: Path) -> None:
        self._cells = cells
        self.pending = [cell for cell in cells if cell.config is not None and not cell.is_done]
        refused = sum(cell.config is None for cell in cells)
        finished = len(cells) - len(self.pending) - refused
        self._started = time.monotonic()
        self._seconds = _expected_seconds(self.pending, output_dirs)
        parts = [count(len(cells), "cell"), f"{finished} already finished"]
        if refused:
            parts.append(f"{refused} cannot be run")
        if self.pending:
            parts.append(f"{len(self.pending)} to run, {self._outlook(launcher)}")
        print(f"sweep: {', '.join(parts)}", flush=True)

    def _outlook(self, launcher: DictConfig) -> str:
        """Say how long the sweep will take, estimated from the times of earlier runs."""
        if np.isnan(self._seconds).all():
            return "time unknown until the first cell is finished"
        seconds = float(np.nansum(self._seconds))
        unknown = int(np.isnan(self._seconds).sum())
        more = f", plus {count(unknown, 'cell')} of unknown time" if unknown else ""
        # Only joblib's configuration says how many cells run at a time.
        if "n_jobs" not in launcher:
            return f"about {duration(seconds)} of computing{more}"
        at_once = min(joblib.effective_n_jobs(launcher.n_jobs), len(self.pending))
        return f"about {duration(seconds / at_once)}, {at_once} at a time{more}"

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Print the progress whenever a cell finishes within the block.

        Raises:
            SystemExit: the user stopped the sweep.
        """
        over = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(over,), daemon=True)
        watcher.start()
        try:
            with stop_on_signals() as stop:
                stop.immediate = True  # the cells have checkpoints
                yield
        except (Stopped, SystemExit) as end:  # a stopped cell in this process raises SystemExit
            message = f"ril-run: stopped with {self._finished()}; {_RESUME}"
            print(message, file=sys.stderr, flush=True)
            sys.exit(end.exit_status if isinstance(end, Stopped) else end.code)
        finally:
            over.set()
            watcher.join()

    def _watch(self, over: threading.Event) -> None:
        """Print the time left whenever more cells have finished, until `over` is set."""
        known = ~np.isnan(self._seconds)
        mean = self._seconds[known].mean() if known.any() else 1.0
        # At least 0.01, since their sum is a divisor and a recorded time may be 0.
        weights, before = np.maximum(np.where(known, self._seconds, mean), 0.01), 0
        while not over.wait(_WATCH_SECONDS):
            done = np.array([cell.is_done for cell in self.pending])
            if before < done.sum() < len(done):
                before = int(done.sum())
                elapsed = time.monotonic() - self._started
                left = elapsed * weights[~done].sum() / weights[done].sum()
                print(f"sweep: {self._finished()}, about {duration(left)} left", flush=True)

    def _finished(self) -> str:
        done = sum(cell.is_done for cell in self._cells)
        return f"{done} of {count(len(self._cells), 'cell')} finished"

    def lost(self, cells: Sequence[Cell], why: str) -> None:
        """Record that the launcher failed.

        Args:
            cells: the cells that it was running.
            why: the reason, as a sentence without a period.
        """
        print(f"sweep: {self._finished()}; {why}", flush=True)
        for cell in cells:
            cell.mistake = f"did not finish: {why}; {_RESUME}"

    def report(self) -> None:
        """Print the result of each cell, or why it has none.

        Raises:
            SystemExit: a cell has no rows.
        """
        print(f"sweep: {self._finished()}", flush=True)
        for cell in self._cells:
            if cell.is_done:
                newest = max(cell.runs, key=lambda path: path.stat().st_mtime_ns)
                aer = pd.read_csv(newest)["aer"].to_numpy()
                print(f"  {cell.command}\n    AER {mean_and_std(aer)}  {newest.parent}", flush=True)
        missing = [cell for cell in self._cells if not cell.is_done]
        for cell in missing:
            state, why = ("failed", cell.mistake) if cell.mistake else ("not finished", _NO_REASON)
            print(f"ril-run: {state}: {cell.command}\n  {why}", file=sys.stderr, flush=True)
        if missing:
            sys.exit(f"ril-run: {len(missing)} of {count(len(self._cells), 'cell')} without rows")


def _expected_seconds(cells: Sequence[Cell], folders: Sequence[Path]) -> np.ndarray:
    """Return the expected seconds of each cell (N,), by finished runs; NaN for a cell without."""
    rows, _ = load_results(folders)  # ril-report reports files that cannot be read
    return np.array([_expected(cell.config, rows) for cell in cells if cell.config is not None])


def _expected(config: Config, rows: pd.DataFrame) -> float:
    """Return the expected seconds of a run, in proportion to its budget."""
    past = rows[(rows["env"] == config.env.name) & (rows["method"] == config.method.name)]
    budget = spec(config.method.name).budget
    if not budget:
        return float(past["wall_seconds"].mean())
    return float((past["wall_seconds"] / past[budget]).mean() * getattr(config.method, budget))
