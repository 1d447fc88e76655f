"""The paper's sweeps, `conf/experiment/*.yaml` and `conf/ablation/*.yaml`."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import pytest
from helpers.runs import CARTPOLE, Ended, composed
from hydra import compose, initialize_config_dir

from ril.cli.configuration import from_hydra, store_schemas
from ril.demonstrations.files import demonstrations_path
from ril.io.paths import config_folder
from ril.report.paper.tables import ENVIRONMENTS, TABLES, table
from ril.run.identity import run_id

ENVS = tuple(ENVIRONMENTS)
BY_REWARDS = ("dqn", "dqn_prioritized", "ppo", "acktr")
BY_IMITATION = ("bc", "gail", "ilpo", "iupe", "ril")
OF_TABLE_1 = ("dqn", "iupe", "ril")
KS = ("1", "1.5", "2", "2.5", "3", "3.5", "4")
NS = ("150", "115", "75", "37")


@cache
def cells(choice: str) -> list[tuple[str, ...]]:
    """The overrides of each cell of `experiment=…` or `ablation=…`."""
    store_schemas()
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        found = compose("config", [choice], return_hydra_config=True).hydra.sweeper.sweeps
    lines = [[[f"{k}={v}" for v in str(vs).split(",")] for k, vs in line.items()] for line in found]
    return [cell for line in lines for cell in product(*line)]


def of(envs: tuple[str, ...], key: str, values: tuple[str, ...]) -> list[tuple[str, ...]]:
    return [(f"env={env}", f"{key}={value}") for env in envs for value in values]


LEVELS = [
    *of(("cartpole",), "ablation.expert_return", ("null", "400", "300", "200", "100")),
    *of(("acrobot",), "ablation.expert_return", ("null", "-100", "-150", "-200", "-250")),
    *of(("mountaincar",), "ablation.expert_return", ("null", "-140", "-150")),
]
EXPERIMENTS = {
    "table1": of(("mountaincar",), "method", OF_TABLE_1),
    "figure2": of(("mountaincar",), "method", OF_TABLE_1),
    "figure3": of(("mountaincar",), "method", OF_TABLE_1),
    "table2": of(ENVS, "method", ("random", "expert", *BY_IMITATION)),
    "table3": of(ENVS, "method", (*BY_REWARDS, "ril")),
    "table4": of(ENVS, "method", ("random", "expert", *BY_REWARDS))
    + [(*cell, "ablation.trajectories=100") for cell in of(ENVS, "method", BY_IMITATION)],
    "table5": of(ENVS, "method", ("ril_sequential", "ril")),
    "table6": of(ENVS, "ablation.trajectories", ("1", "25", "50", "75", "100")),
    "table7": of(ENVS, "ablation.k", KS),
    "table8": of(ENVS, "ablation.n", NS),
    "table9": LEVELS,
    "figure5": of(("mountaincar",), "ablation.k", KS)
    + of(("mountaincar",), "ablation.n", NS)
    + of(("mountaincar",), "method", OF_TABLE_1),
}
EXPERIMENTS["figure4"] = EXPERIMENTS["table4"]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_has_the_papers_cells(name: str) -> None:
    assert sorted(cells(f"experiment={name}")) == sorted(EXPERIMENTS[name])


def test_every_experiment_is_tested() -> None:
    files = {file.stem for file in (config_folder() / "experiment").glob("*.yaml")}
    assert files == {*EXPERIMENTS, "components", "quick"}


@pytest.mark.parametrize("env", ["mountaincar", "cartpole"])
def test_each_component_is_left_out_in_a_run_of_its_own(env: str) -> None:
    found = cells("experiment=components")
    configs = [from_hydra(composed(f"env={env}", "experiment=components", *cell)) for cell in found]
    whole = from_hydra(composed(f"env={env}", "method=ril_consistent"))
    assert sum(config == whole for config in configs) == 1
    assert len({run_id(config, "") for config in configs}) == len(found) == 16


DEFAULT = {"method": "ril", "trajectories": "1", "k": "2", "n": "150", "expert_return": "null"}


@pytest.mark.parametrize("name", TABLES)
def test_an_experiment_covers_its_table(name: str) -> None:
    covered = [
        DEFAULT | dict(each.removeprefix("ablation.").split("=") for each in cell)
        for cell in cells(f"experiment={name}")
    ]
    for cell in table(name).cells():
        setting = cell.setting
        if setting.env == "average" or setting.method == "π*":
            continue
        level = "null" if setting.expert_return is None else f"{setting.expert_return:g}"
        at = {"env": setting.env, "method": setting.method_key, "expert_return": level}
        at |= {"k": f"{setting.k:g}", "n": f"{setting.n:g}"}
        if setting.method_key not in BY_REWARDS:
            at["trajectories"] = str(setting.trajectories)
        assert any(at.items() <= each.items() for each in covered), at


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("k", [(f"ablation.k={k}",) for k in KS]),
        ("n", [(f"ablation.n={n}",) for n in NS]),
        ("trajectories", [(f"ablation.trajectories={t}",) for t in (1, 25, 50, 75, 100)]),
        ("suboptimal_expert", LEVELS),
    ],
)
def test_an_ablation_has_the_papers_values(name: str, found: list[tuple[str, ...]]) -> None:
    assert cells(f"ablation={name}") == found


@pytest.mark.parametrize("choice", ["k", "n", "trajectories", "suboptimal_expert"])
def test_an_ablation_changes_nothing_by_itself(choice: str) -> None:
    assert composed(f"ablation={choice}") == composed()


def first_and_last(choice: str) -> list[tuple[str, ...]]:
    return [cells(choice)[0], cells(choice)[-1]]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_cell_of_an_experiment_is_the_same_run_as_alone(name: str) -> None:
    for cell in first_and_last(f"experiment={name}"):
        inside, alone = (
            run_id(from_hydra(composed(*more, *cell)), "0") for more in ([f"experiment={name}"], [])
        )
        assert inside == alone


def test_tables_share_the_runs_of_their_common_cells() -> None:
    ids = {
        run_id(from_hydra(composed(f"experiment={name}", "env=acrobot", *more)), "0")
        for name, *more in (
            ("table2", "method=ril"),
            ("table3", "method=ril"),
            ("table5", "method=ril"),
            ("table6", "ablation.trajectories=1"),
            ("table7", "ablation.k=2"),
            ("table8", "ablation.n=150"),
            ("table9", "ablation.expert_return=null"),
        )
    }
    assert len(ids) == 1


@pytest.mark.parametrize("cell", LEVELS)
def test_demonstrations_of_every_expert_level_are_shipped(cell: tuple[str, ...]) -> None:
    assert demonstrations_path(from_hydra(composed(*cell))).is_file()


def test_a_single_cell_of_an_experiment_needs_no_m(
    here: Callable[..., Ended], tmp_path: Path
) -> None:
    more = ("ablation.k=3", "method=random", "seeds=1", "evaluation.episodes=2")
    assert here("experiment=table7", *CARTPOLE, *more).status == 0
    assert len(list(tmp_path.rglob("results.csv"))) == 1


def test_docs_name_every_experiment() -> None:
    page = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text(encoding="utf-8")
    named = {
        name
        for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", row)
    }
    assert named >= set(EXPERIMENTS)
