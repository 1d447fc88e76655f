"""Write a report: tables to standard output, figures and pages to files."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from ril.io.errors import UserError
from ril.io.files import write_atomically
from ril.report import aggregates
from ril.report.evidence import Evidence
from ril.report.formats import as_csv, as_latex, as_markdown, as_table, grid_as_csv
from ril.report.layout import Grid, Results, grid, results
from ril.report.paper.audit import audit, contradictions_grid
from ril.report.paper.tables import TABLES
from ril.report.provenance import runs
from ril.report.variants import variants, variants_grid


@dataclass(frozen=True)
class Wanted:
    """The contents and the place of a report.

    Attributes:
        targets: names of tables and figures, in the order of the report; "results" for the page
            of the documentation.
        audit: whether to list the paper's contradictions.
        form: "md", "csv", "latex" or "html".
        score: which policy of each run counts: "best" or "last".
        outputs: folders of runs.
        to: folder for files.
    """

    targets: tuple[str, ...]
    audit: bool
    form: str
    score: str
    outputs: tuple[Path, ...]
    to: Path


def write(wanted: Wanted) -> None:
    """Print a report or write its files, and print their paths.

    Raises:
        UserError: a file cannot be written.
    """
    console = Console(stderr=True, highlight=False)
    shown = [name for name in wanted.targets if name != "results"]
    has_figures = wanted.form != "csv" and any(name not in TABLES for name in shown)
    if has_figures or wanted.form == "html" or "results" in wanted.targets:
        with _writable(wanted.to):
            pass  # fail before any work
    with console.status("reading rows"):
        evidence = Evidence.of(wanted.outputs)
    if evidence.rows.empty:
        where = ", ".join(map(str, wanted.outputs))
        console.print(f"no rows in {where}", soft_wrap=True, markup=False)
    for line in evidence.skipped:
        console.print(f"skipped: {line}", soft_wrap=True, markup=False)
    for run in evidence.ended:
        console.print(str(run), soft_wrap=True, markup=False)
    if "results" in wanted.targets:
        with console.status("writing results"):
            written = _results(wanted, evidence)
        print(*written, sep="\n")
    with console.status("comparing with the paper"):
        tables = [results(name, evidence, wanted.score) for name in shown if name in TABLES]
    if wanted.form == "html":
        print(_page(wanted, evidence, tables, console))
        return
    grids = _grids(wanted, evidence, tables)
    if wanted.form == "csv" and tables:
        print(as_csv(tables))  # numbers as numbers; other columns would not fit
        grids = []
    for given in grids:
        if wanted.form == "md" and sys.stdout.isatty():
            _show(given)
        else:
            print(_FORMATS[wanted.form](given))
    if has_figures:
        _save_figures(wanted, evidence, console)


def _grids(wanted: Wanted, evidence: Evidence, tables: list[Results]) -> list[Grid]:
    """Lay out the tables for standard output."""
    grids = [grid(table) for table in tables]
    if "statistics" in wanted.targets:
        every = aggregates.performances(evidence, wanted.score)
        grids.append(aggregates.statistics_grid(every))
    if "variants" in wanted.targets:
        grids.append(variants_grid(variants(evidence, wanted.score), wanted.score))
    if wanted.audit:
        grids.append(contradictions_grid(audit()))
    return grids


def _results(wanted: Wanted, evidence: Evidence) -> list[Path]:
    """Write the documentation's page of results and the README's figure; return their paths."""
    from ril.report.drawing import overviews
    from ril.report.results_page import results_page

    outputs = [folder.as_posix() for folder in wanted.outputs]
    made_by = ["ril-report", "results", "--outputs", *outputs, "--to", wanted.to.as_posix()]
    tables = [results(name, evidence) for name in TABLES]
    contents = {wanted.to / "results.md": results_page(evidence, tables, shlex.join(made_by))}
    for theme, svg in overviews(evidence).items():
        contents[wanted.to / "assets" / f"table2-{theme}.svg"] = svg
    for path, content in contents.items():
        with _writable(path.parent):
            write_atomically(path, content.encode())
    return list(contents)


def _save_figures(wanted: Wanted, evidence: Evidence, console: Console) -> None:
    """Write the figures and print their paths."""
    from ril.report.drawing import drawings  # tables need neither matplotlib nor torch
    from ril.report.figures.style import save

    for drawing in drawings(wanted.targets):
        with console.status(f"drawing {drawing.name}"), _writable(wanted.to):
            figure = drawing.draw(evidence, wanted.score)
            files = save(figure, wanted.to, drawing.name) if figure else []
        for file in files:
            console.print(str(file), soft_wrap=True, markup=False)
        if not files:
            console.print(f"{drawing.name}: no rows to draw yet")


def _page(wanted: Wanted, evidence: Evidence, tables: list[Results], console: Console) -> Path:
    """Write the page; return its path."""
    from ril.report.drawing import drawings
    from ril.report.figures.style import as_svg
    from ril.report.page import Drawn, Report, page

    drawn = []
    for drawing in drawings(wanted.targets):
        with console.status(f"drawing {drawing.name}"):
            figure = drawing.draw(evidence, wanted.score)
            svg = as_svg(figure, drawing.name) if figure else ""
        drawn.append(Drawn(drawing.name, drawing.title, drawing.caption, svg))
    every = aggregates.performances(evidence, wanted.score)
    content = page(
        Report(
            score=wanted.score,
            tables=tables,
            figures=drawn,
            aggregates=aggregates.aggregates(every),
            improvement=aggregates.improvements(every),
            variants=variants_grid(variants(evidence, wanted.score), wanted.score),
            contradictions=audit(),
            runs=runs(evidence.rows),
            skipped=evidence.skipped,
            ended=evidence.ended,
        )
    )
    with _writable(wanted.to):
        write_atomically(wanted.to / "index.html", content.encode())
    return wanted.to / "index.html"


_FORMATS = {"md": as_markdown, "latex": as_latex, "csv": grid_as_csv}


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    """Create a folder, and report in one line if it or its files cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise UserError(f"--to {folder}: cannot be written ({error.strerror})") from None


def _show(given: Grid) -> None:
    """Show a table on a terminal, with notes whose commands can be copied."""
    terminal = Console(highlight=False)
    terminal.print(as_table(given))
    for note in given.notes:
        terminal.print(f"• {note}", soft_wrap=True, markup=False)
    terminal.print()
