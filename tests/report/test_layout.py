from __future__ import annotations

from helpers.made_rows import evidence

from ril.report.layout import Grid, grid, notes, results


def line_of(given: Grid, method: str, number: int) -> list[str]:
    """One of the four lines of a method's AER in Table 2, without its labels."""
    [start] = [at for at, line in enumerate(given.body) if line[:2] == [method, "AER"]]
    return given.body[start + number][2:]


RIL_ROWS = evidence(
    {"env": "cartpole", "run_id": "b", "aer": 500.0},
    {"seed": 0, "aer": -100.0},
    {"seed": 1, "aer": -104.0},
)


def test_a_row_has_ours_our_interval_the_papers_and_the_verdict() -> None:
    shown = grid(results("table2", RIL_ROWS))
    lines = [line_of(shown, "RIL", number) for number in range(4)]
    assert [line[:4] for line in lines] == [
        ["ours", "500.00 ± 0.00 (1)", "not run", "-102.00 ± 2.00 (2)"],
        ["95 %", "", "", "-104.00 … -100.00"],
        ["paper", "500.00 ± 0.00", "-79.52 ± 4.49", "-100.29 ± 1.59"],
        ["verdict", "matches", "not run", "matches"],
    ]


def test_an_empty_line_is_omitted() -> None:
    names = [line[1] for line in grid(results("table8", evidence({}))).body]
    assert "95 %" not in names


def test_samples_are_whole_numbers() -> None:
    shown = grid(results("table6", evidence({"seed": 0}, {"seed": 1})))
    [line] = [line for line in shown.body if line[:3] == ["MountainCar", "1", "ours"]]
    assert line[3:] == ["106 ± 0 (2)", "-105.00 ± 0.00 (2)"]


def test_a_method_beyond_the_paper_has_its_lines() -> None:
    shown = grid(results("table2", evidence({"method": "ril_consistent"})))
    assert line_of(shown, "ril_consistent", 0)[3] == "-105.00 ± 0.00 (1)"
    assert line_of(shown, "ril_consistent", 1)[0] == "verdict"


def test_cells_not_run_have_one_command_per_method() -> None:
    lines = notes(results("table2", evidence({"env": "nowhere"})))
    everywhere = "cartpole,acrobot,mountaincar,lunarlander"
    assert lines[-1] == "all of these: `ril-run -m experiment=table2`"
    assert lines[-2] == (
        "not run: RIL on CartPole, Acrobot, MountainCar, LunarLander: "
        f"`ril-run -m env={everywhere} method=ril`"
    )
    assert len(lines) == 7 + 1  # methods of the table


def test_a_sweep_runs_only_what_is_missing() -> None:
    lines = notes(results("table7", evidence({"k": 3.0})))
    assert [note.partition("`")[2].rstrip("`") for note in lines if "not run" in note] == [
        "ril-run -m env=cartpole,acrobot,mountaincar,lunarlander method=ril "
        "ablation.k=1,1.5,2,2.5,3.5,4",
        "ril-run -m env=cartpole,acrobot,lunarlander method=ril ablation.k=3",
    ]


def test_an_environment_with_levels_of_its_own_has_a_sweep_of_its_own() -> None:
    lines = notes(results("table9", evidence({})))
    assert (
        "not run: RIL on CartPole: "
        "`ril-run -m env=cartpole method=ril ablation.expert_return=400,300,200,100`"
    ) in lines


def test_cells_with_the_same_reduction_share_a_note() -> None:
    lines = notes(results("table2", RIL_ROWS))
    assert "1 of 10 seeds: RIL on CartPole" in lines
    assert "2 of 10 seeds: RIL on MountainCar" in lines


def test_the_last_policies_table() -> None:
    shown = grid(results("table2", RIL_ROWS, "last"))
    assert line_of(shown, "RIL", 0)[3] == "-110.00 ± 0.00 (2)"
