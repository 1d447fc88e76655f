"""A table of the paper with our findings in it, as lines of text for every format."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from ril.report.evidence import Evidence, command
from ril.report.findings import Finding, find
from ril.report.numbers import number
from ril.report.paper.tables import ENVIRONMENTS, Setting, Table, table

_LINES = ("ours", "95 %", "paper", "verdict")
_LEGEND = "ours: mean ± standard deviation over seeds (number of seeds), {} policies"


@dataclass(frozen=True)
class Grid:
    """A table of text, to be written in any format.

    Attributes:
        name: "table2".
        title: the title in words.
        labels: number of leading columns that hold words; the others hold numbers.
        head: a text per column.
        body: lines of as many texts.
        notes: lines below the table.
    """

    name: str
    title: str
    labels: int
    head: list[str]
    body: list[list[str]]
    notes: list[str]


@dataclass(frozen=True)
class Results:
    """A table of the paper with a finding for each of its numbers.

    Attributes:
        table: labels and cells.
        score: which policy of each run counts: "best" or "last".
        rows: labels of each row and its findings; None where the table is blank.
    """

    table: Table
    score: str
    rows: tuple[tuple[tuple[str, ...], tuple[Finding | None, ...]], ...]

    @property
    def findings(self) -> list[Finding]:
        """All findings, row by row."""
        return [found for _, across in self.rows for found in across if found is not None]


def results(name: str, evidence: Evidence, score: str = "best") -> Results:
    """Compare a table of the paper with our rows.

    Args:
        name: "table1" to "table9".
        evidence: our rows; their methods beyond the paper are added next to RIL.
        score: which policy of each run counts: "best" or "last".
    """
    chosen = table(name, evidence.beyond)
    rows = (
        (labels, tuple(None if cell is None else find(cell, evidence, score) for cell in cells))
        for labels, cells in chosen.rows
    )
    return Results(chosen, score, tuple(rows))


def ours(found: Finding) -> str:
    """Write our mean, standard deviation and number of seeds."""
    if found.mean is None:
        return "not run" if found.verdict == "not run" else "never"
    count = "" if found.cell.setting.env == "average" else f" ({len(found.values)})"
    return number(found.cell.quantity, found.mean, found.std) + count


def interval(found: Finding) -> str:
    """Write our 95 % interval."""
    if found.interval is None:
        return ""
    return " … ".join(number(found.cell.quantity, end) for end in found.interval)


def papers(found: Finding) -> str:
    """Write the paper's mean and ±."""
    return number(found.cell.quantity, found.cell.mean, found.cell.std)


def caption(table: Table) -> str:
    """Write a table's number, title and section."""
    return f"Table {table.number}. {table.title} ({table.section})"


def grid(content: Results) -> Grid:
    """Lay out a table with four lines per row of the paper: ours, 95 %, paper, verdict."""
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


def notes(content: Results, *, with_excluded: bool = True) -> list[str]:
    """List reduced runs, excluded runs if asked for, and the commands of cells not run."""
    remarks: dict[str, list[Setting]] = {}
    single = [found for found in content.findings if found.cell.setting.env in ENVIRONMENTS]
    for found in single:
        for remark in (*found.reduced, *(found.excluded if with_excluded else ())):
            remarks.setdefault(remark, []).append(found.cell.setting)
    lines = [f"{remark}: {_places(settings)}" for remark, settings in remarks.items()]
    missing = _sweeps(found.cell.setting for found in single if found.verdict == "not run")
    lines += [f"not run: {_places(together)}: `{command(together)}`" for together in missing]
    if len(missing) > 1:
        lines.append(f"all of these: `ril-run -m experiment={content.table.name}`")
    return lines


def _sweeps(settings: Iterable[Setting]) -> list[list[Setting]]:
    """Group settings so that each group is the product of its values, which one sweep runs."""
    by_rest: dict[Setting, list[Setting]] = {}
    for setting in dict.fromkeys(settings):
        by_rest.setdefault(replace(setting, env=""), []).append(setting)
    sweeps: dict[tuple[str, ...], list[Setting]] = {}
    for rest, together in by_rest.items():
        environments = (setting.env for setting in together)
        sweeps.setdefault((rest.method, *environments), []).extend(together)
    return list(sweeps.values())


def _places(settings: Iterable[Setting]) -> str:
    """Name methods, each with its environments."""
    where: dict[str, dict[str, None]] = {}
    for setting in settings:
        where.setdefault(setting.method, {})[ENVIRONMENTS[setting.env]] = None
    return "; ".join(f"{method} on {', '.join(names)}" for method, names in where.items())
