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


#: The paper's names of methods that are not ours in capitals.
_METHODS = {"DQN₁": "dqn", "DQN₂": "dqn_prioritized", "RIL*": "ril_sequential"}
WITHOUT_EXPERT = ("DQN₁", "DQN₂", "PPO", "ACKTR")


def method_named(name: str) -> str:
    """`method=` of a method by the paper's name."""
    return _METHODS.get(name, name.lower())


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
        fits &= rows[column].isna() | (rows[column] == value)  # not every method has eq. 2
    return fits


def number(values: list[float]) -> str:
    """One of the paper's numbers: mean, and spread where it gives one."""
    return " ± ".join(f"{value:.2f}" for value in values)


def shortfall(rows: pd.DataFrame, table: str, method: str) -> list[str]:
    """In what a cell's rows fall short of a table's seeds and the method's budget, in words."""
    reported = paper()[table]
    wanted = {"seeds": reported["seeds"], **reported["budget"].get(method, {})}
    names = dict.fromkeys(("env_samples", "total_timesteps"), "environment steps")
    short = []
    for what, full in wanted.items():
        have = len(rows) if what == "seeds" else int(rows[what].fillna(0).max())
        if have < full:
            short.append(f"{have:,} of {full:,} {names.get(what, what)}")
    return short


def paper_cell(rows: pd.DataFrame) -> str | None:
    """The paper's number for the cell that a run's rows are of, in words; None if it has none."""
    first = rows.iloc[0]
    for table, content in paper().items():
        for method, by_environment in content["returns"].items():
            known = method_named(method) == first["method"] and first["env"] in by_environment
            if known and bool(in_setting(rows, table).iloc[0]):
                short = shortfall(rows, table, method)
                ran = f"; this was {' and '.join(short)}" if short else ""
                return f"{number(by_environment[first['env']])} ({content['caption']}{ran})"
    return None
