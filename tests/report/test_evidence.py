from __future__ import annotations

import shlex
from dataclasses import replace

import hydra
import pandas as pd
import pytest
from helpers.made_rows import ALONE, cell_of, evidence, rows, setting

from ril.cli.configuration import store_schemas
from ril.io.paths import config_folder
from ril.report.evidence import Evidence, command, largest_group, reductions
from ril.report.paper.tables import ENVIRONMENTS, TABLES, Setting, table

REWARDS_ALONE = cell_of("table4", "aer", method="DQN₂", env="mountaincar").setting


@pytest.mark.parametrize(
    "changes",
    [
        {"k": 3.0},
        {"n": 75.0},
        {"trajectories": 25},
        {"expert_return": -140.0},
        {"method": "bc"},
        {"env": "acrobot"},
        {"variant": "method.episodes=2"},
    ],
)
def test_rows_of_another_setting_do_not_match(changes: dict[str, object]) -> None:
    assert evidence(changes).matching(setting()).empty


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, setting()),
        ({"k": 3.0}, setting(k=3)),
        ({"expert_return": -140.0}, setting(expert_return=-140)),
        ({"method": "bc", "k": None, "n": None}, setting("BC")),
        ({"method": "dqn_prioritized", **ALONE}, REWARDS_ALONE),
        ({"method": "ril_consistent"}, setting("ril_consistent")),
    ],
)
def test_rows_of_a_setting_match(changes: dict[str, object], wanted: Setting) -> None:
    assert len(evidence(changes).matching(wanted)) == 1


def test_runs_with_overridden_keys_are_returned_on_request() -> None:
    given = evidence({}, {"variant": "method.episodes=2", "run_id": "variant"})
    assert given.matching(setting(), variants=True)["run_id"].tolist() == ["variant"]


def test_rows_of_tuning_seeds_are_not_reported(tmp_path: object) -> None:
    folder = tmp_path / "run"  # type: ignore[operator]
    folder.mkdir()
    made = rows({"seed": 99}, {"seed": 100}).drop(columns="folder")
    filled = made.astype(object).where(made.notna(), 0).assign(commit="c", expert_return=None)
    filled.to_csv(folder / "results.csv", index=False)
    assert Evidence.of([folder]).rows["seed"].tolist() == [99]


def test_curves_are_those_of_the_reported_rows() -> None:
    curves = pd.DataFrame(
        {"run_id": ["a", "a", "b"], "seed": [0, 1, 0], "epoch": 5, "samples": 9, "aer": -1.0}
    )
    given = evidence({"run_id": "a"}, {"run_id": "b", "k": 3.0}, curves=curves)
    found = given.curves_of(setting())
    assert found[["run_id", "seed"]].to_numpy().tolist() == [["a", 0]]


def test_the_budget_with_the_most_seeds_is_reported() -> None:
    found = largest_group(
        rows({"run_id": "long"}, *({"seed": s, "epochs": 9, "run_id": "many"} for s in (0, 1)))
    )
    assert found["run_id"].tolist() == ["many", "many"]


def test_of_budgets_with_equally_many_seeds_the_longest_is_reported() -> None:
    found = largest_group(rows({"run_id": "long"}, {"run_id": "reduced", "epochs": 3}))
    assert found["run_id"].tolist() == ["long"]


def test_seeds_of_several_runs_with_one_budget_count_together() -> None:
    found = largest_group(rows({"run_id": "b", "seed": 2}, {"run_id": "a", "seed": 0}))
    assert found["seed"].tolist() == [0, 2]


def test_of_a_seed_in_two_runs_the_newer_row_counts() -> None:
    found = largest_group(rows({"run_id": "old", "aer": -99.0}, {"run_id": "new", "aer": -98.0}))
    assert found["aer"].tolist() == [-98.0]


def test_a_seed_that_stopped_early_keeps_the_budget_of_its_run() -> None:
    found = largest_group(rows({"seed": 0, "epochs": 9}, {"seed": 1, "epochs": 150}))
    assert found["seed"].tolist() == [0, 1]


def test_runs_of_another_budget_do_not_count_together() -> None:
    usual = {"method": "dqn", "epochs": 1000, **ALONE}
    long, short = ({"run_id": name, "total_timesteps": int(name)} for name in ("9000", "300"))
    found = largest_group(
        rows(usual | long, usual | short | {"seed": 1}, usual | short | {"seed": 2})
    )
    assert found["run_id"].tolist() == ["300", "300"]


@pytest.mark.parametrize(
    ("changes", "name", "method", "says"),
    [
        ({"epochs": 20}, "table2", "RIL", "20 of 150 epochs"),
        ({"env_samples": 204_800}, "table2", "GAIL", "204,800 of 2,000,000 environment steps"),
        ({"epochs": 30}, "table2", "ILPO", "30 of 120 epochs"),
        ({"total_timesteps": 300}, "table4", "DQN₂", "300 of 2,000,000 environment steps"),
    ],
)
def test_a_smaller_budget_is_named(
    changes: dict[str, object], name: str, method: str, says: str
) -> None:
    ten = rows(*({"seed": seed} | changes for seed in range(10)))
    assert reductions(ten, table(name), method) == (says,)


def test_fewer_seeds_are_named() -> None:
    assert reductions(rows({}, {"seed": 1}), table("table2"), "RIL") == ("2 of 10 seeds",)


def test_the_papers_seeds_and_epochs_are_no_reduction() -> None:
    assert reductions(rows(*({"seed": s} for s in range(10))), table("table2"), "RIL") == ()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ([setting()], "ril-run env=mountaincar method=ril"),
        ([REWARDS_ALONE], "ril-run env=mountaincar method=dqn_prioritized"),
        (
            [setting("BC", trajectories=100)],
            "ril-run env=mountaincar method=bc ablation.trajectories=100",
        ),
        ([setting(k=1.5)], "ril-run env=mountaincar method=ril ablation.k=1.5"),
        (
            [setting(expert_return=-140)],
            "ril-run env=mountaincar method=ril ablation.expert_return=-140",
        ),
        (
            [setting(), setting(env="acrobot")],
            "ril-run -m env=mountaincar,acrobot method=ril",
        ),
        ([setting(k=2), setting(k=3)], "ril-run -m env=mountaincar method=ril ablation.k=2,3"),
        (
            [setting(), setting(expert_return=-140)],
            "ril-run -m env=mountaincar method=ril ablation.expert_return=null,-140",
        ),
    ],
)
def test_the_command_of_settings(settings: list[Setting], says: str) -> None:
    assert command(settings) == says


def test_the_command_of_each_kind_of_cell_composes_its_setting() -> None:
    """One environment per method and ablation; sub-optimal experts differ by environment."""
    store_schemas()
    cells = [cell for name in TABLES for cell in table(name).cells()]
    settings = {
        replace(s, env=""): s for s in (cell.setting for cell in cells) if s.env in ENVIRONMENTS
    }
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        for wanted in settings.values():
            if wanted.method == "π*":
                continue
            composed = hydra.compose("config", shlex.split(command([wanted]))[1:])
            assert composed.method.name == wanted.method_key
            assert composed.env.name == wanted.env
            assert composed.ablation.trajectories == (wanted.trajectories or 1)
            assert composed.ablation.k == wanted.k
            assert composed.ablation.n == wanted.n
            assert composed.ablation.expert_return == wanted.expert_return
