from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ril.report
from ril.report.paper.audit import Contradiction, audit, contradictions_grid
from ril.report.paper.printed import Printed, agree, propagate, rounded

PAPER = (Path(ril.report.__file__).parent / "paper" / "tables.yaml").read_text(encoding="utf-8")
IUPE_P = "IUPE: {cartpole: [0.26, 0.02], acrobot: [0.55, 0.16]"


@cache
def own() -> list[Contradiction]:
    """The paper's own contradictions."""
    return audit()


def changed(*changes: tuple[str, str]) -> list[Contradiction]:
    """The contradictions of a paper with other numbers."""
    text = PAPER
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    return audit(text)


def named(contradictions: list[Contradiction]) -> set[str]:
    return {f"{each.where}: {each.says}" for each in contradictions}


def newly(*changes: tuple[str, str]) -> set[str]:
    """What is a contradiction only in a paper with other numbers."""
    return named(changed(*changes)) - named(own())


def no_longer(*changes: tuple[str, str]) -> set[str]:
    """What is a contradiction no more in a paper with other numbers."""
    return named(own()) - named(changed(*changes))


def test_the_papers_contradictions() -> None:
    assert [each.where for each in own()] == [
        "Table 2, GAIL on CartPole, ± of P",
        "Table 2, ILPO on Acrobot, ± of P",
        "Table 2, IUPE on Acrobot",
        "Table 2, IUPE on Acrobot, ± of P",
        "Table 2, average P of GAIL",
        "Table 2, average P of IUPE",
        "Table 2, average P of IUPE, ±",
        "Table 4, average P of DQN₁",
        "Table 4, average P of DQN₂",
        "Table 5, RIL on Acrobot",
        "Table 5, RIL on LunarLander",
        "Table 7, RIL on LunarLander",
        "Table 8, RIL on LunarLander",
        "Table 2, Expert on Acrobot",
        "Table 2, Expert on MountainCar",
        "§5.1",
        *["§5.2.1"] * 3,
        *["§5.2.2"] * 4,
        "Table 3",
        *["§5.3"] * 4,
        *["§6.3"] * 2,
        *["§6.4.2"] * 2,
        *["§7"] * 2,
    ]


def test_both_numbers_of_a_contradiction_are_given() -> None:
    [found] = [each for each in own() if each.where == "Table 2, IUPE on Acrobot"]
    assert (found.says, found.against) == ("P = 0.55", "P = 0.629")


def test_a_number_that_is_printed_for_another_setting_is_traced() -> None:
    [found] = [each for each in own() if each.where == "Table 7, RIL on LunarLander"]
    assert (found.says, found.against) == ("AER 266.55", "AER 261.73 in Table 2")
    assert found.why.endswith("Table 4 has this number for 100")


def test_every_contradiction_is_complete() -> None:
    assert all((each.says and each.against and each.why) for each in own())


def test_a_performance_that_follows_from_its_return_is_none() -> None:
    right = "IUPE: {cartpole: [0.26, 0.02], acrobot: [0.63, 0.13]"
    assert {"Table 2, IUPE on Acrobot: P = 0.55", "Table 2, IUPE on Acrobot, ± of P: ± 0.16"} <= (
        no_longer((IUPE_P, right))
    )


@pytest.mark.parametrize(("p", "is_one"), [("0.98", False), ("0.97", True), ("1.0", False)])
def test_rounding_of_a_performance_is_allowed_for(p: str, is_one: bool) -> None:
    new = newly(("BC: {cartpole: [0.98, 0.04]", f"BC: {{cartpole: [{p}, 0.04]"))
    assert (f"Table 2, BC on CartPole: P = {p}" in new) is is_one


def test_rounding_of_a_return_is_allowed_for() -> None:
    coarse = ("acrobot: [-232.38, 50.92]", "acrobot: [-3E+2, 50.92]")
    assert "Table 2, IUPE on Acrobot: P = 0.55" in no_longer(coarse)


def test_a_wrong_std_of_a_performance_is_found() -> None:
    new = newly(("acrobot: [0.51, 0.26]", "acrobot: [0.51, 0.28]"))
    assert new == {"Table 2, GAIL on Acrobot, ± of P: ± 0.28"}


def test_a_wrong_average_is_found() -> None:
    assert newly(("BC: [1.01]", "BC: [1.03]")) >= {"Table 4, average P of BC: 1.03"}


def test_an_average_that_follows_from_the_returns_is_none() -> None:
    right = no_longer(("DQN₁: [0.53], DQN₂: [0.92]", "DQN₁: [0.58], DQN₂: [0.94]"))
    assert {f"Table 4, average P of {m}" for m in ("DQN₁: 0.53", "DQN₂: 0.92")} <= right


def test_an_averages_std_is_the_sample_standard_deviation() -> None:
    old, population = "average: [0.29, 0.75]", "average: [0.29, 0.65]"
    assert newly((old, population)) == {"Table 2, average P of ILPO, ±: ± 0.65"}


def test_a_setting_with_two_numbers_is_found() -> None:
    new = newly(("mountaincar: {150: [-100.29]", "mountaincar: {150: [-100.39]"))
    assert "Table 8, RIL on MountainCar: AER -100.39" in new


def test_the_usual_expert_is_that_of_the_other_tables() -> None:
    assert "Table 9, RIL on Acrobot: AER -79.62" in newly(("{-85: [-79.52]", "{-85: [-79.62]"))


def test_an_expert_as_good_as_its_trajectories_is_none() -> None:
    gone = no_longer(("100: [10046]", "100: [10600]"))
    assert gone == {"Table 2, Expert on MountainCar: AER -106"}


@pytest.mark.parametrize(
    ("change", "statement"),
    [
        (("average: {DQN₁: [0.53]", "average: {DQN₁: [0.93]"), "the average P of the RL methods"),
        (("ACKTR: [507500]", "ACKTR: [507501]"), "ACKTR needs 477,755 timesteps more than RIL"),
        (("BC: [214.93, 5.56]", "BC: [214.93, 9.56]"), "BC's average ± is 2.22"),
        (("DQN₁: [-191.51", "DQN₁: [-80.51"), "DQN₁ is lower than every other RL method"),
        (("3.5: [-83.69]", "3.5: [-80.69]"), "on Acrobot RIL degrades as k increases"),
        (("1.5: [145.36]", "1.5: [125.36]"), "on LunarLander RIL deteriorates as k deviates"),
        (("300: [500.00]", "300: [490.00]"), "on CartPole RIL has 500 with any expert"),
    ],
)
def test_a_confirmed_claim_is_none_until_the_tables_refute_it(
    change: tuple[str, str], statement: str
) -> None:
    assert not [name for name in named(own()) if statement in name]
    assert [name for name in newly(change) if statement in name]


@pytest.mark.parametrize(
    ("change", "statement"),
    [
        (("PPO: [680000]", "PPO: [29000]"), "on MountainCar PPO needs fewer timesteps"),
        (("50: [-101.90]", "50: [-101.89]"), "on MountainCar all are within the ± of Table 2"),
        (("DQN₁: [-127.64", "DQN₁: [127.64"), "on LunarLander the RL methods' results"),
        (("-250: [-82.72]", "-250: [-90.43]"), "RIL decreases only 10.91 points"),
    ],
)
def test_a_claim_is_none_once_the_tables_confirm_it(
    change: tuple[str, str], statement: str
) -> None:
    assert [name for name in no_longer(change) if statement in name]


def test_the_texts_values_of_n_are_those_of_the_table() -> None:
    assert "§6.4.2: n = 112 is one of four values" in named(own()) - named(
        audit(PAPER.replace("115: [", "112: ["))
    )


def test_a_printed_number_stands_for_all_that_is_rounded_to_it() -> None:
    assert rounded("-198.00") == (-198.0, -198.005, -197.995)
    assert rounded("5e5") == (500_000.0, 450_000.0, 550_000.0)


def test_a_range_holds_what_any_number_in_it_gives() -> None:
    ranges = [rounded(text) for text in ("-232.38", "-482.6", "-85")]
    _, low, high = propagate(lambda a, r, e: (a - r) / (e - r), ranges)
    random = np.random.default_rng(0)
    a, r, e = (random.uniform(low, high, 1000) for _, low, high in ranges)
    inside = (a - r) / (e - r)
    assert low <= inside.min() <= inside.max() <= high
    assert high - low < 1.5 * np.ptp(inside)


@pytest.mark.parametrize(
    ("one", "other", "agrees"),
    [
        ("0.5", "0.55", True),
        ("0.50", "0.52", False),
        ("0.5", "0.56", False),
        ("500", "500.00", True),
    ],
)
def test_numbers_agree_if_rounding_can_explain_them(one: str, other: str, agrees: bool) -> None:
    assert agree(rounded(one), rounded(other)) is agrees


def test_numbers_are_kept_as_they_are_printed() -> None:
    found = Printed().cells()
    [cell] = found.query("table == 'table2' and method == 'IUPE' and env == 'mountaincar'").index
    assert found.loc[cell, ["mean", "std"]].tolist() == ["-198.00", "6.00"]


def test_the_grid_has_a_line_for_each() -> None:
    one = Contradiction("here", "1", "2", "because")
    assert contradictions_grid([one, one]).body == [["here", "1", "2", "because"]] * 2
