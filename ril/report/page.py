"""The whole report as one HTML page that needs nothing but itself."""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from urllib.parse import urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ril.io.paths import docs_folder
from ril.report import layout
from ril.report.deviations import documents
from ril.report.findings import VERDICTS, Finding
from ril.report.paper.audit import Contradiction
from ril.report.paper.tables import ENVIRONMENTS, TABLES, Table
from ril.report.provenance import Run
from ril.report.statistics import Aggregate

_WEB = Path(__file__).parent / "web"
#: A verdict is told by a sign too, for those who do not see its colour.
_SIGNS = {"matches": "✓", "better": "▲", "worse": "▼", "not run": "○", "": "–"}


@dataclass(frozen=True)
class Drawn:
    """One figure.

    Attributes:
        name: "figure4"; its anchor in the page.
        title: what it is.
        caption: what one sees in it.
        svg: its markup, trusted; "" if there is nothing to draw yet.
    """

    name: str
    title: str
    caption: str
    svg: str


@dataclass(frozen=True)
class Report:
    """All that a page shows.

    Attributes:
        score: of each run's "best" or "last" policy.
        tables: of the paper, with our findings.
        figures: in order.
        aggregates: of performance P, by the paper's name of the method.
        improvement: probability that RIL is better and its interval, by the other method.
        variants: what keys set apart change.
        contradictions: of the paper with itself.
        runs: whose rows are used.
        left_out: rows that were found and not used, a line each.
    """

    score: str
    tables: Sequence[layout.Results]
    figures: Sequence[Drawn]
    aggregates: Mapping[str, Aggregate]
    improvement: Mapping[str, tuple[float, float, float]]
    variants: layout.Grid
    contradictions: Sequence[Contradiction]
    runs: Sequence[Run]
    left_out: Sequence[str]


@dataclass(frozen=True)
class Placed:
    """A finding and where it stands in the page.

    Attributes:
        anchor: of its cell.
        place: row and column of its table, in words.
        table: that it is of.
        found: our finding.
    """

    anchor: str
    place: str
    table: Table
    found: Finding


@dataclass(frozen=True)
class Tally:
    """How often each verdict is found among some numbers.

    Attributes:
        title: of what they have in common.
        filters: that choose them in the list of all numbers.
        counts: by verdict and whether the rows are as many and as long as the paper's.
    """

    title: str
    filters: Mapping[str, str]
    counts: Counter[tuple[str, bool]]

    def of(self, verdict: str) -> int:
        """Numbers with a verdict."""
        return self.counts[verdict, True] + self.counts[verdict, False]

    @property
    def total(self) -> int:
        """All numbers."""
        return self.counts.total()

    @property
    def measured(self) -> int:
        """Numbers that are run."""
        return self.total - self.of("not run")

    @property
    def full(self) -> int:
        """Numbers that are run with the paper's seeds and budget."""
        return sum(self.counts[verdict, True] for verdict in VERDICTS if verdict != "not run")

    def query(self, **more: str) -> str:
        """Filters that choose these numbers, and more of them, as a query."""
        return urlencode({**self.filters, **more})


def page(report: Report) -> str:
    """The report as HTML that loads nothing: styles, script and figures are in it."""
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
    environment.filters["signed"] = layout.signed
    return environment.get_template("page.html.j2").render(
        report=report,
        tables=tables,
        whole=len(tables) == len(TABLES),
        numbers=numbers,
        overall=_tally("All", {}, numbers),
        by_table=_tallies("table", ((f"Table {one.table.number}", one) for one in numbers)),
        by_method=_tallies("method", ((one.found.cell.setting.method, one) for one in numbers)),
        deviations=documents(docs_folder()),
        run_ids={run.run_id for run in report.runs},
        environments=ENVIRONMENTS,
        layout=layout,
        verdicts=VERDICTS,
        signs=_SIGNS,
        style=Markup((_WEB / "page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


Line = tuple[tuple[str, ...], tuple[Placed | None, ...]]


def _placed(content: layout.Results) -> list[list[Line]]:
    """A table's rows, those with the same first label together, each cell with its anchor."""
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


def _tally(title: str, filters: Mapping[str, str], numbers: Iterable[Placed]) -> Tally:
    found = (placed.found for placed in numbers)
    return Tally(title, filters, Counter((each.verdict, not each.short) for each in found))


def _tallies(what: str, numbers: Iterable[tuple[str, Placed]]) -> list[Tally]:
    """A tally per value of a filter, in the order in which they come."""
    groups: dict[str, list[Placed]] = {}
    for value, placed in numbers:
        groups.setdefault(value, []).append(placed)
    return [_tally(value, {what: value}, together) for value, together in groups.items()]
