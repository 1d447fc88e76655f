from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers.made_rows import ALONE, USUAL, cell_of, evidence, found

from ril.io.ended import Ended
from ril.report.findings import find, verdict

ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
RIL = {"method": "RIL", "env": "mountaincar"}  # −100.29 ± 1.59 in Table 2


def test_a_cell_without_rows_is_not_run_and_has_its_command() -> None:
    finding = found("table7", "aer", evidence({}), env="acrobot", k=3)
    assert (finding.verdict, finding.mean, finding.values) == ("not run", None, ())
    assert finding.command == "ril-run env=acrobot method=ril ablation.k=3"


def test_a_cell_with_rows() -> None:
    given = evidence({"seed": 0, "aer": -100.0}, {"seed": 1, "aer": -104.0, "run_id": "b"})
    finding = found("table2", "aer", given, **RIL)
    assert (finding.values, finding.mean, finding.std) == ((-100.0, -104.0), -102.0, 2.0)
    assert finding.reduced == ("2 of 10 seeds",)
    assert finding.run_ids == ("a", "b")


@pytest.mark.parametrize(
    ("env", "method", "mean", "interval", "says"),
    [
        ("mountaincar", "RIL", -100.29, None, "matches"),
        ("mountaincar", "RIL", -101.88, None, "matches"),  # within the paper's ± 1.59
        ("mountaincar", "RIL", -101.89, None, "worse"),
        ("mountaincar", "RIL", -98.0, None, "better"),
        ("mountaincar", "RIL", -110.0, (-120.0, -100.0), "matches"),  # in our interval
        ("mountaincar", "RIL", -110.0, (-120.0, -101.0), "worse"),
        ("cartpole", "RIL", 500.0, (500.0, 500.0), "matches"),
        ("cartpole", "RIL", 499.99, (499.98, 499.99), "worse"),
        ("cartpole", "RIL", 499.998, (499.997, 499.999), "matches"),  # rounds to 500.00
    ],
)
def test_verdicts_of_returns(
    env: str, method: str, mean: float, interval: tuple[float, float] | None, says: str
) -> None:
    assert verdict(cell_of("table2", "aer", method=method, env=env), mean, interval) == says


@pytest.mark.parametrize(("mean", "says"), [(14_800.4, "matches"), (9e3, "better"), (2e4, "worse")])
def test_fewer_samples_are_better(mean: float, says: str) -> None:
    cell = cell_of("table3", "samples_to_best", method="RIL", env="cartpole")
    assert verdict(cell, mean, None) == says


def test_what_the_paper_does_not_report_has_no_verdict() -> None:
    cell = cell_of("table3", "samples_to_solved", method="RIL", env="cartpole")
    assert verdict(cell, 1.0, None) == ""


def test_the_last_policies_can_be_scored() -> None:
    cell = cell_of("table2", "aer", **RIL)
    assert find(cell, evidence({}), "last").mean == -110.0
    assert find(cell, evidence({}), "best").mean == -105.0


def test_performance_is_scaled_by_each_rows_own_measures() -> None:
    given = evidence({"aer": -150.0, "random_return": -200.0, "expert_return_measured": -100.0})
    assert found("table2", "performance", given, **RIL).mean == 0.5


def test_performance_of_the_last_policy() -> None:
    cell = cell_of("table2", "performance", **RIL)
    assert find(cell, evidence({"aer_last": -180.0}), "last").mean == pytest.approx(0.2)


def test_samples_of_the_expert_are_those_of_an_epoch() -> None:
    given = evidence({"expert_samples": 15_900, "epochs": 150})
    assert found("table6", "expert_samples", given, env="mountaincar", trajectories=1).mean == 106


def curve(**more: object) -> pd.DataFrame:
    evaluations = {"run_id": "a", "seed": [0, 0, 1, 1], "epoch": [5, 10] * 2}
    return pd.DataFrame({**evaluations, "samples": [500, 1000, 600, 1200], **more})


def test_samples_come_from_the_curves() -> None:
    given = evidence({"seed": 0}, {"seed": 1}, curves=curve(aer=[-99.0, -99.0, -120.0, -115.0]))
    assert found("table3", "samples_to_best", given, **RIL).values == (500.0, 1200.0)
    assert found("table3", "samples_to_solved", given, **RIL).values == (500.0,)
    assert found("table3", "all_samples_to_solved", given, **RIL).values == (15_500.0,)


def test_a_threshold_that_no_seed_reaches() -> None:
    given = evidence({"seed": 0}, {"seed": 1}, curves=curve(aer=-150.0))
    finding = found("table3", "samples_to_solved", given, **RIL)
    assert (finding.mean, finding.verdict, finding.run_ids) == (None, "", ("a",))


def everywhere(**more: float) -> list[dict[str, object]]:
    """Rows of RIL with a performance by environment."""
    return [
        {"env": env, "run_id": env, "aer": 100 * more[env] - 200, "seed": seed}
        for env in ENVIRONMENTS
        if env in more
        for seed in (0, 1)
    ]


def test_the_average_is_of_the_environments_means() -> None:
    given = evidence(*everywhere(cartpole=1.0, acrobot=1.2, mountaincar=0.9, lunarlander=0.5))
    finding = found("table2", "performance", given, method="RIL", env="average")
    assert finding.mean == pytest.approx(0.9)
    assert finding.std == pytest.approx(np.std([1, 1.2, 0.9, 0.5], ddof=1))
    assert finding.reduced == ("fewer seeds or steps in 4 of 4 environments",)


def test_an_average_waits_for_every_environment() -> None:
    given = evidence(*everywhere(cartpole=1.0, acrobot=1.2, mountaincar=0.9))
    finding = found("table2", "performance", given, method="RIL", env="average")
    assert (finding.mean, finding.verdict) == (None, "not run")
    assert finding.command == "ril-run env=lunarlander method=ril"


@pytest.mark.parametrize(
    ("changes", "says"),
    [({}, ("ended: a loss is NaN",)), ({"k": 3.0}, ()), ({"variant": "method.epochs=2"}, ())],
)
def test_a_run_that_ended_without_rows_is_named_in_its_cell(
    changes: dict[str, object], says: tuple[str, ...]
) -> None:
    about = {name: USUAL[name] for name in ("run_id", "env", "method", "variant", "k", "n")}
    about |= {"trajectories": 1, "expert_return": None, "seeds": [0, 1], **changes}
    ended = Ended(**about, why="ended: a loss is NaN")  # type: ignore[arg-type]
    finding = found("table2", "aer", replace(evidence(), ended=(ended,)), **RIL)
    assert (finding.verdict, finding.excluded) == ("not run", says)


def test_excluded_runs_of_a_cell_are_named() -> None:
    given = evidence(
        *({"seed": seed, "run_id": "many"} for seed in range(2)),
        {"run_id": "few", "epochs": 3},
        {"run_id": "variant", "variant": "method.episodes=2"},
    )
    assert found("table2", "aer", given, **RIL).excluded == (
        "1 of 2 runs used, those of the budget with the most seeds",
        "1 run with overridden keys excluded",
    )


@pytest.mark.parametrize(
    ("name", "quantity", "setting", "counts"),
    [
        ("table2", "aer", RIL, True),
        ("table2", "performance", RIL, False),  # the same number again, scaled
        ("table2", "aer", RIL | {"method": "Expert"}, False),  # nothing is learned
        ("table3", "samples_to_best", RIL, True),
        ("table3", "samples_to_solved", RIL, False),  # not in the paper
    ],
)
def test_what_the_headline_counts(
    name: str, quantity: str, setting: dict[str, str], counts: bool
) -> None:
    assert found(name, quantity, evidence({}), **setting).counts is counts


def test_methods_without_an_expert_count_where_trajectories_vary() -> None:
    given = evidence({"method": "dqn_prioritized", "aer": -120.0, **ALONE})
    assert found("table4", "aer", given, method="DQN₂", env="mountaincar").mean == -120.0
