"""What becomes of a sweep's cells, seen by the rows that they leave, whoever runs them."""

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
_NO_REASON = "left no rows, and its launcher did not say why; the same command goes on"


class SweepProgress:
    """Says how far a sweep is: at its start, whenever a cell ends, and at its end.

    Args:
        cells: of the sweep.
        launcher: Hydra's, as it is configured.
        output_dir: whose rows say how long such cells take.

    Attributes:
        pending: the cells that are to be run.
    """

    def __init__(self, cells: Sequence[Cell], launcher: DictConfig, output_dir: Path) -> None:
        self._cells = cells
        self.pending = [cell for cell in cells if cell.config is not None and not cell.is_done]
        refused = sum(cell.config is None for cell in cells)
        before = len(cells) - len(self.pending) - refused
        self._started = time.monotonic()
        self._seconds = _expected_seconds(self.pending, output_dir)
        said = [count(len(cells), "cell"), f"{before} done before"]
        if refused:
            said.append(f"{refused} cannot be run")
        if self.pending:
            said.append(f"{len(self.pending)} to run, {self._outlook(launcher)}")
        print(f"sweep: {', '.join(said)}", flush=True)

    def _outlook(self, launcher: DictConfig) -> str:
        """How long it will take, by what such cells took before."""
        if np.isnan(self._seconds).all():
            return "for how long is unknown until the first is done"
        seconds = float(np.nansum(self._seconds))
        unknown = int(np.isnan(self._seconds).sum())
        more = f", and {count(unknown, 'cell')} of which none was run yet" if unknown else ""
        # Of other launchers, only the cluster knows how many cells run at a time.
        if "n_jobs" not in launcher:
            return f"about {duration(seconds)} of computing{more}"
        at_once = min(joblib.effective_n_jobs(launcher.n_jobs), len(self.pending))
        return f"about {duration(seconds / at_once)}, {at_once} at a time{more}"

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Say so whenever a cell of the block ends.

        Raises:
            SystemExit: the user stopped it.
        """
        over = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(over,), daemon=True)
        watcher.start()
        try:
            with stop_on_signals() as stop:
                stop.immediate = True  # the cells keep checkpoints
                yield
        except (Stopped, SystemExit) as end:  # the latter of a cell that was stopped
            said = f"ril-run: stopped with {self._done()}; the same command goes on"
            print(said, file=sys.stderr, flush=True)
            sys.exit(end.exit_status if isinstance(end, Stopped) else end.code)
        finally:
            over.set()
            watcher.join()

    def _watch(self, over: threading.Event) -> None:
        known = ~np.isnan(self._seconds)
        usual = self._seconds[known].mean() if known.any() else 1.0
        # Never 0, as the time of a cell that ended at once may be.
        weights, before = np.maximum(np.where(known, self._seconds, usual), 0.01), 0
        while not over.wait(_WATCH_SECONDS):
            done = np.array([cell.is_done for cell in self.pending])
            if before < done.sum() < len(done):
                before = int(done.sum())
                elapsed = time.monotonic() - self._started
                left = elapsed * weights[~done].sum() / weights[done].sum()
                print(f"sweep: {self._done()}, about {duration(left)} left", flush=True)

    def _done(self) -> str:
        done = sum(cell.is_done for cell in self._cells)
        return f"{done} of {count(len(self._cells), 'cell')} done"

    def lost(self, cells: Sequence[Cell], why: str) -> None:
        """The launcher failed; those of some cells that have no rows are still to be run."""
        print(f"sweep: {self._done()}; {why}", flush=True)
        for cell in cells:
            cell.mistake = f"did not end: {why}; the same command goes on"

    def report(self) -> None:
        """Say what each cell came to.

        Raises:
            SystemExit: one has no rows.
        """
        print(f"sweep: {self._done()}", flush=True)
        for cell in self._cells:
            if cell.is_done:
                newest = max(cell.runs, key=lambda path: path.stat().st_mtime_ns)
                aer = pd.read_csv(newest)["aer"].to_numpy()
                print(f"  {cell.command}\n    AER {mean_and_std(aer)}  {newest.parent}", flush=True)
        missing = [cell for cell in self._cells if not cell.is_done]
        for cell in missing:
            what, why = ("failed", cell.mistake) if cell.mistake else ("not done", _NO_REASON)
            print(f"ril-run: {what}: {cell.command}\n  {why}", file=sys.stderr, flush=True)
        if missing:
            sys.exit(f"ril-run: {len(missing)} of {count(len(self._cells), 'cell')} without rows")


def _expected_seconds(cells: Sequence[Cell], output_dir: Path) -> np.ndarray:
    """Seconds that each cell will take, by those of finished ones; NaN where there is none."""
    rows, _ = load_results([output_dir])  # ril-report will say what it cannot use
    return np.array([_expected(cell.config, rows) for cell in cells if cell.config is not None])


def _expected(config: Config, rows: pd.DataFrame) -> float:
    like = rows[(rows["env"] == config.env.name) & (rows["method"] == config.method.name)]
    budget = spec(config.method.name).budget
    if not budget:
        return float(like["wall_seconds"].mean())
    return float((like["wall_seconds"] / like[budget]).mean() * getattr(config.method, budget))
