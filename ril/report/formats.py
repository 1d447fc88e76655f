"""Tables as Markdown, terminal text, LaTeX or CSV."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ril.report.layout import Grid, Results
from ril.report.numbers import signed

_VERDICT_STYLES = {"matches": "blue", "better": "green", "worse": "red", "not run": "dim"}
_LATEX = {
    "π*": r"$\pi^*$",
    "±": r"$\pm$",
    "…": r"\dots{}",
    "₁": r"$_1$",
    "₂": r"$_2$",
    "*": r"$^*$",
    "−": r"$-$",
    "≈": r"$\approx$",
    "×": r"$\times$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "–": "--",
    "§": r"\S{}",
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    **{special: rf"\{special}" for special in "&%$#_{}"},
}
_LATEX_SPECIAL = re.compile("|".join(map(re.escape, _LATEX)))


def as_markdown(grid: Grid) -> str:
    """Write a table as Markdown, its title above and its notes below."""
    text = f"**{grid.title}**\n\n{markdown_table(grid.head, grid.body)}"
    return text + "".join(f"\n- {note}" for note in grid.notes) + "\n" * bool(grid.notes)


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table with aligned columns."""
    lines = [[cell.replace("|", r"\|") for cell in line] for line in (head, *body)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    rules = ["-" * width for width in widths]
    padded = [
        [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        for line in (lines[0], rules, *lines[1:])
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in padded)


def as_table(grid: Grid) -> Table:
    """Lay out a table for a terminal."""
    table = Table(title=grid.title, title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for number, name in enumerate(grid.head):
        if number < grid.labels:
            table.add_column(name, no_wrap=True)
        else:
            table.add_column(name, justify="right", overflow="fold")
    for number, line in enumerate(grid.body):
        if line[0] and number:
            table.add_section()
        table.add_row(*(Text(cell, _VERDICT_STYLES.get(cell, "")) for cell in line))
    return table


def as_latex(grid: Grid) -> str:
    """Write a table as a LaTeX float, which needs the package booktabs."""
    columns = "l" * grid.labels + "r" * (len(grid.head) - grid.labels)
    text = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_escaped(grid.title)}}}",
        rf"\label{{tab:{grid.name}}}",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        _latex_line(grid.head),
        r"\midrule",
    ]
    for number, line in enumerate(grid.body):
        if line[0] and number:
            text.append(r"\addlinespace")
        text.append(_latex_line(line))
    text += [r"\bottomrule", r"\end{tabular}"]
    text += [rf"\par\footnotesize {_escaped(note)}" for note in grid.notes]
    return "\n".join([*text, r"\end{table}"]) + "\n"


def _latex_line(cells: list[str]) -> str:
    return " & ".join(map(_escaped, cells)) + r" \\"


def _escaped(text: str) -> str:
    return _LATEX_SPECIAL.sub(lambda found: _LATEX[found[0]], signed(text))


def grid_as_csv(grid: Grid) -> str:
    """Write a table of text as CSV."""
    return pd.DataFrame(grid.body, columns=grid.head).to_csv(index=False)


def as_csv(contents: list[Results]) -> str:
    """Write tables as CSV, a line per number: its setting, ours, the paper's, the verdict."""
    lines = pd.DataFrame(
        {
            "table": found.cell.table,
            "quantity": found.cell.quantity,
            **vars(found.cell.setting),
            "mean": found.mean,
            "std": found.std,
            "score": content.score,
            "seeds": None if found.cell.setting.env == "average" else len(found.values),
            "low": found.interval[0] if found.interval else None,
            "high": found.interval[1] if found.interval else None,
            "paper_mean": found.cell.mean,
            "paper_std": found.cell.std,
            "verdict": found.verdict,
            "reduced": "; ".join(found.reduced),
            "command": found.command,
            "run_ids": " ".join(found.run_ids),
        }
        for content in contents
        for found in content.findings
    )
    return lines.to_csv(index=False, float_format="%.6g")
