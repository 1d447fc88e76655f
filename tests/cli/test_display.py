"""What a run shows on a terminal and in a log file."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from rich.console import Console

from ril.cli import display as display_module
from ril.cli.display import ConsoleDisplay
from ril.methods.base import Progress
from ril.report.beside import paper_cell
from ril.run import training
from ril.run.experiment import run
from ril.run.record import Record


def shown(config: Any, folder: Path, *, live: bool, alone: bool = True) -> str:
    """What a run writes on a terminal, or into a log file."""
    config.output_dir = str(folder)
    written = io.StringIO()
    console = Console(file=written, force_terminal=live, width=100, highlight=False)
    display = ConsoleDisplay(console, live=live, alone=alone, paper_number=paper_cell)
    try:
        run(config, display)
    finally:
        display.stop()
    return written.getvalue()


@pytest.mark.parametrize("live", [True, False])
def test_a_run_ends_with_its_mean_and_its_folder(quick: Any, tmp_path: Path, live: bool) -> None:
    lines = shown(quick(), tmp_path, live=live).splitlines()
    [path] = tmp_path.rglob("results.csv")
    rows = pd.read_csv(path)
    mean, spread = rows["aer"].mean(), rows["aer"].std(ddof=0)
    assert lines[-1] == str(path.parent)
    assert any(line.startswith(f"AER {mean:.2f} ± {spread:.2f} over 2 seeds") for line in lines)


def test_a_cell_of_a_sweep_ends_with_one_line(quick: Any, tmp_path: Path) -> None:
    text = shown(quick("ablation.n=150"), tmp_path, live=False, alone=False)
    [path] = tmp_path.rglob("results.csv")
    aer = pd.read_csv(path)["aer"]
    last = text.partition("scoring")[2].splitlines()[1:]
    assert len(last) == 1
    assert last[0].startswith(f"{path.parent}: AER {aer.mean():.2f} ± {aer.std(ddof=0):.2f} over")
    assert "; the paper reports 500.00 ± 0.00" in last[0]


def test_a_log_has_a_line_for_the_last_epoch(quick: Any, tmp_path: Path) -> None:
    lines = shown(quick(), tmp_path, live=False).splitlines()
    [folder] = (path.parent for path in tmp_path.rglob("results.csv"))
    [line] = [line for line in lines if ": epoch " in line]
    assert line.startswith(f"cartpole ril {folder.name}: epoch 3 of 3, evaluation return ")
    for fact in ("(best so far ", ", samples ", ", time left 0 s"):
        assert fact in line


def test_a_terminal_shows_the_epoch(quick: Any, tmp_path: Path) -> None:
    assert "epoch 3 of 3" in shown(quick(), tmp_path, live=True)


def test_only_a_cell_of_the_paper_has_the_papers_number(quick: Any, tmp_path: Path) -> None:
    text = shown(quick("ablation.n=150"), tmp_path, live=False)
    assert "\nthe paper reports 500.00 ± 0.00" in text
    assert "the paper reports" not in shown(quick("ablation.k=9"), tmp_path, live=False)


def test_a_finished_run_says_how_to_run_it_again(quick: Any, tmp_path: Path) -> None:
    before, after = (shown(quick(), tmp_path, live=False) for _ in range(2))
    assert "resume=false runs it again" not in before
    assert "resume=false runs it again" in after


def rates(config: Any, folder: Path, times: list[float], samples: list[int]) -> list[str]:
    """The steps per second in a log, after epochs that end at these times with these steps."""
    written = io.StringIO()
    clock = iter([times[0] - 20, *times])
    with pytest.MonkeyPatch.context() as patch:
        now = [next(clock)]
        patch.setattr(display_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
        display = ConsoleDisplay(Console(file=written, width=200), live=False)
        display.started(config, folder, 9)
        for epoch, (time, steps) in enumerate(zip(times, samples, strict=True), start=1):
            now[0] = time
            each, none = np.array([steps, steps]), np.zeros(2, dtype=np.int64)
            stopped = np.zeros(2, dtype=bool)
            progress = Progress(epoch, each, none, 0, stopped)
            display.advanced(progress, Record((0, 1), torch.zeros(2, 1)))
    lines = [line for line in written.getvalue().splitlines() if ": epoch " in line]
    assert len(lines) == len(times)
    found = (re.search(r"steps per second ([\d,.]+) \(all seeds\)", line) for line in lines)
    return ["" if match is None else match[1] for match in found]


def test_a_log_has_the_steps_per_second_since_the_first_epoch(quick: Any, tmp_path: Path) -> None:
    # The two seeds together make 2 · (6000 − 1000) steps in 20 s, and 2 · 29000 in 40 s.
    found = rates(quick(), tmp_path, [100.0, 120.0, 140.0], [1000, 6000, 30_000])
    assert found == ["", "500", "1,450"]


def test_a_method_without_environment_steps_has_no_rate(quick: Any, tmp_path: Path) -> None:
    assert rates(quick(), tmp_path, [100.0, 120.0], [0, 0]) == ["", ""]


class Interrupted(ConsoleDisplay):
    """Interrupt a run in its third epoch, as Ctrl-C does."""

    def advanced(self, progress: Progress, record: Record) -> None:
        if progress.epoch == 3:
            raise KeyboardInterrupt


def test_a_resumed_run_says_so(quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    config = quick()
    config.output_dir = str(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run(config, Interrupted(Console(file=io.StringIO()), live=False))
    assert "resumed from its checkpoint" in shown(config, tmp_path, live=False).splitlines()[0]
