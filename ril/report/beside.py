"""The paper's result for the setting of one run."""

from __future__ import annotations

import pandas as pd

from ril.report.evidence import Evidence, reductions
from ril.report.numbers import number
from ril.report.paper.tables import ENVIRONMENTS, TABLES, table


def paper_cell(rows: pd.DataFrame) -> str | None:
    """Return the paper's AER for the setting of a run's rows, in words; None if it has none."""
    run = Evidence(rows, pd.DataFrame())
    for name in TABLES:
        reported = table(name)
        for cell in reported.cells():
            if cell.quantity != "aer" or cell.setting.env not in ENVIRONMENTS:
                continue
            if not run.matching(cell.setting).empty:
                reduced = reductions(rows, reported, cell.setting.method)
                ran = f"; this run has {' and '.join(reduced)}" if reduced else ""
                papers = number("aer", cell.mean, cell.std)
                return f"{papers} (Table {reported.number}: {reported.title}{ran})"
    return None
