"""The paper's tables, read from `tables.yaml`: every number with its setting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from ril.io.paths import config_folder

ENVIRONMENTS = {
    "cartpole": "CartPole",
    "acrobot": "Acrobot",
    "mountaincar": "MountainCar",
    "lunarlander": "LunarLander",
}
#: The names of the measured quantities in the tables.
QUANTITIES = {
    "aer": "AER",
    "performance": "P",
    "samples_to_best": "to the highest return",
    "samples_to_solved": "to solved",
    "all_samples_to_solved": "to solved, with random steps",
    "expert_samples": "expert samples",
    "reward": "return",
    "divergence": "KL divergence",
    "greedy_divergence": "KL divergence of greedy actions",
    "agreement": "agreement along trajectories",
    "agreement_of_cells": "agreement in 20 × 20 states",
}


@dataclass(frozen=True)
class Setting:
    """The setting of a number; None where a field does not apply or the paper does not give it.

    Attributes:
        method: the paper's name, "DQN₁"; ril's name for a method beyond the paper.
        env: the value of `env=`; "average" for the mean over the four.
        trajectories: expert trajectories trained on.
        k: slope in equation 2.
        n: epochs in equation 2.
        expert_return: return of a sub-optimal expert; None for the usual expert.
    """

    method: str
    env: str
    trajectories: int | None = None
    k: float | None = None
    n: float | None = None
    expert_return: float | None = None

    @property
    def method_key(self) -> str:
        """The method's name in the rows, the value of `method=`."""
        name: str = _content()["methods"].get(self.method, self.method)
        return name


def main_setting(method: str, env: str) -> Setting:
    """Return a method's setting in the main experiments: one trajectory, k = 2, n = 150 (§5.2)."""
    return Setting(method, env, trajectories=1, k=2, n=150)


@dataclass(frozen=True)
class Cell:
    """One number of one table.

    Attributes:
        table: "table1" to "table9".
        quantity: a key of `QUANTITIES`.
        setting: the setting of the number.
        mean: the paper's number; None where it reports none.
        std: the paper's ±; None where it gives none.
    """

    table: str
    quantity: str
    setting: Setting
    mean: float | None
    std: float | None


@dataclass(frozen=True)
class Table:
    """A table as printed: labels, and a cell or nothing for each row and column.

    Attributes:
        name: "table1" to "table9".
        number: 1 to 9.
        title: the title in a few words.
        section: the section of the paper.
        head: heads of the one or two columns that label the rows.
        columns: heads of the columns of numbers.
        rows: labels of each row, and its cells.
        seeds: number of runs that each number averages.
        budget: training budget by the paper's name of a method and by column of `results.csv`.
    """

    name: str
    number: int
    title: str
    section: str
    head: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[tuple[str, ...], tuple[Cell | None, ...]], ...]
    seeds: int
    budget: dict[str, dict[str, int]]

    def cells(self) -> Iterator[Cell]:
        """Iterate over all cells, row by row."""
        return (cell for _, cells in self.rows for cell in cells if cell is not None)


@cache
def _content() -> dict[str, dict[str, Any]]:
    text = (Path(__file__).parent / "tables.yaml").read_text(encoding="utf-8")
    content: dict[str, dict[str, Any]] = yaml.safe_load(text)
    return content


#: Names of the paper's tables.
TABLES = tuple(f"table{number}" for number in range(1, 10))


@cache
def solved_return(env: str) -> float:
    """Return the mean return from which an environment counts as solved (§4.1)."""
    text = (config_folder() / "env" / f"{env}.yaml").read_text(encoding="utf-8")
    return float(yaml.safe_load(text)["solved_return"])


@cache
def known_methods() -> frozenset[str]:
    """Return the names of the paper's methods in the rows."""
    return frozenset(_content()["methods"].values())


@cache
def table(name: str, beyond: tuple[str, ...] = ()) -> Table:
    """Return one table of the paper.

    Args:
        name: "table1" to "table9".
        beyond: methods that are not in the paper, added next to RIL where methods are compared.
    """
    content = _content()[name]
    across = content["columns"]
    down: list[str] = content["rows"]
    placed = {
        (tuple(at[axis] for axis in down), at[across]): _cell(name, content, at, numbers)
        for at, numbers in _numbers(content, beyond)
    }
    rows = list(dict.fromkeys(row for row, _ in placed))
    firsts = list(dict.fromkeys(row[0] for row in rows))
    rows.sort(key=lambda row: firsts.index(row[0]))  # rows with the same first label adjoin
    columns = list(dict.fromkeys(column for _, column in placed))
    return Table(
        name=name,
        number=int(name.removeprefix("table")),
        title=content["title"],
        section=content["section"],
        head=tuple(_HEADS[axis] for axis in down),
        columns=tuple(_label(across, column) for column in columns),
        rows=tuple(
            (
                tuple(_label(axis, key) for axis, key in zip(down, row, strict=True)),
                tuple(placed.get((row, column)) for column in columns),
            )
            for row in rows
        ),
        seeds=content["seeds"],
        budget=content["budget"],
    )


_HEADS = {
    "method": "Method",
    "env": "Environment",
    "quantity": "",
    "trajectories": "Trajectories",
    "expert_return": "Expert return",
}


def _numbers(
    content: dict[str, Any], beyond: tuple[str, ...]
) -> Iterator[tuple[dict[str, Any], list[float]]]:
    """Yield each number's keys by axis, and its mean and ±; nothing for quantities of our own."""

    def below(node: Any, axes: list[str]) -> Iterator[tuple[dict[str, Any], list[float]]]:
        if not axes:
            yield {}, node
            return
        for key, child in node.items():
            for at, numbers in below(child, axes[1:]):
                yield {axes[0]: key, **at}, numbers

    for quantity, node in content["values"].items():
        for at, numbers in below(node, content["axes"]):
            yield {"quantity": quantity, **at}, numbers
            more = [{"quantity": ours, **at} for ours in content.get("ours", [])]
            if at.get("method") == "RIL":
                for place in [{"quantity": quantity, **at}, *more]:
                    more += [{**place, "method": method} for method in beyond]
            for place in more:
                yield place, []


def _cell(name: str, content: dict[str, Any], at: dict[str, Any], numbers: list[float]) -> Cell:
    setting = content["setting"] | {axis: key for axis, key in at.items() if axis != "quantity"}
    if setting["method"] in content.get("rewards_alone", []):
        setting["trajectories"] = None
    if setting.get("expert_return") == _usual_expert(setting["env"]):
        setting["expert_return"] = None
    mean, std = (*numbers, None, None)[:2]
    return Cell(name, at["quantity"], Setting(**setting), mean, std)


def _usual_expert(env: str) -> float | None:
    """Return the expert's return in the main experiments, as printed in Table 9."""
    by_return = _content()["table9"]["values"]["aer"].get(env)
    return next(iter(by_return)) if by_return else None


def _label(axis: str, key: Any) -> str:
    if axis == "env":
        return "Average P" if key == "average" else ENVIRONMENTS[key]
    if axis == "quantity":
        return QUANTITIES[key]
    if axis in ("k", "n"):
        return f"{axis} = {key:g}"
    return str(key)
