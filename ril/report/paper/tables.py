"""The paper's own tables from `paper.yaml`: every number, and the setting that it is of."""

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
#: `method=` by the paper's names, where these are not ours in capitals.
_METHODS = {"DQN₁": "dqn", "DQN₂": "dqn_prioritized", "RIL*": "ril_sequential"}
#: What is measured, in words.
QUANTITIES = {
    "aer": "AER",
    "performance": "P",
    "samples_to_best": "to the highest return",
    "samples_to_solved": "to solved",
    "all_samples_to_solved": "to solved, random steps counted too",
    "expert_samples": "samples of the expert",
    "reward": "return",
    "divergence": "KL divergence",
    "greedy_divergence": "KL divergence of greedy actions",
    "agreement": "agreement along trajectories",
    "agreement_of_cells": "agreement in 20 × 20 states",
}


@dataclass(frozen=True)
class Setting:
    """What a number was measured on; None where it does not apply or is not said.

    Attributes:
        method: by the paper's name, "DQN₁".
        env: `env=` by ours; "average" for the mean over the four.
        trajectories: of the expert, learnt from.
        k: eq. 2's slope.
        n: eq. 2's epochs.
        expert_return: the expert's level; None is the usual expert.
    """

    method: str
    env: str
    trajectories: int | None = None
    k: float | None = None
    n: float | None = None
    expert_return: float | None = None

    @property
    def method_key(self) -> str:
        """`method=` by our name."""
        return _METHODS.get(self.method, self.method.lower())


@dataclass(frozen=True)
class Cell:
    """One number of one table.

    Attributes:
        table: "table1" to "table9".
        quantity: a key of `QUANTITIES`.
        setting: what it was measured on.
        mean: the paper's number; None where it reports none.
        spread: the paper's ±; None where it gives none.
    """

    table: str
    quantity: str
    setting: Setting
    mean: float | None
    spread: float | None


@dataclass(frozen=True)
class Table:
    """A table as it is printed: labels, and a cell (or nothing) at each crossing.

    Attributes:
        name: "table1" to "table9".
        number: 1 to 9.
        title: what it is about.
        section: of the paper.
        head: what the labels of the rows are, one or two of them.
        columns: labels across.
        rows: labels down, each with its cells across.
        seeds: how many runs each number is a mean of.
        budget: what each method is given, by its paper's name and a column of `results.csv`.
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
        """All cells, row by row."""
        return (cell for _, cells in self.rows for cell in cells if cell is not None)


@cache
def _content() -> dict[str, dict[str, Any]]:
    text = (Path(__file__).parent / "tables.yaml").read_text(encoding="utf-8")
    content: dict[str, dict[str, Any]] = yaml.safe_load(text)
    return content


#: The paper's tables by name.
TABLES = tuple(f"table{number}" for number in range(1, 10))


@cache
def solved_return(env: str) -> float:
    """Return at which an environment counts as solved (§4.1)."""
    text = (config_folder() / "env" / f"{env}.yaml").read_text(encoding="utf-8")
    return float(yaml.safe_load(text)["solved_return"])


@cache
def known_methods() -> frozenset[str]:
    """`method=` of all methods that some table is about."""
    return frozenset(cell.setting.method_key for name in TABLES for cell in table(name).cells())


@cache
def table(name: str, beyond: tuple[str, ...] = ()) -> Table:
    """One table of the paper.

    Args:
        name: "table1" to "table9".
        beyond: methods that the paper does not have, each beside RIL where methods are compared.
    """
    content = _content()[name]
    across = content["columns"]
    down: list[str] = content["rows"]
    placed = {
        (tuple(at[axis] for axis in down), at[across]): _cell(name, content["setting"], at, numbers)
        for at, numbers in _numbers(content, beyond)
    }
    rows = list(dict.fromkeys(row for row, _ in placed))
    firsts = list(dict.fromkeys(row[0] for row in rows))
    rows.sort(key=lambda row: firsts.index(row[0]))  # all of a method, or environment, together
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
    "expert_return": "Expert's return",
}


def _numbers(
    content: dict[str, Any], beyond: tuple[str, ...]
) -> Iterator[tuple[dict[str, Any], list[float]]]:
    """Where each number stands, by axis, and its mean and spread; those that only we have, too."""

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


def _cell(name: str, shared: dict[str, Any], at: dict[str, Any], numbers: list[float]) -> Cell:
    setting = shared | {axis: key for axis, key in at.items() if axis != "quantity"}
    if setting.get("expert_return") == _usual_expert(setting["env"]):
        setting["expert_return"] = None
    mean, spread = (*numbers, None, None)[:2]
    return Cell(name, at["quantity"], Setting(**setting), mean, spread)


def _usual_expert(env: str) -> float | None:
    """Return of the expert of the main experiments, as Table 9 has it."""
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
