"""The paper's number for the cell that one run is of."""

from __future__ import annotations

import pandas as pd

from ril.report.evidence import Evidence, shortfall
from ril.report.layout import number
from ril.report.paper.tables import ENVIRONMENTS, TABLES, table


def paper_cell(rows: pd.DataFrame) -> str | None:
    """The paper's AER for the cell that a run's rows are of, in words; None if it has none."""
    run = Evidence(rows, pd.DataFrame())
    for name in TABLES:
        reported = table(name)
        for cell in reported.cells():
            if cell.quantity != "aer" or cell.setting.env not in ENVIRONMENTS:
                continue
            if not run.matching(cell.setting).empty:
                short = shortfall(rows, reported, cell.setting.method)
                ran = f"; this was {' and '.join(short)}" if short else ""
                papers = number("aer", cell.mean, cell.spread)
                return f"{papers} (Table {reported.number}: {reported.title}{ran})"
    return None
