"""How often each verdict occurs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import urlencode

from ril.report.findings import VERDICTS, Finding


@dataclass(frozen=True)
class Tally:
    """Counts of verdicts among some results.

    Attributes:
        title: what the results have in common.
        filters: the filters that select them in the page's list of all results.
        counts: by verdict and whether seeds and budget are the paper's.
    """

    title: str
    filters: Mapping[str, str]
    counts: Counter[tuple[str, bool]]

    @classmethod
    def of_findings(
        cls, title: str, findings: Iterable[Finding], filters: Mapping[str, str] | None = None
    ) -> Tally:
        """Count the verdicts of some findings."""
        counts = Counter((found.verdict, not found.reduced) for found in findings)
        return cls(title, filters or {}, counts)

    def of(self, verdict: str) -> int:
        """Count results with a verdict."""
        return self.counts[verdict, True] + self.counts[verdict, False]

    @property
    def total(self) -> int:
        """All results."""
        return self.counts.total()

    @property
    def measured(self) -> int:
        """The number of results for which we have rows."""
        return self.total - self.of("not run")

    @property
    def full(self) -> int:
        """The number of results for which we have rows with the paper's seeds and budget."""
        return sum(self.counts[verdict, True] for verdict in VERDICTS if verdict != "not run")

    def query(self, **more: str) -> str:
        """Encode the filters, and more of them, as a URL query."""
        return urlencode({**self.filters, **more})
