"""A small invented report for tests of its page."""

from __future__ import annotations

from helpers.made_rows import evidence
from ril.report.layout import results
from ril.report.page import Drawn, Report
from ril.report.paper.audit import Contradiction
from ril.report.provenance import Run
from ril.report.statistics import Aggregate
from ril.report.variants import variants, variants_grid

HOSTILE = "<script>alert('x')</script>"
SVG = '<svg viewBox="0 0 2 1" width="100%" role="img"><path d="M0 0L2 1" stroke="red"/></svg>'
RUN = Run(
    "a",
    "mountaincar",
    "ril",
    "",
    "0–1",
    "0123456789ab",
    "ril-run env=mountaincar",
    "today",
    "Python 3",
)


def sample(*cells: dict[str, object], tables: tuple[str, ...] = ("table2", "table7")) -> Report:
    """A small report of made rows."""
    given = evidence(*cells)
    return Report(
        "best",
        [results(name, given) for name in tables],
        [Drawn("figure4", "Box plots", "A box per method.", SVG)],
        {"RIL": Aggregate(*[(0.5, 0.25, -0.75)] * 4)},
        {"BC": (0.625, 0.5, 0.75)},
        variants_grid(variants(given, "best"), "best"),
        [Contradiction("Table 2", "0.55", "0.63", "recomputed")],
        [RUN],
        ["a/results.csv: line 3: torn"],
    )
