from __future__ import annotations

import numpy as np
import pytest
from helpers.made_rows import evidence

from ril.report.figures.variants import changes
from ril.report.formats import as_markdown
from ril.report.statistics import mean_interval
from ril.report.variants import variants, variants_grid

FADE = "method.q_learning.fade=False"


def run(run_id: str, returns: list[float], **more: object) -> list[dict[str, object]]:
    """A row per seed; P is a hundredth of a return, 2 more."""
    return [
        {"run_id": run_id, "seed": seed, "aer": aer, "aer_last": aer - seed} | more
        for seed, aer in enumerate(returns)
    ]


def test_a_variant_is_compared_with_the_default() -> None:
    given = evidence(
        *run("a", [-110.0, -120.0, -130.0]), *run("b", [-105.0, -125.0, -140.0], variant=FADE)
    )
    whole, variant = variants(given, "best")
    assert (whole.method, whole.keys) == ("RIL", "")
    assert (variant.method, variant.keys) == ("RIL", FADE)
    assert whole.returns["mountaincar"].tolist() == [-110, -120, -130]
    assert variant.returns["mountaincar"].tolist() == [-105, -125, -140]
    gains = [0.05, -0.05, -0.10]
    assert variant.gains["mountaincar"] == pytest.approx(gains)
    value, low, high = variant.gain()
    assert value == pytest.approx(np.mean(gains))
    assert (low, high) == pytest.approx(mean_interval(gains))
    assert (whole.gains["mountaincar"] == 0).all()


def test_gains_are_of_common_seeds_and_of_the_requested_policies() -> None:
    given = evidence(*run("a", [-110.0, -120.0]), *run("b", [-110.0, -120.0, -90.0], variant=FADE))
    _, variant = variants(given, "last")
    assert variant.returns["mountaincar"].tolist() == [-110, -121, -92]
    assert variant.gains["mountaincar"].tolist() == [0, 0]


def test_runs_of_another_budget_or_setting_are_no_variants() -> None:
    default = run("a", [-110.0])
    shorter = run("b", [-105.0], variant=FADE, epochs=40)
    other_k = run("c", [-105.0], variant=FADE, k=3.0)
    assert variants(evidence(*default, *shorter, *other_k), "best") == []


def test_without_the_default_there_is_no_comparison() -> None:
    assert variants(evidence(*run("b", [-105.0], variant=FADE)), "best") == []


def test_the_mean_is_over_environments_however_many_seeds_each_has() -> None:
    given = evidence(
        *run("a", [-110.0]),
        *run("b", [-100.0], variant=FADE),
        *run("c", [-110.0, -110.0, -110.0], env="acrobot"),
        *run("d", [-120.0, -130.0, -140.0], env="acrobot", variant=FADE),
    )
    _, variant = variants(given, "best")
    value, *ends = variant.gain()
    assert value == pytest.approx((0.10 - 0.20) / 2)
    assert np.isnan(ends).all()  # MountainCar has one seed
    assert variant.gain("acrobot")[0] == pytest.approx(-0.20)


def test_the_table() -> None:
    given = evidence(
        *run("a", [-110.0, -120.0]),
        *run("b", [-100.0, -110.0], variant=FADE),
        *run("c", [-90.0], env="acrobot"),
    )
    shown = as_markdown(variants_grid(variants(given, "best"), "best"))
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in shown.splitlines()]
    assert ["Method", "Overridden keys", "Acrobot", "MountainCar", "Change in P"] in lines
    assert ["RIL", "default", "-90.00 ± 0.00 (1)", "-115.00 ± 5.00 (2)", ""] in lines
    assert ["", FADE, "", "-105.00 ± 5.00 (2)", "+0.10 [+0.10, +0.10]"] in lines


def test_the_figure_has_a_row_per_variant_and_a_marker_per_environment() -> None:
    given = evidence(
        *run("a", [-110.0, -120.0]),
        *run("b", [-100.0, -115.0], variant=FADE),
        *run("c", [-90.0, -120.0], variant="method.episodes=2"),
    )
    figure = changes([each for each in variants(given, "best") if each.keys])
    [axes] = figure.axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["episodes=2", "q_learning.fade=False"]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in axes.patches]
    gains = [[0.20, 0.0], [0.10, 0.05]]
    assert bars == [pytest.approx(mean_interval(gain)) for gain in gains]
    marks = [line for line in axes.lines if line.get_marker() not in ("None", None, "")]
    assert [(float(m.get_xdata()[0]), float(m.get_ydata()[0])) for m in marks] == [
        (pytest.approx(0.10), 0),
        (pytest.approx(0.075), 1),
    ]


def test_a_panel_is_blank_where_a_variant_was_not_run_and_methods_are_named() -> None:
    given = evidence(
        *run("a", [-110.0, -120.0]),
        *run("b", [-100.0, -115.0], variant=FADE),
        *run("c", [-110.0], method="iupe"),
        *run("d", [-105.0], method="iupe", variant="method.episodes=2"),
        *run("e", [-110.0], method="iupe", env="acrobot"),
        *run("f", [-105.0], method="iupe", env="acrobot", variant="method.episodes=2"),
    )
    figure = changes([each for each in variants(given, "best") if each.keys])
    acrobot, mountaincar = figure.axes
    labels = [label.get_text() for label in acrobot.get_yticklabels()]
    assert labels == ["IUPE: episodes=2", "RIL: q_learning.fade=False"]
    assert (acrobot.get_title("left"), mountaincar.get_title("left")) == ("Acrobot", "MountainCar")
    for axes, rows in ((acrobot, [0]), (mountaincar, [0, 1])):
        marks = [line for line in axes.lines if line.get_marker() not in ("None", None, "")]
        assert [float(mark.get_ydata()[0]) for mark in marks] == rows


def test_a_single_seed_has_no_interval() -> None:
    given = evidence(*run("a", [-110.0]), *run("b", [-100.0], variant=FADE))
    grid = variants_grid(variants(given, "best"), "best")
    assert grid.body[-1][-1] == "+0.10"


def test_without_variants_the_table_says_so() -> None:
    grid = variants_grid(variants(evidence(*run("a", [-110.0])), "best"), "best")
    assert grid.body == []
    assert grid.notes == ["no runs with overridden keys"]
