"""The whole report as one self-contained HTML page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ril.io.ended import Ended
from ril.io.paths import docs_folder
from ril.report import layout
from ril.report.deviations import documents
from ril.report.findings import SIGNS, VERDICTS, Finding
from ril.report.numbers import number, signed
from ril.report.paper.audit import Contradiction
from ril.report.paper.tables import ENVIRONMENTS, TABLES, Table
from ril.report.provenance import Run
from ril.report.statistics import Aggregate
from ril.report.tally import Tally

_WEB = Path(__file__).parent / "web"


@dataclass(frozen=True)
class Drawn:
    """One figure.

    Attributes:
        name: "figure4"; its anchor in the page.
        title: the title in words.
        caption: below it.
        svg: trusted markup; "" without rows to draw.
    """

    name: str
    title: str
    caption: str
    svg: str


@dataclass(frozen=True)
class Report:
    """The contents of a page.

    Attributes:
        score: which policy of each run counts: "best" or "last".
        tables: the paper's tables, with our findings.
        figures: the figures in order.
        aggregates: aggregates of performance P, by method.
        improvement: probability that RIL is better, with its interval, by the other method.
        variants: effect of overridden keys.
        contradictions: within the paper.
        runs: provenance of the rows.
        skipped: files and lines that could not be used, a line each.
        ended: runs that ended without rows.
    """

    score: str
    tables: Sequence[layout.Results]
    figures: Sequence[Drawn]
    aggregates: Mapping[str, Aggregate]
    improvement: Mapping[str, tuple[float, float, float]]
    variants: layout.Grid
    contradictions: Sequence[Contradiction]
    runs: Sequence[Run]
    skipped: Sequence[str]
    ended: Sequence[Ended] = ()


@dataclass(frozen=True)
class Placed:
    """A finding and its place in the page.

    Attributes:
        anchor: the anchor of its cell.
        place: row and column of its table, in words.
        table: the table of the paper.
        found: our finding.
    """

    anchor: str
    place: str
    table: Table
    found: Finding


def page(report: Report) -> str:
    """Render the report as HTML with styles, script and figures inline; the page loads nothing."""
    tables = [(content, _placed(content)) for content in report.tables]
    numbers = [
        placed
        for _, groups in tables
        for group in groups
        for _, across in group
        for placed in across
        if placed is not None and placed.found.counts
    ]
    script = (_WEB / "page.js").read_text(encoding="utf-8")
    environment = Environment(
        loader=FileSystemLoader(_WEB),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signed"] = signed
    return environment.get_template("page.html.j2").render(
        report=report,
        tables=tables,
        whole=len(tables) == len(TABLES),
        numbers=numbers,
        overall=Tally.of_findings("All", (placed.found for placed in numbers)),
        by_table=_tallies("table", ((f"Table {one.table.number}", one) for one in numbers)),
        by_method=_tallies("method", ((one.found.cell.setting.method, one) for one in numbers)),
        deviations=documents(docs_folder()),
        run_ids={run.run_id for run in report.runs},
        environments=ENVIRONMENTS,
        layout=layout,
        number=number,
        verdicts=VERDICTS,
        signs=SIGNS,
        style=Markup((_WEB / "page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


Line = tuple[tuple[str, ...], tuple[Placed | None, ...]]


def _placed(content: layout.Results) -> list[list[Line]]:
    """Group a table's rows by first label, each cell with its anchor."""
    table = content.table
    lines = [
        (
            labels,
            tuple(
                None
                if found is None
                else Placed(
                    f"{table.name}-{row}-{column}",
                    " · ".join(label for label in (*labels, table.columns[column - 1]) if label),
                    table,
                    found,
                )
                for column, found in enumerate(across, start=1)
            ),
        )
        for row, (labels, across) in enumerate(content.rows, start=1)
    ]
    return [list(group) for _, group in groupby(lines, key=lambda line: line[0][0])]


def _tallies(what: str, numbers: Iterable[tuple[str, Placed]]) -> list[Tally]:
    """Count verdicts per value of a filter, in order of appearance."""
    groups: dict[str, list[Finding]] = {}
    for value, placed in numbers:
        groups.setdefault(value, []).append(placed.found)
    return [Tally.of_findings(value, found, {what: value}) for value, found in groups.items()]
