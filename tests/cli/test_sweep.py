"""Which cells a sweep runs, and what it prints about them."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.runs import CARTPOLE, QUICK, QUICK_RUN, Ended, composed, quick_method
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from joblib.externals.loky.process_executor import TerminatedWorkerError
from omegaconf import DictConfig, OmegaConf

from ril.cli import sweep_progress
from ril.cli.configuration import from_hydra
from ril.cli.sweep import Cell, expand, plan
from ril.cli.sweep_progress import SweepProgress
from ril.io.errors import UserError

Here = Callable[..., Ended]
BASIC = ("-m", "hydra/launcher=basic")
RANDOM = ("env=cartpole", "method=random", "seeds=1", "evaluation.episodes=2")


def cell_sweeper() -> Any:
    """ril's sweeper in the module that Hydra has loaded."""
    Plugins.instance()
    return sys.modules["hydra_plugins.ril_sweeper"].CellSweeper(None)


def expanded(sweeps: list[dict[str, str]] | None, *arguments: str) -> list[list[str]]:
    """The overrides of each cell."""
    return expand(sweeps, arguments, OverridesParser.create())


def test_a_sweep_has_every_combination() -> None:
    assert expanded(None, "a=1,2", "b=x") == [["a=1", "b=x"], ["a=2", "b=x"]]


def test_several_sweeps_are_one_list_of_cells() -> None:
    cells = expanded([{"a": "1,2"}, {"b": "3", "c": "x,y"}], "d=0")
    assert cells == [
        *[["d=0", "a=1"], ["d=0", "a=2"]],
        *[["d=0", "b=3", "c=x"], ["d=0", "b=3", "c=y"]],
    ]


def test_the_command_line_narrows_a_sweep() -> None:
    assert expanded([{"a": "1,2,3"}], "a=3.0,1") == [["a=1"], ["a=3"]]


def test_a_sweep_without_a_value_of_the_command_line_is_skipped() -> None:
    sweeps = [{"env": "x", "level": "null,4"}, {"env": "y", "level": "null,-1"}]
    assert expanded(sweeps, "env=y") == [["env=y", "level=null"], ["env=y", "level=-1"]]
    assert expanded(sweeps, "level=4") == [["env=x", "level=4"]]


def test_a_command_line_that_skips_every_sweep_is_refused() -> None:
    with pytest.raises(UserError, match=r"^a=4: the sweep has only a=1,2$"):
        expanded([{"a": "1,2"}], "a=4")


def planned(jobs: list[list[str]], *overrides: str) -> list[Cell]:
    def with_hydra(job: list[str]) -> DictConfig:
        found = composed(*overrides, *job).copy()
        OmegaConf.update(found, "hydra", hydra, force_add=True)
        return found

    hydra = {"sweeper": {"sweeps": None}, "runtime": {"config_sources": []}}
    return plan(jobs, with_hydra, OmegaConf.create({"hydra": hydra}))


def test_a_cell_that_is_given_twice_runs_once(tmp_path: Path) -> None:
    jobs = [["ablation.k=1"], ["ablation.k=2"], ["ablation.k=2.0"]]
    assert len(planned(jobs, f"output_dir={tmp_path}")) == 2
    assert len(planned(jobs, f"output_dir={tmp_path}", "method=bc")) == 1


def test_a_refused_cell_does_not_stop_the_others(tmp_path: Path) -> None:
    cells = planned([["ablation.k=0"], ["ablation.k=1"]], f"output_dir={tmp_path}")
    assert [cell.mistake for cell in cells] == [
        "ablation.k=0.0: must be a finite number above 0",
        None,
    ]


def test_a_sweep_of_refused_cells_only_is_refused() -> None:
    with pytest.raises(UserError, match=r"^ablation\.k=0\.0: must be .* above 0$"):
        planned([["ablation.k=0"], ["ablation.k=0", "seeds=1"]])


def test_a_sweep_over_methods_may_set_keys_that_ril_lacks(here: Here, tmp_path: Path) -> None:
    command = (*BASIC, *CARTPOLE, *QUICK_RUN, *quick_method("dqn"))
    ended = here(*command, "method=dqn,dqn_prioritized")
    assert (ended.status, ended.errors) == (0, "")
    rows = [pd.read_csv(path) for path in tmp_path.rglob("results.csv")]
    assert {(row["method"][0], row["total_timesteps"][0]) for row in rows} == {
        ("dqn", 60),
        ("dqn_prioritized", 60),
    }


@pytest.fixture
def mixed(here: Here) -> Ended:
    """A sweep with a cell that fails, before two that do not."""
    return here(*BASIC, *RANDOM, "demonstrations=none.npz,null", "seeds=1,2")


def test_a_failed_cell_is_reported_with_its_command(mixed: Ended, tmp_path: Path) -> None:
    assert mixed.status == 1
    [*_, last] = mixed.errors.splitlines()
    assert last == "ril-run: 2 of 4 cells without rows"
    failed = [line for line in mixed.errors.splitlines() if line.startswith("ril-run: failed: ")]
    assert failed == [
        f"ril-run: failed: ril-run env=cartpole method=random seeds={seeds} evaluation.episodes=2 "
        "demonstrations=none.npz"
        for seeds in (1, 2)
    ]
    assert mixed.errors.count("demonstrations=none.npz: no such file or folder") == 2
    assert len(list(tmp_path.rglob("results.csv"))) == 2


def test_a_sweep_says_what_it_will_run(mixed: Ended) -> None:
    assert mixed.output.startswith(
        "sweep: 4 cells, 0 already finished, 2 cannot be run, 2 to run, time unknown "
    )


def test_a_finished_sweep_runs_nothing_again(here: Here) -> None:
    command = (*BASIC, *RANDOM, "ablation.expert_return=null,400")
    assert here(*command).status == 0
    again = here(*command)
    assert again.status == 0
    assert again.output.startswith(
        "sweep: 2 cells, 2 already finished\nsweep: 2 of 2 cells finished\n"
    )


def test_without_resume_a_sweep_runs_again_in_new_folders(here: Here, tmp_path: Path) -> None:
    command = (*BASIC, *RANDOM, "ablation.expert_return=null,400", "resume=false")
    for _ in range(2):
        ended = here(*command)
        assert "2 to run" in ended.output
        assert "2 of 2 cells finished" in ended.output
    assert len(list(tmp_path.rglob("results.csv"))) == 4


def test_a_cells_rows_name_its_own_command(here: Here, tmp_path: Path) -> None:
    here(*BASIC, *RANDOM, "ablation.expert_return=null,400")
    said = "\n".join(path.read_text() for path in tmp_path.rglob("provenance.json"))
    for level in ("null", "400"):
        assert f'"ril-run {" ".join(RANDOM)} ablation.expert_return={level}"' in said


def test_workers_find_the_users_own_configuration(
    here: Here, tmp_path: Path, demonstration_files: dict[str, Path]
) -> None:
    own = tmp_path / "own"
    for name, text in {
        "env/short.yaml": "name: short\nid: CartPole-v1\nkwargs: {max_episode_steps: 20}\n"
        "goal: {minimum_return: 11}\nobservation_low: [-2, -3, -1, -3]\n"
        "observation_high: [2, 3, 1, 3]\n",
        "experiment/slopes.yaml": "# @package _global_\nablation: {n: 5}\nhydra:\n  sweeper:\n"
        "    sweeps:\n      - env: short\n        ablation.k: 1,2\n",
    }.items():
        (own / name).parent.mkdir(parents=True)
        (own / name).write_text(text)
    demonstrations = f"demonstrations={demonstration_files['cartpole']}"
    own_flag = f"--config-dir={own}"
    command = (own_flag, "-m", "experiment=slopes", *QUICK, demonstrations)
    ended = here(*command, "hydra.launcher.n_jobs=2")
    assert (ended.status, ended.errors) == (0, "")
    rows = pd.concat(pd.read_csv(path) for path in tmp_path.rglob("results.csv"))
    assert (set(rows["env"]), set(rows["n"]), set(rows["k"])) == ({"short"}, {5}, {1, 2})
    assert not any("env." in variant for variant in rows["variant"])
    assert f"ril-run {own_flag} experiment=slopes" in ended.output


def cells(folder: Path, count: int) -> list[Cell]:
    """Cells of a sweep, none of which has run."""
    configs = [from_hydra(composed("method=random", f"seeds={n + 1}")) for n in range(count)]
    return [
        Cell([f"seeds={n + 1}"], f"ril-run seeds={n + 1}", config, folder / str(n))
        for n, config in enumerate(configs)
    ]


def finish(cell: Cell, aer: float = 1.0) -> None:
    cell.folder.mkdir()
    (cell.folder / "results.csv").write_text(f"aer\n{aer}\n")


def test_a_sweep_says_when_a_cell_has_finished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep_progress, "_WATCH_SECONDS", 0.01)
    first, second = cells(tmp_path, 2)
    progress = SweepProgress([first, second], OmegaConf.create(), tmp_path)
    said = capsys.readouterr().out
    assert said == (
        "sweep: 2 cells, 0 already finished, 2 to run, "
        "time unknown until the first cell is finished\n"
    )
    with progress.watched():
        finish(first)
        for _ in range(500):
            if said := capsys.readouterr().out:
                break
            time.sleep(0.01)
    assert said == "sweep: 1 of 2 cells finished, about 0 s left\n"


def test_the_time_of_a_cell_follows_from_finished_ones_by_its_budget() -> None:
    rows = pd.DataFrame(
        {
            "env": ["mountaincar", "mountaincar", "cartpole"],
            "method": ["ril", "bc", "ril"],
            "epochs": [50, 50, 50],
            "wall_seconds": [30.0, 1.0, 2.0],
        }
    )
    config = from_hydra(composed("env=mountaincar", "method=ril", "method.epochs=100"))
    assert sweep_progress._expected(config, rows) == 60.0
    other = from_hydra(composed("env=acrobot", "method=ril"))
    assert np.isnan(sweep_progress._expected(other, rows))


def test_a_stopped_sweep_says_how_many_cells_are_finished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = cells(tmp_path, 2)
    progress = SweepProgress([first, second], OmegaConf.create(), tmp_path)
    finish(first)
    with pytest.raises(SystemExit) as end, progress.watched():
        signal.raise_signal(signal.SIGTERM)
    assert end.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == (
        "ril-run: stopped with 1 of 2 cells finished; give the same command again to resume\n"
    )


class Launcher:
    """Finish one cell, and raise an error at the next."""

    def __init__(self, by_key: dict[str, Cell], error: Exception) -> None:
        self.by_key, self.error = by_key, error
        self.launched: list[list[str]] = []

    def launch(self, jobs: list[list[str]], initial_job_idx: int) -> list[Any]:
        self.launched.append([job[0] for job in jobs])
        finish(self.by_key[jobs[0][0]])
        if len(jobs) > 1:
            raise self.error
        return [SimpleNamespace(status=None)]


def launched(folder: Path, error: Exception) -> tuple[list[list[str]], SweepProgress]:
    """The jobs of each call of a launcher that raises an error, and the sweep's progress."""
    both = cells(folder, 2)
    sweeper, progress = cell_sweeper(), SweepProgress(both, OmegaConf.create(), folder)
    launcher = Launcher({cell.overrides[0]: cell for cell in both}, error)
    sweeper.launcher = launcher
    sweeper._launch(both, 0, progress)
    return launcher.launched, progress


def test_a_killed_worker_does_not_end_a_sweep(tmp_path: Path) -> None:
    jobs, progress = launched(tmp_path, TerminatedWorkerError("killed"))
    assert jobs == [["seeds=1", "seeds=2"], ["seeds=2"]]
    progress.report()  # does not exit


def test_a_launcher_that_fails_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs, progress = launched(tmp_path, RuntimeError("no such\npartition"))
    assert jobs == [["seeds=1", "seeds=2"]]
    with pytest.raises(SystemExit):
        progress.report()
    assert capsys.readouterr().err == (
        "ril-run: failed: ril-run seeds=2\n"
        "  did not finish: no such partition; give the same command again to resume\n"
    )


def test_a_cell_without_rows_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    progress = SweepProgress(cells(tmp_path, 1), OmegaConf.create(), tmp_path)
    with pytest.raises(SystemExit, match=r"^ril-run: 1 of 1 cell without rows$"):
        progress.report()
    assert capsys.readouterr().err == (
        "ril-run: not finished: ril-run seeds=1\n"
        "  wrote no rows, and the launcher gave no reason; give the same command again to resume\n"
    )


def test_a_cell_with_torn_rows_is_not_finished(here: Here, tmp_path: Path) -> None:
    command = (*BASIC, *RANDOM, "ablation.expert_return=null,400")
    assert here(*command).status == 0
    torn, _ = sorted(tmp_path.rglob("results.csv"))
    torn.write_text(torn.read_text()[:-5])
    ended = here(*command)
    assert ended.status == 1
    assert ended.output.startswith("sweep: 2 cells, 1 already finished, 1 cannot be run\n")
    assert f"{torn.relative_to(tmp_path)}: line 2: is incomplete: " in ended.errors
