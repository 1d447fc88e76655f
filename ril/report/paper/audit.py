"""The audit of the paper: its numbers and claims, checked against each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from ril.report.layout import Grid
from ril.report.paper import prose_experiments, prose_results
from ril.report.paper.printed import SETTING, Frame, Printed, Range, agree, propagate, rounded
from ril.report.paper.prose import Statement
from ril.report.paper.tables import ENVIRONMENTS

_SAME = ["method", "env", "mean"]  # equal for a number that is repeated in another setting
#: The claims of the text that are checked against the tables.
STATEMENTS = (*prose_experiments.STATEMENTS, *prose_results.STATEMENTS)
_RANDOM, _EXPERT = "Random", "Expert"
#: Tolerance for a number that the text computes from two numbers of two decimals.
_INPUTS_ROUNDED = 0.01


@dataclass(frozen=True)
class Contradiction:
    """Two statements of the paper that exclude each other, whatever the rounding.

    Attributes:
        where: the table and cell, or the section.
        says: the statement.
        against: what the paper's numbers give.
        why: how that follows, and a likely cause of the error.
    """

    where: str
    says: str
    against: str
    why: str


def audit(text: str | None = None) -> list[Contradiction]:
    """Return all contradictions: within the tables, then between the text and the tables.

    Args:
        text: contents of a file like `tables.yaml`; None for the paper's own.
    """
    printed = Printed(text)
    return [
        *_performances(printed),
        *_averages(printed),
        *_repeated(printed),
        *_trajectories(printed),
        *(found for statement in STATEMENTS for found in _statement(printed, statement)),
    ]


def contradictions_grid(contradictions: Sequence[Contradiction]) -> Grid:
    """Lay out contradictions, a line each."""
    body = [[each.where, each.says, each.against, each.why] for each in contradictions]
    note = f"{len(STATEMENTS)} claims of the text were checked against the tables"
    head = ["Where", "The paper says", "Its numbers give", "Why"]
    return Grid("audit", f"{len(body)} contradictions within the paper", 4, head, body, [note])


def _performance(aer: float, random: float, expert: float) -> float:
    """Compute P (§4)."""
    return (aer - random) / (expert - random)


def _references(printed: Printed) -> Frame:
    """Return Table 2's Random and Expert as printed, by environment."""
    cells = printed.cells()
    two = cells[(cells["table"] == "table2") & cells["method"].isin([_RANDOM, _EXPERT])]
    return two.pivot(index="env", columns="method", values="mean")


def _computed(aer: str, references: Frame, env: str) -> Range:
    """Compute the range of P from printed numbers."""
    texts = (aer, references.loc[env, _RANDOM], references.loc[env, _EXPERT])
    return propagate(_performance, [rounded(str(number)) for number in texts])


def _performances(printed: Printed) -> Iterator[Contradiction]:
    """Check each printed P and its ± against its AER and ±."""
    references = _references(printed)
    keys = ["table", *SETTING]
    cells = printed.cells().merge(printed.cells("performance"), on=keys, suffixes=("", "_of_p"))
    for cell in cells.to_dict("records"):
        env, where = cell["env"], f"{_title(cell['table'])}, {cell['method']} on "
        where += ENVIRONMENTS[env]
        found = _computed(cell["mean"], references, env)
        if not agree(found, rounded(cell["mean_of_p"])):
            why = f"(AER − random) / (expert − random), with its AER of {cell['mean']}"
            yield Contradiction(where, f"P = {cell['mean_of_p']}", f"P = {found[0]:.3f}", why)
        if not cell["std_of_p"]:
            continue
        scaled = [cell["std"], *references.loc[env, [_EXPERT, _RANDOM]]]
        ranges = [rounded(number) for number in scaled]
        std = propagate(lambda by, expert, random: by / (expert - random), ranges)
        if not agree(std, rounded(cell["std_of_p"])):
            why = f"± {cell['std']} of its AER / (expert − random)"
            says, against = f"± {cell['std_of_p']}", f"± {std[0]:.3f}"
            yield Contradiction(f"{where}, ± of P", says, against, why)


def _averages(printed: Printed) -> Iterator[Contradiction]:
    """Check each average P, and its ± over environments, against the four AERs."""
    references = _references(printed)
    returns = printed.cells()
    averages = printed.cells("performance").query("env == 'average'")
    for average in averages.to_dict("records"):
        of_method = returns["method"].eq(average["method"]) & returns["table"].eq(average["table"])
        by_env = [
            _computed(aer, references, env)
            for env, aer in returns.loc[of_method, ["env", "mean"]].to_numpy()
        ]
        where = f"{_title(average['table'])}, average P of {average['method']}"
        # The minimum of a standard deviation is not at a corner, but rounding hardly moves it.
        for name, function in (("mean", np.mean), ("std", lambda v: np.std(v, ddof=1))):
            if not average[name]:
                continue
            found = propagate(lambda *values, f=function: float(f(values)), by_env)
            if not agree(found, rounded(average[name])):
                sign = "" if name == "mean" else "± "
                what = "mean" if name == "mean" else "sample standard deviation"
                why = f"the {what} over environments of P from AER"
                says, against = f"{sign}{average[name]}", f"{sign}{found[0]:.3f}"
                yield Contradiction(where + (sign and ", ±"), says, against, why)


def _repeated(printed: Printed) -> Iterator[Contradiction]:
    """Check each number whose setting is also in an earlier table."""
    cells = printed.cells()
    for _, group in cells.groupby(SETTING, sort=False):
        first = group.iloc[0]
        for _, cell in group.iloc[1:].iterrows():
            if agree(rounded(cell["mean"]), rounded(first["mean"])):
                continue
            same = (cells[_SAME] == cell[_SAME]).all(axis=1)
            others = cells[same & (cells["trajectories"] != cell["trajectories"])]
            why = f"both have the same setting, with trajectories = {cell['trajectories']}"
            if len(others):
                other = others.iloc[0]
                why += f"; {_title(other['table'])} has this number for {other['trajectories']}"
            yield Contradiction(
                f"{_title(cell['table'])}, {cell['method']} on {ENVIRONMENTS[cell['env']]}",
                f"AER {cell['mean']}",
                f"AER {first['mean']} in {_title(first['table'])}",
                why,
            )


def _trajectories(printed: Printed) -> Iterator[Contradiction]:
    """Check the expert's return against the length of its 100 trajectories."""
    per_step = {
        "cartpole": 1,
        "acrobot": -1,
        "mountaincar": -1,
    }  # Acrobot's last step costs nothing
    expert = _references(printed)[_EXPERT]
    samples = printed.means("table6", "expert_samples")["100"]
    for env, reward in per_step.items():
        length = samples[env] / 100
        value, low, high = rounded(expert[env])
        free = env == "acrobot"
        if not low - free <= reward * length <= high + free:
            yield Contradiction(
                f"Table 2, Expert on {ENVIRONMENTS[env]}",
                f"AER {value:g}",
                f"{length:.2f} steps in each of 100 trajectories",
                f"{samples[env]:,.0f} samples in Table 6 and a reward of {reward} per step: the "
                "trajectories are better than the expert that scales P",
            )


def _statement(printed: Printed, statement: Statement) -> Iterator[Contradiction]:
    """Check a claim of the text against the tables."""
    found = statement.evaluate(printed)
    if isinstance(found, pd.Series):
        holds = found.empty
        against = "; ".join(f"{_named(at)}: {round(value, 4):,.10g}" for at, value in found.items())
    else:
        _, low, high = rounded(str(statement.number))
        holds = low - _INPUTS_ROUNDED <= found <= high + _INPUTS_ROUNDED
        against = f"{round(found, 4):,.10g}"
    if not holds:
        yield Contradiction(statement.section, statement.says, against, statement.why)


def _title(table: str) -> str:
    return f"Table {table.removeprefix('table')}"


def _named(at: object) -> str:
    """Name a cell's row and column, or one of them."""
    keys = at if isinstance(at, tuple) else (at,)
    return ", ".join(ENVIRONMENTS.get(str(key), str(key)) for key in keys)
