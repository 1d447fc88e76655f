"""Loggers of a run's curve: what they get, and when."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.runs import Ended, Silence

from ril.config.schema import Config
from ril.io.rows import CurvePoint
from ril.methods.base import Progress
from ril.run.experiment import run
from ril.run.loggers import LoggedDisplay, TensorBoard

PAGE = Path(__file__).parents[2] / "docs" / "logging.md"


class Kept:
    """A logger that keeps the points of each call."""

    def __init__(self) -> None:
        self.started: list[Path] = []
        self.logged: list[list[CurvePoint]] = []

    def start(self, config: Config, folder: Path) -> None:
        self.started.append(folder)

    def log(self, points: Sequence[CurvePoint]) -> None:
        self.logged.append(list(points))

    def finish(self) -> None: ...


def test_a_logger_gets_the_curve(quick: Any, tmp_path: Path, silence: Silence) -> None:
    config, kept = quick(), Kept()
    config.output_dir = str(tmp_path)
    folder = run(config, LoggedDisplay(silence, kept))
    curve = pd.read_csv(folder / "curve.csv")
    given = [(p.seed, p.epoch, p.samples, p.aer) for points in kept.logged for p in points]
    assert given == [*curve[["seed", "epoch", "samples", "aer"]].itertuples(index=False, name=None)]
    assert kept.started == [folder]


def test_a_logger_gets_the_points_of_one_epoch_at_a_time(
    quick: Any, tmp_path: Path, silence: Silence
) -> None:
    config, kept = quick("evaluation.every=1"), Kept()
    config.output_dir = str(tmp_path)
    run(config, LoggedDisplay(silence, kept))
    assert [{point.epoch for point in points} for points in kept.logged] == [{1}, {2}, {3}]


def test_a_finished_cell_is_not_logged(quick: Any, tmp_path: Path, silence: Silence) -> None:
    config, kept = quick(), Kept()
    config.output_dir = str(tmp_path)
    run(config, silence)
    run(config, LoggedDisplay(silence, kept))
    assert (kept.started, kept.logged) == ([], [])


def point(seed: int, epoch: int, **metrics: float) -> CurvePoint:
    return CurvePoint(seed, epoch, samples=100 * epoch + seed, aer=float(epoch), metrics=metrics)


def test_a_resumed_run_logs_only_points_that_its_checkpoint_lacks(silence: Silence) -> None:
    kept = Kept()
    display = LoggedDisplay(silence, kept)
    record: Any = SimpleNamespace(curve=[point(0, 1), point(0, 2)])
    none = np.zeros(1, dtype=np.int64)
    for epoch in (3, 4, 5):
        if epoch > 3:
            record.curve.append(point(0, epoch))
        display.advanced(Progress(epoch, none, none, 0, none.astype(bool)), record)
    assert kept.logged == [[point(0, 4)], [point(0, 5)]]


class Writer:
    """A stand-in for TensorBoard's writer; `made` has one by folder."""

    made: dict[str, Writer]

    def __init__(self, folder: str, purge_step: int) -> None:
        self.purge_step, self.scalars = purge_step, list[tuple[str, float, int]]()
        self.made[Path(folder).name] = self

    def add_scalar(self, name: str, value: float, step: int) -> None:
        self.scalars.append((name, value, step))

    def flush(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def tensorboard(monkeypatch: pytest.MonkeyPatch) -> dict[str, Writer]:
    """The writers of a stand-in for TensorBoard, by run."""
    module = ModuleType("torch.utils.tensorboard")
    monkeypatch.setattr(Writer, "made", {}, raising=False)
    module.SummaryWriter = Writer  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    return Writer.made


def test_tensorboard_has_a_run_per_seed_and_their_mean(
    quick: Any, tensorboard: dict[str, Writer], tmp_path: Path
) -> None:
    board = TensorBoard()
    board.start(quick("seeds=[3,5]"), tmp_path)
    board.log([point(3, 7, loss=1.0), point(5, 7, loss=np.nan)])
    assert tensorboard["seed_3"].scalars == [
        *[("aer", 7.0, 703), ("epoch", 7, 703), ("samples", 703, 703), ("loss", 1.0, 703)]
    ]
    assert "loss" not in [name for name, *_ in tensorboard["seed_5"].scalars]
    assert ("samples", 704.0, 704) in tensorboard["mean"].scalars


def test_tensorboards_mean_ends_with_the_first_seed_that_stops(
    quick: Any, tensorboard: dict[str, Writer], tmp_path: Path
) -> None:
    board = TensorBoard()
    board.start(quick("seeds=[3,5]"), tmp_path)
    board.log([point(3, 1), point(5, 1)])
    board.log([point(5, 2)])
    assert {step for *_, step in tensorboard["mean"].scalars} == {104}
    assert {step for *_, step in tensorboard["seed_5"].scalars} == {105, 205}


def test_tensorboard_purges_points_that_are_written_again(
    quick: Any, tensorboard: dict[str, Writer], tmp_path: Path
) -> None:
    board = TensorBoard()
    board.start(quick("seeds=[3]"), tmp_path)
    for epoch in (4, 5):
        board.log([point(3, epoch)])
    assert {name: writer.purge_step for name, writer in tensorboard.items()} == {
        "seed_3": 403,
        "mean": 403,
    }


def test_tensorboards_files_have_each_point_once(quick: Any, tmp_path: Path) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", exc_type=ImportError
    )
    for epochs in ((1, 2, 3), (2, 3, 4)):  # a run that was killed, and resumed after epoch 1
        board = TensorBoard()
        board.start(quick("seeds=[3]"), tmp_path)
        for epoch in epochs:
            board.log([point(3, epoch)])
        board.finish()
    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard" / "seed_3")).Reload()
    assert [event.value for event in events.Scalars("aer")] == [1, 2, 3, 4]


def test_a_missing_package_is_one_line(
    here: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    ended = here("logging=tensorboard")
    assert (ended.status, ended.output) == (1, "")
    assert ended.errors.startswith("ril-run: logging=tensorboard: cannot be used (")
    assert ended.errors.endswith("; pip install -e '.[tensorboard]')\n")
    assert not (tmp_path / "outputs").exists()


def test_a_logger_of_the_user_works_as_documented(
    here: Callable[..., Ended],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    demonstration_files: dict[str, Path],
    quick: Any,
) -> None:
    logged: list[tuple[dict[str, float], int]] = []
    runs: list[dict[str, Any]] = []
    wandb: Any = ModuleType("wandb")

    def init(**settings: Any) -> Any:
        runs.append(settings)
        keep = lambda values, step: logged.append((values, step))  # noqa: E731
        return SimpleNamespace(log=keep, finish=lambda: runs.append({"finished": True}))

    wandb.init = init
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    text = PAGE.read_text(encoding="utf-8")
    [code], [own] = (
        re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL) for kind in ("python", "yaml")
    )
    (tmp_path / "my_loggers.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own" / "logging").mkdir(parents=True)
    (tmp_path / "own" / "logging" / "wandb.yaml").write_text(own)
    from helpers.runs import CARTPOLE, QUICK

    file = demonstration_files["cartpole"]
    command = (*QUICK, *CARTPOLE, f"demonstrations={file}", "logging=wandb")
    ended = here(f"--config-dir={tmp_path / 'own'}", *command)
    assert (ended.status, ended.errors) == (0, "")
    [folder] = (path.parent for path in tmp_path.rglob("results.csv"))
    assert (runs[0]["id"], runs[0]["project"], runs[-1]) == (folder.name, "ril", {"finished": True})
    curve = pd.read_csv(folder / "curve.csv")
    assert {step for _, step in logged} == set(curve["epoch"])
    assert logged[-1][0]["seed 1/aer"] == curve["aer"].iloc[-1]
