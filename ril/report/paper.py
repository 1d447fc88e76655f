"""The paper's own numbers, from `paper.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

ENVIRONMENTS = {
    "cartpole": "CartPole",
    "acrobot": "Acrobot",
    "mountaincar": "MountainCar",
    "lunarlander": "LunarLander",
}


@cache
def paper() -> dict[str, Any]:
    """The whole file, by table."""
    text = (Path(__file__).parent / "paper.yaml").read_text(encoding="utf-8")
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def in_setting(rows: pd.DataFrame, table: str) -> pd.Series[bool]:
    """Which rows were run in a table's setting: the usual expert, the method as it comes."""
    fits = rows["expert_return"].isna() & (rows["variant"] == "")
    for column, value in paper()[table]["setting"].items():
        fits &= rows[column] == value
    return fits


def number(values: list[float]) -> str:
    """One of the paper's numbers: mean, and spread where it gives one."""
    return " ± ".join(f"{value:.2f}" for value in values)


def paper_cell(row: pd.Series[Any]) -> str | None:
    """The paper's number for a row's cell, in words; None if it has none."""
    frame = row.to_frame().T
    for table, content in paper().items():
        for method, by_environment in content["returns"].items():
            known = method.lower() == row["method"] and row["env"] in by_environment
            if known and bool(in_setting(frame, table).iloc[0]):
                budget = (
                    f" after {content['epochs']} epochs"
                    if row["epochs"] < content["epochs"]
                    else ""
                )
                return f"{number(by_environment[row['env']])}{budget} ({content['caption']})"
    return None
