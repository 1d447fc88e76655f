from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from helpers.runs import CARTPOLE, QUICK, Ended

from ril.environments.environment import Environment
from ril.io.paths import config_folder
from ril.io.rows import Row, load_results
from ril.policy import load_policy
from ril.vectorized.evaluation import Evaluation

SCRIPTS = Path(sys.executable).parent


def shell(folder: Path, *command: str) -> Ended:
    """Run an installed console script as a process of its own."""
    done = subprocess.run(
        [SCRIPTS / command[0], *command[1:]],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return Ended(done.returncode, done.stdout, done.stderr)


def assert_one_line(ended: Ended, names: str, folder: Path) -> None:
    """Assert that it was refused in one line that names the key or file, and wrote nothing."""
    assert ended.status == 1
    assert ended.errors.startswith("ril-run: ")
    assert ended.errors.count("\n") == 1
    assert ended.errors.endswith("\n")
    assert names in ended.errors
    assert ended.output == ""
    assert not (folder / "outputs").exists()


def test_help_names_every_choice(here: Callable[..., Ended]) -> None:
    sections = {each.split("=")[0].strip(): each for each in here("--help").output.split("\n\n")}
    for group in ("env", "method", "experiment", "ablation"):
        for file in (config_folder() / group).glob("*.yaml"):
            assert re.search(rf"^ +{file.stem}\b", sections[group], re.MULTILINE), file.stem


def test_a_reader_who_stops_reading_is_no_mistake(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [SCRIPTS / "ril-run", "--help"], cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("argument", ["method.nope=1", "output_dir=f/x"])
def test_a_mistake_is_one_line_of_the_installed_command_too(tmp_path: Path, argument: str) -> None:
    (tmp_path / "f").touch()
    ended = shell(tmp_path, "ril-run", argument)
    assert_one_line(ended, argument.partition("=")[0], tmp_path)


@pytest.fixture(scope="session")
def quick_command(demonstration_files: dict[str, Path]) -> tuple[str, ...]:
    return *QUICK, *CARTPOLE, f"demonstrations={demonstration_files['cartpole']}"


@pytest.fixture(scope="module")
def first(
    tmp_path_factory: pytest.TempPathFactory, quick_command: tuple[str, ...]
) -> tuple[Path, Ended]:
    """The working folder of an installed `ril-run`, and how it ended."""
    folder = tmp_path_factory.mktemp("first")
    return folder, shell(folder, "ril-run", *quick_command)


@pytest.fixture(scope="module")
def results(first: tuple[Path, Ended]) -> Path:
    """The only run's folder."""
    folder, _ = first
    [found] = folder.rglob("results.csv")
    return found.parent


def test_a_run_ends_well_and_quietly(first: tuple[Path, Ended]) -> None:
    assert (first[1].status, first[1].errors) == (0, "")


def test_a_run_says_where_its_rows_are(first: tuple[Path, Ended], results: Path) -> None:
    assert first[1].output.splitlines()[-1] == str(results.relative_to(first[0]))


def test_a_run_writes_one_folder_and_nothing_else(first: tuple[Path, Ended], results: Path) -> None:
    assert results.parent == first[0] / "outputs" / "cartpole" / "ril"
    assert sorted(str(path.relative_to(results)) for path in first[0].rglob("*.*")) == [
        "config.yaml",
        "curve.csv",
        "policy.pt",
        "provenance.json",
        "results.csv",
    ]


ROW = [field.name for field in fields(Row)]
# docs/ril.md, "What is measured on the way".
CURVE = [
    *["seed", "epoch", "samples", "aer", "inverse_dynamics_loss", "cloning_loss", "epsilon"],
    *["training_return", "td_loss", "goals", "inverse_dynamics_accuracy", "label_accuracy"],
]


@pytest.mark.parametrize(("name", "columns"), [("results.csv", ROW), ("curve.csv", CURVE)])
def test_a_run_fills_its_tables(results: Path, name: str, columns: list[str]) -> None:
    table = pd.read_csv(results / name)
    assert table.columns.tolist() == columns
    assert set(table["seed"]) == {0, 1}
    may_be_empty = ["expert_return", "total_timesteps", "commit", "variant"]
    assert not table.drop(columns=may_be_empty, errors="ignore").isna().any().any()


def test_a_run_shows_the_rows_that_it_leaves(first: tuple[Path, Ended], results: Path) -> None:
    for row in pd.read_csv(results / "results.csv").itertuples():
        cells = [str(row.seed), f"{row.aer:.2f}", f"{row.aer_std:.2f}", f"{row.aer_last:.2f}"]
        lines = [line.replace("│", " ").split() for line in first[1].output.splitlines()]
        assert any(line[:4] == cells for line in lines)


def test_a_runs_policies_are_plain_tensors(results: Path) -> None:
    assert torch.load(results / "policy.pt", weights_only=True)["env_id"] == "CartPole-v1"


@pytest.mark.parametrize(("which", "column"), [("best", "aer"), ("last", "aer_last")])
def test_a_runs_policies_act_as_they_were_scored(
    results: Path, cartpole: Environment, which: str, column: str
) -> None:
    low, high = cartpole.low, cartpole.high
    for row in pd.read_csv(results / "results.csv").to_dict("records"):
        policy = load_policy(results / "policy.pt", row["seed"], which)

        class Scored:
            def frozen(self, policy: Any = policy) -> Any:
                def infer(scaled: np.ndarray) -> torch.Tensor:
                    raw = scaled * (high - low) / 2 + (high + low) / 2
                    return torch.from_numpy(policy.values(raw))[None]

                return infer

        returns = Evaluation(cartpole, [row["seed"]]).returns(Scored(), 3, "of the result")
        assert returns.mean() == row[column]


def test_a_runs_policy_plays(results: Path) -> None:
    policy = load_policy(results / "policy.pt", seed=1)
    copy = gym.make(policy.env_id)
    observation, _ = copy.reset(seed=0)
    for _ in range(5):
        action = int(policy.predict(observation))
        assert copy.action_space.contains(action)
        observation, *_ = copy.step(action)


@pytest.fixture(scope="module")
def second(
    first: tuple[Path, Ended], results: Path, quick_command: tuple[str, ...]
) -> tuple[Ended, bool]:
    """The same command again, and whether it left the rows as they were."""
    before = (results / "results.csv").stat().st_mtime_ns
    ended = shell(first[0], "ril-run", *quick_command)
    return ended, (results / "results.csv").stat().st_mtime_ns == before


def test_the_same_command_again_runs_nothing(second: tuple[Ended, bool]) -> None:
    ended, unchanged = second
    assert unchanged
    assert "already finished; resume=false runs it again" in ended.output
    assert "epoch" not in ended.output.replace("epochs", "")


def test_the_same_command_again_shows_the_same_rows(
    first: tuple[Path, Ended], second: tuple[Ended, bool]
) -> None:
    def shown(ended: Ended) -> list[str]:
        return [line for line in ended.output.splitlines() if line.startswith(("│", "AER"))]

    assert shown(second[0]) == shown(first[1])
    assert len(shown(second[0])) == 3


def test_without_resume_it_runs_again_in_a_new_folder(
    here: Callable[..., Ended], tmp_path: Path, quick_command: tuple[str, ...]
) -> None:
    for _ in range(2):
        assert here(*quick_command, "resume=false").status == 0
    folders = sorted(path.parent.name for path in tmp_path.rglob("results.csv"))
    assert folders == [folders[0], f"{folders[0]}-2"]


def test_the_report_reads_what_a_run_left(first: tuple[Path, Ended], results: Path) -> None:
    # The run's settings are not Table 2's, so its cell stays empty there.
    ended = shell(first[0], "ril-report", "table2")
    assert (ended.status, ended.errors) == (0, "")
    assert "- not run: RIL on CartPole, Acrobot" in ended.output


def test_the_report_shows_a_run_in_the_papers_setting(
    here: Callable[..., Ended], tmp_path: Path
) -> None:
    assert here("env=cartpole", "seeds=1", "method.epochs=1").status == 0
    [path] = tmp_path.rglob("results.csv")
    [row] = pd.read_csv(path).to_dict("records")
    ended = shell(tmp_path, "ril-report", "table2")
    assert f"| {row['aer']:.2f} ± 0.00 (1) " in ended.output
    assert "- 1 of 10 seeds: RIL on CartPole\n- 1 of 150 epochs: RIL on CartPole\n" in ended.output


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("ablation.k=3", False),
        ("resume=false", False),
        ("method.q_learning.discount=0.95", False),  # the default, spelled out
        ("method.q_learning.discount=0.8", True),
        ("fidelity=paper", False),  # changes nothing on CartPole
    ],
)
def test_rows_name_their_non_default_values(
    here: Callable[..., Ended],
    tmp_path: Path,
    quick_command: tuple[str, ...],
    override: str,
    named: bool,
) -> None:
    assert here(*quick_command, override).status == 0
    found = load_results([tmp_path])[0]["variant"].iloc[0].split()
    assert (override in found) is named
    assert [each for each in found if each.startswith("demonstrations=cartpole.npz@")]
    assert not [each for each in found if each.startswith(("method.epochs", "ablation", "seeds"))]


def test_a_sweep_leaves_a_run_per_cell(
    here: Callable[..., Ended], tmp_path: Path, quick_command: tuple[str, ...]
) -> None:
    assert here("-m", "hydra.launcher.n_jobs=1", *quick_command, "ablation.k=1,3").status == 0
    tables = [pd.read_csv(path) for path in tmp_path.rglob("results.csv")]
    assert sorted(table["k"].iloc[0] for table in tables) == [1, 3]


def test_the_configuration_can_be_shown(here: Callable[..., Ended], tmp_path: Path) -> None:
    ended = here("env=acrobot", "--cfg", "job")
    assert (ended.status, ended.errors) == (0, "")
    assert "id: Acrobot-v1" in ended.output
    assert not (tmp_path / "outputs").exists()


def test_interrupting_a_run_is_one_line(tmp_path: Path) -> None:
    command = ("seeds=1", "compile=false")
    process = subprocess.Popen(
        [SCRIPTS / "ril-run", *command],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        assert " epochs" in process.stdout.readline()  # training begins
        time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 128 + signal.SIGINT
    said = rf"ril-run: stopped after epoch \d+; resume with ril-run {' '.join(command)}\n"
    assert re.fullmatch(said, errors)
    assert list(tmp_path.rglob("checkpoint.pt"))
    assert not list(tmp_path.rglob("results.csv"))


def test_completion_knows_groups_and_keys(
    here: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch
) -> None:
    for line, expected in (
        ("ril-run env=", "env=mountaincar"),
        ("ril-run experiment=", "experiment=table9"),
        ("ril-run method=dqn ablation.", "ablation.k="),
    ):
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_POINT", str(len(line)))
        assert expected in here("-sc", "query=bash").output.split()


def test_completion_can_be_installed(here: Callable[..., Ended]) -> None:
    assert "hydra_bash_completion ril-run" in here("-sc", "install=bash").output


def test_help_and_completion_load_nothing_heavy() -> None:
    heavy = "{'torch', 'gymnasium', 'pandas', 'joblib', 'numpy'}"
    modules = "ril.cli.run, hydra_plugins.ril_sweeper"
    code = f"import sys, {modules}; sys.exit(str({heavy} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert done.stderr == "set()\n"
