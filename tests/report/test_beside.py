from __future__ import annotations

import pytest
from helpers.made_rows import rows

from ril.report.beside import paper_cell


def test_a_cell_in_the_paper() -> None:
    whole = rows(*({"seed": seed} for seed in range(10)))
    assert paper_cell(whole) == "-100.29 ± 1.59 (Table 2: One expert trajectory)"


def test_a_cell_of_a_method_without_equation_2() -> None:
    whole = rows(*({"seed": seed, "method": "bc", "k": None, "n": None} for seed in range(10)))
    assert paper_cell(whole) == "-129.92 ± 4.14 (Table 2: One expert trajectory)"


def test_a_cell_of_an_ablation() -> None:
    whole = rows(*({"seed": seed, "k": 3.0} for seed in range(10)))
    assert paper_cell(whole) == "-109.20 (Table 7: RIL by k of equation 2)"


def test_a_reduced_run_says_so() -> None:
    assert paper_cell(rows({"epochs": 20}, {"epochs": 20, "seed": 1})) == (
        "-100.29 ± 1.59 (Table 2: One expert trajectory; "
        "this run has 2 of 10 seeds and 20 of 150 epochs)"
    )


@pytest.mark.parametrize(
    "changes",
    [{"k": 3.3}, {"env": "hill"}, {"expert_return": -141.0}, {"variant": "method.episodes=2"}],
)
def test_a_cell_that_is_not_in_the_paper(changes: dict[str, object]) -> None:
    assert paper_cell(rows(changes)) is None
