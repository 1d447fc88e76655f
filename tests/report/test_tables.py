from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd
import pytest

from ril.report.cli import main
from ril.report.paper import number, paper, paper_cell
from ril.report.tables import fullest_cell, results_table
from ril.results import Row, load_results

METHODS = ("Random", "Expert", "BC", "GAIL", "ILPO", "IUPE", "RIL")
HEAD = """\
**One expert trajectory (Table 2)**: average episodic reward (AER) and performance P,
mean ± standard deviation over seeds.

| | | CartPole | Acrobot | MountainCar | LunarLander | Average P |
|---|---|---|---|---|---|---|
"""


def rows(*cells: dict[str, object]) -> pd.DataFrame:
    """Rows of Table 2's setting with some values changed."""
    usual = {
        "run_id": "a",
        "env": "mountaincar",
        "method": "ril",
        "variant": "",
        "seed": 0,
        "k": 2.0,
        "n": 150.0,
        "trajectories": 1,
        "expert_return": None,
        "epochs": 150,
        "env_samples": 2_000_000,
        "aer": -105.0,
        "performance": 1.0,
    }
    return pd.DataFrame([usual | cell for cell in cells]).reindex(columns=list(Row.__annotations__))


def table2(rows: pd.DataFrame) -> str:
    return results_table(rows, "table2")


def line_of(table: str, method: str, number: int) -> str:
    """One of a method's four lines: AER of ours and of the paper, P of ours and of the paper."""
    lines = table.splitlines()
    [first] = [i for i, line in enumerate(lines) if line.startswith(f"| **{method}** ")]
    return lines[first + number]


def our_cells(table: str, method: str = "RIL") -> list[str]:
    return [cell.strip() for cell in line_of(table, method, 0).split("|")[3:-2]]


def notes(table: str) -> list[str]:
    return [line for line in table.splitlines() if line.startswith("- ")]


def test_a_methods_lines() -> None:
    found = table2(
        rows(
            {"env": "cartpole", "run_id": "b", "aer": 500.0, "performance": 1.0},
            {"env": "acrobot", "run_id": "c", "aer": -81.25, "performance": 1.005},
            {"seed": 0, "aer": -100.0, "performance": 1.05},
            {"seed": 1, "aer": -104.0, "performance": 1.01},
            {"env": "lunarlander", "run_id": "d", "seed": 0, "aer": 200.0, "performance": 0.9},
            {"env": "lunarlander", "run_id": "d", "seed": 1, "aer": 260.0, "performance": 1.0},
            {"env": "lunarlander", "run_id": "d", "seed": 2, "aer": 260.0, "performance": 1.1},
        )
    )
    assert found.startswith(HEAD)
    assert [line_of(found, "RIL", number) for number in range(4)] == [
        "| **RIL** | AER, ours | 500.00 ± 0.00 (1 seed) | -81.25 ± 0.00 (1 seed) "
        "| -102.00 ± 2.00 (2 seeds) | 240.00 ± 28.28 (3 seeds) | |",
        "| | AER, paper | 500.00 ± 0.00 | -79.52 ± 4.49 | -100.29 ± 1.59 | 261.73 ± 9.91 | |",
        "| | P, ours | 1.000 ± 0.000 | 1.005 ± 0.000 | 1.030 ± 0.020 | 1.000 ± 0.082 | 1.009 |",
        "| | P, paper |  |  |  |  | 1.04 ± 0.03 |",
    ]
    assert notes(found)[-4:] == [
        "- RIL on CartPole was run with 1 of 10 seeds",
        "- RIL on Acrobot was run with 1 of 10 seeds",
        "- RIL on MountainCar was run with 2 of 10 seeds",
        "- RIL on LunarLander was run with 3 of 10 seeds",
    ]


def test_every_method_of_the_table_has_its_lines() -> None:
    found = table2(rows(*({"method": name.lower(), "run_id": name} for name in METHODS)))
    for name in METHODS:
        assert our_cells(found, name)[2] == "-105.00 ± 0.00 (1 seed)"


def test_table_4_is_of_100_trajectories() -> None:
    hundred = rows({"trajectories": 100, "aer": -99.0, "method": "bc", "k": None, "n": None})
    assert our_cells(results_table(hundred, "table4"), "BC")[2] == "-99.00 ± 0.00 (1 seed)"
    assert our_cells(table2(hundred), "BC")[2] == "not run"


def test_as_many_seeds_and_epochs_as_the_papers_need_no_note() -> None:
    found = table2(rows(*({"seed": seed} for seed in range(10))))
    assert "RIL on MountainCar was" not in found


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"epochs": 20}, "RIL on MountainCar was run with 20 of 150 epochs"),
        (
            {"method": "gail", "env_samples": 204_800},
            "GAIL on MountainCar was run with 204,800 of 2,000,000 environment steps",
        ),
        ({"method": "ilpo", "epochs": 30}, "ILPO on MountainCar was run with 30 of 120 epochs"),
    ],
)
def test_a_smaller_budget_is_noted(changes: dict[str, object], says: str) -> None:
    found = table2(rows(*({"seed": seed} | changes for seed in range(10))))
    assert f"- {says}" in notes(found)


def test_what_is_not_run_names_its_command(tmp_path: Path) -> None:
    found = table2(load_results([tmp_path]))
    assert our_cells(found) == ["not run"] * 4
    everywhere = "cartpole,acrobot,mountaincar,lunarlander"
    assert notes(found) == [
        f"- {name} is not run on CartPole, Acrobot, MountainCar, LunarLander: "
        f"`ril-run -m env={everywhere} method={name.lower()}`"
        for name in METHODS
    ]


def test_what_is_left_of_a_method_names_its_command() -> None:
    environments = ("cartpole", "acrobot", "lunarlander")
    found = rows(*({"env": env, "run_id": env, "trajectories": 100} for env in environments))
    command = "`ril-run env=mountaincar method=ril ablation.trajectories=100`"
    says = f"- RIL is not run on MountainCar: {command}"
    assert says in notes(results_table(found, "table4"))


@pytest.mark.parametrize(
    "changes",
    [
        {"k": 3.0},
        {"n": 75.0},
        {"trajectories": 25},
        {"expert_return": -140.0},
        {"method": "bc"},
        {"variant": "method.episodes=2"},
    ],
)
def test_other_settings_are_left_out(changes: dict[str, object]) -> None:
    assert our_cells(table2(rows(changes))) == ["not run"] * 4


def test_of_several_runs_the_one_with_most_seeds_is_shown_and_named() -> None:
    found = table2(
        rows(
            {"run_id": "few", "aer": -90.0},
            {"run_id": "many", "seed": 0, "epochs": 100},
            {"run_id": "many", "seed": 1, "epochs": 100},
        )
    )
    assert our_cells(found)[2] == "-105.00 ± 0.00 (2 seeds)"
    assert "- RIL on MountainCar: 1 of 2 runs shown, the fullest" in notes(found)


def test_of_runs_with_equally_many_seeds_the_longest_is_the_fullest() -> None:
    found = fullest_cell(rows({"run_id": "long"}, {"run_id": "short", "epochs": 3}))
    assert found["run_id"].tolist() == ["long"]


def test_seeds_of_several_runs_count_together() -> None:
    found = table2(
        rows(
            {"run_id": "a", "seed": 0, "aer": -100.0},
            {"run_id": "a", "seed": 1, "aer": -102.0},
            {"run_id": "b", "seed": 2, "aer": -110.0},
        )
    )
    assert our_cells(found)[2] == "-104.00 ± 4.32 (3 seeds)"
    assert not any("runs shown" in note for note in notes(found))


def test_of_a_seed_in_two_runs_the_newer_row_counts() -> None:
    found = fullest_cell(rows({"run_id": "old", "aer": -99.0}, {"run_id": "new", "aer": -98.0}))
    assert found["aer"].tolist() == [-98.0]


def test_a_seed_that_stopped_early_is_of_its_run() -> None:
    found = fullest_cell(rows({"seed": 0, "epochs": 9}, {"seed": 1, "epochs": 150}))
    assert found["seed"].tolist() == [0, 1]


# Table 2 of the paper: AER of each method, by environment, and its average performance.
TABLE_2 = {
    "Random": ("18.70", "-482.60", "-200.00", "-182.72", "0.00 ± 0.00"),
    "Expert": ("500.00", "-85.00", "-106.00", "235.96", "1.00 ± 0.00"),
    "BC": (
        "490.96 ± 19.65", "-122.75 ± 2.99", "-129.92 ± 4.14", "131.84 ± 53.25", "0.84 ± 0.12",
    ),
    "GAIL": (
        "185.07 ± 168.25", "-279.02 ± 104.91", "-196.00 ± 10.99", "59.03 ± 87.76", "0.36 ± 0.23",
    ),
    "ILPO": (
        "456.87 ± 4.10", "-125.92 ± 19.23", "-200.00 ± 0.00", "-451.81 ± 247.53", "0.29 ± 0.75",
    ),
    "IUPE": (
        "144.64 ± 11.65", "-232.38 ± 50.92", "-198.00 ± 6.00", "-203.05 ± 35.51", "0.19 ± 0.27",
    ),
    "RIL": ("500.00 ± 0.00", "-79.52 ± 4.49", "-100.29 ± 1.59", "261.73 ± 9.91", "1.04 ± 0.03"),
}  # fmt: skip


@pytest.mark.parametrize("method", TABLE_2)
def test_the_papers_numbers_are_its_own(method: str) -> None:
    reported = paper()["table2"]
    names = ("cartpole", "acrobot", "mountaincar", "lunarlander")
    found = [number(reported["returns"][method][env]) for env in names]
    assert (*found, number(reported["average_performance"][method])) == TABLE_2[method]


# Table 4 of the paper: AER of each method, and its average performance.
TABLE_4 = {
    "DQN₁": ("431.87 ± 5.31", "-191.51 ± 64.29", "-145.00 ± 31.18", "-127.64 ± 70.58", "0.53"),
    "DQN₂": ("500.00 ± 0.00", "-87.83 ± 27.96", "-135.28 ± 24.10", "273.07 ± 37.92", "0.92"),
    "PPO": ("500.00 ± 0.00", "-83.43 ± 23.29", "-142.16 ± 21.67", "105.24 ± 51.90", "0.83"),
    "ACKTR": ("487.70 ± 64.76", "-89.36 ± 24.89", "-112.55 ± 21.19", "85.85 ± 64.72", "0.88"),
    "BC": ("500.00 ± 0.00", "-82.92 ± 2.63", "-99.69 ± 0.69", "214.93 ± 5.56", "1.01"),
    "GAIL": ("500.00 ± 0.00", "-83.12 ± 20.95", "-186.74 ± 0.65", "83.56 ± 65.26", "0.70"),
    "ILPO": ("500.00 ± 0.00", "-83.84 ± 2.50", "-177.56 ± 27.77", "-421.62 ± 180.41", "0.42"),
    "IUPE": ("500.00 ± 0.00", "-78.10 ± 10.56", "-130.70 ± 15.23", "-211.20 ± 40.77", "0.67"),
    "RIL": ("500.00 ± 0.00", "-75.72 ± 4.49", "-100.37 ± 2.50", "266.55 ± 19.34", "1.04"),
}


@pytest.mark.parametrize("method", TABLE_4)
def test_the_papers_numbers_of_100_trajectories_are_its_own(method: str) -> None:
    reported = paper()["table4"]
    names = ("cartpole", "acrobot", "mountaincar", "lunarlander")
    found = [number(reported["returns"][method][env]) for env in names]
    assert (*found, number(reported["average_performance"][method])) == TABLE_4[method]


# Table 5 of the paper: AER of RIL's halves in sequence, and its average performance.
def test_the_papers_numbers_of_the_halves_in_sequence_are_its_own() -> None:
    names = ("cartpole", "acrobot", "mountaincar", "lunarlander")
    found = [number(paper()["table5"]["returns"]["RIL*"][env]) for env in names]
    assert found == ["382.95 ± 208.29", "-493.63 ± 44.61", "-200.00 ± 0.00", "-114.09 ± 56.84"]
    assert paper()["table5"]["average_performance"] == {"RIL*": [0.22]}


def test_methods_without_an_expert_count_in_table_4() -> None:
    alone = {"method": "dqn_prioritized", "k": None, "n": None, "trajectories": None}
    alone["total_timesteps"] = 2_000_000
    found = results_table(rows(alone | {"aer": -120.0}), "table4")
    assert our_cells(found, "DQN₂")[2] == "-120.00 ± 0.00 (1 seed)"
    assert "- DQN₂ on MountainCar was run with 1 of 10 seeds" in notes(found)


def test_methods_without_an_expert_are_not_told_to_take_trajectories(tmp_path: Path) -> None:
    found = notes(results_table(load_results([tmp_path]), "table4"))
    commands = [note.partition("`")[2].rstrip("`").split(" ", 3)[3] for note in found]
    assert commands[:5] == [
        "method=dqn",
        "method=dqn_prioritized",
        "method=ppo",
        "method=acktr",
        "method=bc ablation.trajectories=100",
    ]


def test_runs_of_another_budget_do_not_count_together() -> None:
    usual = {"method": "dqn", "epochs": 1000, "k": None, "n": None, "trajectories": None}
    long, short = ({"run_id": name, "total_timesteps": int(name)} for name in ("9000", "300"))
    cells = [usual | long, usual | short | {"seed": 1}, usual | short | {"seed": 2}]
    assert fullest_cell(rows(*cells))["run_id"].tolist() == ["300", "300"]


def test_runs_of_another_first_half_do_not_count_together() -> None:
    usual = {"method": "ril_sequential", "total_timesteps": 2_000_000}
    cells = [
        usual | {"run_id": "whole", "epochs": 1100},
        usual | {"run_id": "short", "epochs": 1005},
    ]
    assert fullest_cell(rows(*cells))["run_id"].tolist() == ["whole"]


def test_a_cell_in_the_paper() -> None:
    whole = rows(*({"seed": seed} for seed in range(10)))
    assert paper_cell(whole) == "-100.29 ± 1.59 (One expert trajectory (Table 2))"


def test_a_cell_of_a_method_without_equation_2() -> None:
    whole = rows(*({"seed": seed, "method": "bc", "k": None, "n": None} for seed in range(10)))
    assert paper_cell(whole) == "-129.92 ± 4.14 (One expert trajectory (Table 2))"


def test_a_smaller_cell_than_the_papers_says_so() -> None:
    assert paper_cell(rows({"epochs": 20}, {"epochs": 20, "seed": 1})) == (
        "-100.29 ± 1.59 (One expert trajectory (Table 2); "
        "this was 2 of 10 seeds and 20 of 150 epochs)"
    )


@pytest.mark.parametrize(
    "changes",
    [{"k": 3.0}, {"env": "hill"}, {"expert_return": -140.0}, {"variant": "method.episodes=2"}],
)
def test_a_cell_that_is_not_in_the_paper(changes: dict[str, object]) -> None:
    assert paper_cell(rows(changes)) is None


def report(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["ril-report", *arguments])
    main()


def test_the_command_shows_the_rows_of_its_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, env in (("one", "mountaincar"), ("two", "acrobot")):
        (tmp_path / folder).mkdir()
        rows({"env": env, "run_id": env}).to_csv(tmp_path / folder / "results.csv", index=False)
    report(monkeypatch, "table2", "--outputs", str(tmp_path / "one"), str(tmp_path / "two"))
    ran = "-105.00 ± 0.00 (1 seed)"
    assert our_cells(capsys.readouterr().out) == ["not run", ran, ran, "not run"]


def test_the_command_names_a_folder_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit, match=rf"ril-report: --outputs {tmp_path}/none: no such folder"):
        report(monkeypatch, "table2", "--outputs", str(tmp_path / "none"))


def test_the_command_needs_no_runs_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    report(monkeypatch, "table2")
    assert len(notes(capsys.readouterr().out)) == len(METHODS)


def test_a_table_that_is_not_there_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match=r"^ril-report: argument table: invalid choice[^\n]*$"):
        report(monkeypatch, "table10")
    assert capsys.readouterr().err == ""


def test_rows_of_tuning_seeds_are_not_reported() -> None:
    assert our_cells(table2(rows({"seed": 100})))[2] == "not run"


def test_runs_that_set_keys_of_their_own_are_counted() -> None:
    found = table2(rows({"variant": "method.episodes=2"}))
    assert "- RIL on MountainCar: 1 run with keys set apart left out" in notes(found)
