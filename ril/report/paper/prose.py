"""What the paper's text says of its own tables, and where they show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from ril.report.paper.printed import Frame, Printed


@dataclass(frozen=True)
class Statement:
    """Something that the text says and the tables confirm or not.

    Attributes:
        section: where it says so.
        says: what, in its words or nearly.
        look: what the tables have: for a number its value, else the cells that are exceptions.
        number: the text's, as printed ("5e5" where only the first digit is meant).
        why: what may have gone wrong where it does not hold.
    """

    section: str
    says: str
    look: Callable[[Printed], float | pd.Series[float]]
    number: str | None = None
    why: str = ""


REINFORCED = ["DQN₁", "DQN₂", "PPO", "ACKTR"]
IMITATING = ["GAIL", "ILPO", "IUPE"]  # without BC, which sees actions, and RIL
HARD = ["acrobot", "mountaincar", "lunarlander"]
GOALS = pd.Series({"cartpole": 195.0, "mountaincar": -110.0, "lunarlander": 200.0})  # §4.1


def cells(frame: Frame, where: pd.DataFrame | pd.Series[bool]) -> pd.Series[float]:
    """Some cells of a table, by (row, column)."""
    found: pd.Series[float] = frame.where(where).stack().dropna()
    return found


def aer(table: int, env: str, column: str) -> Callable[[Printed], float]:
    """One AER of one table."""
    return lambda p: float(p.means(f"table{table}").loc[env, column])


def printed_p(p: Printed, env: str, methods: list[str]) -> float:
    """Mean of what Table 2 prints as some methods' performance."""
    return float(p.means("table2", "performance").loc[env, methods].mean())


def average_p(p: Printed, methods: list[str]) -> float:
    """Mean of what Table 4 prints as some methods' average performance."""
    return float(p.means("table4", "performance").loc["average", methods].mean())


def p_of(p: Printed, table: str) -> Frame:
    """Performance from AER and Table 2's Random and Expert (§4)."""
    two = p.means("table2")
    found: Frame = p.means(table).sub(two["Random"], axis=0)
    return found.div(two["Expert"] - two["Random"], axis=0)


def unsolved(frame: Frame) -> pd.Series[float]:
    """Cells below their environment's goal."""
    of_goals = frame.loc[GOALS.index]
    return cells(of_goals, of_goals.lt(GOALS, axis=0))


def table1(p: Printed, quantity: str) -> pd.Series[float]:
    """A line of Table 1."""
    line: pd.Series[float] = p.cells(quantity).set_index("method")["mean"].astype(float)
    return line


def rising(frame: Frame, envs: list[str]) -> pd.Series[float]:
    """Cells that are higher than the one to their left."""
    rows = frame.loc[envs].T.dropna(how="all").T
    rows = pd.concat({env: row.dropna() for env, row in rows.iterrows()}).rename(None)
    higher: pd.Series[float] = rows[rows.groupby(level=0).diff() > 0]
    return higher


def steps(p: Printed) -> Frame:
    """Table 3."""
    return p.means("table3", "samples_to_best")


def by_expert(p: Printed) -> Frame:
    """Table 9, the best experts first."""
    nine = p.means("table9")
    return nine[sorted(nine.columns, key=lambda level: float(level), reverse=True)]


def four(p: Printed, methods: list[str] | str) -> Frame:
    """Some columns of Table 4."""
    columns = [methods] if isinstance(methods, str) else methods
    return p.means("table4")[columns]


def deviation(p: Printed, method: str) -> float:
    """A method's ± in Table 4, averaged over environments."""
    return float(p.spreads("table4")[method].mean())
