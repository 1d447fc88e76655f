"""A table with our findings in it, as lines of text that every format lays out."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from ril.report.evidence import Evidence, command
from ril.report.findings import Finding, find
from ril.report.paper.tables import ENVIRONMENTS, Setting, Table, table
from ril.report.statistics import Estimate

_DIGITS = {
    "aer": 2,
    "performance": 2,
    "reward": 2,
    "divergence": 4,
    "greedy_divergence": 4,
    "agreement": 2,
    "agreement_of_cells": 2,
}
_LINES = ("ours", "95 %", "paper", "verdict")
_LEGEND = "ours: mean ± standard deviation over seeds (number of seeds), {} policies"


@dataclass(frozen=True)
class Grid:
    """Lines of text under heads, to be written in any format.

    Attributes:
        name: by which it is asked for, "table2".
        title: what it is.
        labels: how many of the first columns are words; the others are numbers.
        head: a text per column.
        body: lines of as many texts.
        notes: what is to be said below, a line each.
    """

    name: str
    title: str
    labels: int
    head: list[str]
    body: list[list[str]]
    notes: list[str]


@dataclass(frozen=True)
class Results:
    """A table of the paper with a finding at each of its numbers.

    Attributes:
        table: labels and cells.
        score: of each run's "best" or "last" policy.
        rows: labels down, each with its findings across; None where the table has nothing.
    """

    table: Table
    score: str
    rows: tuple[tuple[tuple[str, ...], tuple[Finding | None, ...]], ...]

    @property
    def findings(self) -> list[Finding]:
        """All of them, row by row."""
        return [found for _, across in self.rows for found in across if found is not None]


def results(name: str, evidence: Evidence, score: str = "best") -> Results:
    """A table of the paper with what our rows say of it.

    Args:
        name: "table1" to "table9".
        evidence: our rows; their methods that the paper does not have stand beside RIL.
        score: of each run's "best" or "last" policy.
    """
    chosen = table(name, evidence.beyond)
    rows = (
        (labels, tuple(None if cell is None else find(cell, evidence, score) for cell in cells))
        for labels, cells in chosen.rows
    )
    return Results(chosen, score, tuple(rows))


def number(quantity: str, mean: float | None, spread: float | None = None) -> str:
    """A mean, and its spread if there is one, with the digits of a quantity; "" for None."""
    digits = _DIGITS.get(quantity, 0)
    values = (value for value in (mean, spread) if value is not None)
    return " ± ".join(f"{value:z,.{digits}f}" for value in values)


def ours(found: Finding) -> str:
    """Our mean, spread and number of seeds."""
    if found.mean is None:
        return "not run" if found.verdict == "not run" else "never"
    count = "" if found.cell.setting.env == "average" else f" ({len(found.values)})"
    return number(found.cell.quantity, found.mean, found.spread) + count


def interval(found: Finding) -> str:
    """Our 95 % interval."""
    if found.interval is None:
        return ""
    return " … ".join(number(found.cell.quantity, end) for end in found.interval)


def with_interval(estimate: Estimate, sign: str = "-") -> str:
    """A value of P and its interval, if there is one; `sign` "+" is for changes."""
    value, *ends = (f"{number:{sign}z.2f}" for number in estimate)
    return value if math.isnan(estimate[1]) else f"{value} [{', '.join(ends)}]"


def signed(text: str) -> str:
    """Numbers in a text with a minus sign, which is as wide as their digits, for a hyphen."""
    return re.sub(r"(?<![^\s\[])-(?=\d)", "−", text)


def papers(found: Finding) -> str:
    """The paper's mean and spread."""
    return number(found.cell.quantity, found.cell.mean, found.cell.spread)


def caption(table: Table) -> str:
    """A table's number, title and section."""
    return f"Table {table.number}. {table.title} ({table.section})"


def grid(content: Results) -> Grid:
    """A table in which each row of the paper's has four lines, from ours to the verdict."""
    reported = content.table
    head = [*reported.head, "", *reported.columns]
    body = []
    for labels, across in content.rows:
        for position, name in enumerate(_LINES):
            texts = ["" if found is None else _texts(found)[position] for found in across]
            if any(texts):
                shown = labels if position == 0 else ("",) * len(labels)
                body.append([*shown, name, *texts])
    title = f"{caption(reported)}; {_LEGEND.format(content.score)}"
    return Grid(reported.name, title, len(reported.head) + 1, head, body, notes(content))


def _texts(found: Finding) -> tuple[str, str, str, str]:
    return ours(found), interval(found), papers(found), found.verdict


def notes(content: Results) -> list[str]:
    """What falls short of the paper's seeds and budgets, is set aside, or runs what is missing."""
    remarks: dict[str, list[Setting]] = {}
    single = [found for found in content.findings if found.cell.setting.env in ENVIRONMENTS]
    for found in single:
        for remark in (*found.short, *found.aside):
            remarks.setdefault(remark, []).append(found.cell.setting)
    said = [f"{remark}: {_places(settings)}" for remark, settings in remarks.items()]
    missing = _sweeps(found.cell.setting for found in single if found.verdict == "not run")
    said += [f"not run: {_places(together)}: `{command(together)}`" for together in missing]
    if len(missing) > 1:
        said.append(f"all of them: `ril-run -m experiment={content.table.name}`")
    return said


def _sweeps(settings: Iterable[Setting]) -> list[list[Setting]]:
    """Settings in groups of which each is all combinations of its values, so one sweep runs it."""
    by_rest: dict[Setting, list[Setting]] = {}
    for setting in dict.fromkeys(settings):
        by_rest.setdefault(replace(setting, env=""), []).append(setting)
    sweeps: dict[tuple[str, ...], list[Setting]] = {}
    for rest, together in by_rest.items():
        environments = (setting.env for setting in together)
        sweeps.setdefault((rest.method, *environments), []).extend(together)
    return list(sweeps.values())


def _places(settings: Iterable[Setting]) -> str:
    """Methods, each with its environments, in words."""
    where: dict[str, dict[str, None]] = {}
    for setting in settings:
        where.setdefault(setting.method, {})[ENVIRONMENTS[setting.env]] = None
    return "; ".join(f"{method} on {', '.join(names)}" for method, names in where.items())
