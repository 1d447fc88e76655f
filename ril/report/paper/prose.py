"""The claims of the paper's text about its tables, as functions of the tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from ril.report.paper.printed import Frame, Printed


@dataclass(frozen=True)
class Statement:
    """A claim of the text that the tables confirm or refute.

    Attributes:
        section: the section with the claim.
        says: the claim, nearly in the paper's words.
        evaluate: computes from the tables a claimed number or, of other claims, the contradicting
            cells.
        number: the claimed number as printed ("5e5" where only the first digit is meant).
        why: a likely cause of the error.
    """

    section: str
    says: str
    evaluate: Callable[[Printed], float | pd.Series[float]]
    number: str | None = None
    why: str = ""


REINFORCED = ["DQN₁", "DQN₂", "PPO", "ACKTR"]
IMITATING = ["GAIL", "ILPO", "IUPE"]  # without BC and RIL, as in the text
HARD = ["acrobot", "mountaincar", "lunarlander"]
GOALS = pd.Series({"cartpole": 195.0, "mountaincar": -110.0, "lunarlander": 200.0})  # §4.1


def cells(frame: Frame, where: pd.DataFrame | pd.Series[bool]) -> pd.Series[float]:
    """Select cells of a table, by (row, column)."""
    found: pd.Series[float] = frame.where(where).stack().dropna()
    return found


def aer(table: int, env: str, column: str) -> Callable[[Printed], float]:
    """Return a function for one AER of one table."""
    return lambda p: float(p.means(f"table{table}").loc[env, column])


def printed_p(p: Printed, env: str, methods: list[str]) -> float:
    """Average the performance of some methods that Table 2 prints."""
    return float(p.means("table2", "performance").loc[env, methods].mean())


def average_p(p: Printed, methods: list[str]) -> float:
    """Average the average performance of some methods that Table 4 prints."""
    return float(p.means("table4", "performance").loc["average", methods].mean())


def p_of(p: Printed, table: str) -> Frame:
    """Compute performance from AER and Table 2's Random and Expert (§4)."""
    two = p.means("table2")
    found: Frame = p.means(table).sub(two["Random"], axis=0)
    return found.div(two["Expert"] - two["Random"], axis=0)


def unsolved(frame: Frame) -> pd.Series[float]:
    """Select cells below their environment's goal."""
    of_goals = frame.loc[GOALS.index]
    return cells(of_goals, of_goals.lt(GOALS, axis=0))


def table1(p: Printed, quantity: str) -> pd.Series[float]:
    """Return a line of Table 1."""
    line: pd.Series[float] = p.cells(quantity).set_index("method")["mean"].astype(float)
    return line


def rising(frame: Frame, envs: list[str]) -> pd.Series[float]:
    """Select cells that are higher than the one to their left."""
    rows = frame.loc[envs].T.dropna(how="all").T
    rows = pd.concat({env: row.dropna() for env, row in rows.iterrows()}).rename(None)
    higher: pd.Series[float] = rows[rows.groupby(level=0).diff() > 0]
    return higher


def steps(p: Printed) -> Frame:
    """Return Table 3."""
    return p.means("table3", "samples_to_best")


def by_expert(p: Printed) -> Frame:
    """Return Table 9, best experts first."""
    nine = p.means("table9")
    return nine[sorted(nine.columns, key=lambda level: float(level), reverse=True)]


def four(p: Printed, methods: list[str] | str) -> Frame:
    """Return some columns of Table 4."""
    columns = [methods] if isinstance(methods, str) else methods
    return p.means("table4")[columns]


def deviation(p: Printed, method: str) -> float:
    """Average a method's ± in Table 4 over environments."""
    return float(p.stds("table4")[method].mean())
