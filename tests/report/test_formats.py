"""Golden tests: a fixed set of rows gives exactly these numbers, in every format.

After an intended change, `PYTHONPATH=tests python tests/report/test_formats.py` rewrites them.
"""

from __future__ import annotations

import csv
import io
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from helpers.made_rows import ALONE, evidence
from rich.console import Console

from ril.report.evidence import Evidence
from ril.report.formats import as_csv, as_latex, as_markdown, as_table, grid_as_csv
from ril.report.layout import Grid, grid, results
from ril.report.paper.audit import audit, contradictions_grid

GOLDEN = Path(__file__).parent / "golden"
ENVIRONMENTS = {"cartpole": 490.0, "acrobot": -80.0, "mountaincar": -101.0, "lunarlander": 150.0}


def fixed() -> Evidence:
    """Ten seeds of RIL everywhere; BC, DQN₁ and others here and there."""
    ril = [
        {"env": env, "run_id": f"ril-{env}", "seed": seed, "aer": aer + seed, "aer_last": aer - 9}
        for env, aer in ENVIRONMENTS.items()
        for seed in range(10)
    ]
    bc = [
        {"method": "bc", "run_id": "bc", "seed": seed, "aer": -130.0 - seed, "k": None, "n": None}
        for seed in range(3)
    ]
    dqn = [{"method": "dqn", "run_id": "dqn", "aer": -120.0, **ALONE, "total_timesteps": 300_000}]
    more = [
        {"run_id": "k3", "k": 3.0, "aer": -109.2, "seed": 0},
        {"run_id": "hundred", "trajectories": 100, "aer": -99.0, "expert_samples": 1_504_500},
        {"run_id": "worse", "expert_return": -140.0, "aer": -104.0},
        {"run_id": "variant", "variant": "method.episodes=2"},
        {"run_id": "new", "method": "ril_consistent", "aer": -98.0},
    ]
    evaluations = [
        {"run_id": row["run_id"], "seed": row["seed"], "epoch": e, "samples": 306 * e, "aer": aer}
        for row in ril
        for e, aer in ((5, -500.0), (50, float(row["aer"])), (150, float(row["aer"]) - 1))  # type: ignore[arg-type]
    ]
    return evidence(*ril, *bc, *dqn, *more, curves=pd.DataFrame(evaluations))


def texts() -> dict[str, str]:
    """The expected contents of every golden file."""
    given = fixed()
    tables = [results(f"table{number}", given) for number in range(2, 10)]
    grids = [grid(table) for table in tables]
    return {
        "tables.md": "\n".join(map(as_markdown, grids)),
        "tables.csv": as_csv(tables),
        "tables.tex": "\n".join(map(as_latex, grids)),
        "table4_last.md": as_markdown(grid(results("table4", given, "last"))),
    }


@pytest.mark.quick
@pytest.mark.parametrize("name", ["tables.md", "tables.csv", "tables.tex", "table4_last.md"])
def test_the_fixed_rows_give_exactly_these_tables(name: str) -> None:
    assert texts()[name] == (GOLDEN / name).read_text(encoding="utf-8")


def numbers_of(table: str, **where: str) -> dict[str, str]:
    """A line of the golden CSV."""
    lines = csv.DictReader((GOLDEN / "tables.csv").read_text(encoding="utf-8").splitlines())
    [line] = [
        line
        for line in lines
        if line["table"] == table and all(line[key] == value for key, value in where.items())
    ]
    return line


def test_a_number_of_the_golden_file_by_hand() -> None:
    line = numbers_of("table2", method="RIL", env="mountaincar", quantity="aer")
    assert (line["mean"], line["seeds"], line["paper_mean"]) == ("-96.5", "10", "-100.29")
    assert float(line["std"]) == pytest.approx(8.25**0.5, abs=1e-5)  # of 0 … 9
    assert -99 < float(line["low"]) < -96.5 < float(line["high"]) < -94
    assert line["verdict"] == "better"


def test_performance_of_the_golden_file_by_hand() -> None:
    line = numbers_of("table2", method="BC", env="mountaincar", quantity="performance")
    assert float(line["mean"]) == pytest.approx((200 - 131) / 100)


def test_samples_of_the_golden_file_by_hand() -> None:
    line = numbers_of("table3", method="RIL", env="mountaincar", quantity="samples_to_best")
    assert (line["mean"], line["verdict"]) == ("15300", "better")


def plain(*cells: str) -> Grid:
    return Grid("name", "A title", 1, ["", *("" for _ in cells)], [["RIL", *cells]], [])


def test_a_bar_in_a_text_does_not_end_a_markdown_cell() -> None:
    assert as_markdown(plain("a|b")).splitlines()[-1] == r"| RIL | a\|b |"


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("a_b & 5 % #1 {x} $y", r"a\_b \& 5 \% \#1 \{x\} \$y"),
        ("1.00 ± 2.00", r"1.00 $\pm$ 2.00"),
        ("π* RIL*", r"$\pi^*$ RIL$^*$"),
        ("DQN₂ \\ ^ ~", r"DQN$_2$ \textbackslash{} \textasciicircum{} \textasciitilde{}"),
    ],
)
def test_a_text_in_latex(text: str, latex: str) -> None:
    assert as_latex(plain(text)).splitlines()[8] == rf"RIL & {latex} \\"


def test_a_terminal_shows_labels_whole_and_every_number() -> None:
    written = io.StringIO()
    Console(file=written, width=90).print(as_table(grid(results("table2", fixed()))))
    shown = written.getvalue()
    assert "ril_consistent" in shown
    assert "-96.50 ±" in shown


def test_a_comma_stays_within_its_csv_field() -> None:
    assert list(csv.reader(io.StringIO(grid_as_csv(plain("1,000")))))[1] == ["RIL", "1,000"]


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="TeX is not installed")
def test_latex_compiles(tmp_path: Path) -> None:
    text = (GOLDEN / "tables.tex").read_text(encoding="utf-8")
    text += as_latex(contradictions_grid(audit()))
    document = [r"\documentclass[a3paper]{article}\usepackage{booktabs}\begin{document}", text]
    (tmp_path / "tables.tex").write_text("\n".join([*document, r"\end{document}"]))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Missing character" not in done.stdout


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name, text in texts().items():
        (GOLDEN / name).write_text(text, encoding="utf-8")
