from __future__ import annotations

import pytest

from ril.methods.registry import names
from ril.report.paper.tables import TABLES, known_methods, solved_return, table

#: How many numbers each table prints, counted by hand.
PRINTED = dict(zip(TABLES, (10, 63, 20, 45, 10, 40, 28, 16, 13), strict=True))


@pytest.mark.parametrize("name", TABLES)
def test_every_printed_number_is_there(name: str) -> None:
    assert sum(cell.mean is not None for cell in table(name).cells()) == PRINTED[name]


def printed(name: str, *labels: str) -> list[str]:
    """Numbers of one row, as mean or mean±spread."""
    [cells] = [cells for row, cells in table(name).rows if row == labels]
    return [
        "" if cell is None else f"{cell.mean:g}" + ("" if cell.std is None else f"±{cell.std:g}")
        for cell in cells
    ]


@pytest.mark.parametrize(
    ("name", "labels", "numbers"),
    [
        ("table1", ["KL divergence"], "|2.0869|4.9863|9.6476"),
        ("table2", ["IUPE", "AER"], "144.64±11.65|-232.38±50.92|-198±6|-203.05±35.51|"),
        ("table2", ["IUPE", "P"], "0.26±0.02|0.55±0.16|0.02±0.06|-0.05±0.08|0.19±0.27"),
        ("table3", ["LunarLander", "to the highest return"], "357000|239000|154000|646000|281204"),
        ("table4", ["Average P"], "0.53|0.92|0.83|0.88|1.01|0.7|0.42|0.67|1.04"),
        ("table5", ["Acrobot"], "-493.63±44.61|-75.72±4.49"),
        ("table6", ["LunarLander", "75"], "32311|264.2"),
        ("table7", ["LunarLander"], "132|145.36|266.55|247.5|209.4|174.6|171"),
        ("table8", ["MountainCar"], "-100.29|-100.5|-106.7|-112.1"),
        ("table9", ["Acrobot", "-250"], "-82.72"),
    ],
)
def test_a_row_as_printed(name: str, labels: list[str], numbers: str) -> None:
    assert printed(name, *labels) == numbers.split("|")


def test_a_table_has_the_papers_columns() -> None:
    assert table("table7").columns == tuple(f"k = {k}" for k in (1, 1.5, 2, 2.5, 3, 3.5, 4))
    assert table("table8").columns == ("n = 150", "n = 115", "n = 75", "n = 37")


def test_all_quantities_of_a_method_stand_together() -> None:
    labels = [row for row, _ in table("table2").rows]
    assert labels[:4] == [("Random", "AER"), ("Random", "P"), ("Expert", "AER"), ("Expert", "P")]


def test_the_first_expert_of_table_9_is_the_usual_one() -> None:
    levels = [cell.setting.expert_return for cell in table("table9").cells()]
    assert levels == [None, 400, 300, 200, 100, None, -100, -150, -200, -250, None, -140, -150]


def test_a_method_beyond_the_paper_stands_beside_ril() -> None:
    [cells] = [cells for row, cells in table("table2", ("better",)).rows if row == ("better", "P")]
    assert [cell and (cell.mean, cell.setting.method) for cell in cells] == [(None, "better")] * 5


def test_a_method_beyond_the_paper_is_in_no_ablation() -> None:
    assert table("table7", ("better",)) == table("table7")


def test_every_method_but_those_beyond_the_paper_is_in_some_table() -> None:
    assert known_methods() - {"π*"} == set(names()) - {"ril_consistent"}


@pytest.mark.parametrize(
    ("env", "solved"),
    [("cartpole", 195.0), ("acrobot", -100.0), ("mountaincar", -110.0), ("lunarlander", 200.0)],
)
def test_thresholds_are_those_of_the_environments(env: str, solved: float) -> None:
    assert solved_return(env) == solved
