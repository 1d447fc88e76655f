from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from helpers.made_rows import rows

from ril.cli.report import FIGURES, main
from ril.report.paper.tables import TABLES


def leave_run(folder: Path, *cells: dict[str, object]) -> Path:
    """A run's folder with rows and a curve."""
    folder.mkdir(parents=True)
    made = rows(*cells).drop(columns="folder")
    numbers = made.columns.difference(
        ["k", "n", "trajectories", "expert_return", "total_timesteps"]
    )
    made[numbers] = made[numbers].astype(object).where(made[numbers].notna(), 0)
    made.to_csv(folder / "results.csv", index=False)
    evaluation = {"run_id": "a", "epoch": 5, "samples": 1500, "aer": -120.0}
    pd.DataFrame([evaluation | {"seed": seed} for seed in made["seed"]]).drop(
        columns="run_id"
    ).to_csv(folder / "curve.csv", index=False)
    return folder


def report(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["ril-report", *arguments])
    main()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty one to work in, with one run below `outputs`."""
    monkeypatch.chdir(tmp_path)
    leave_run(tmp_path / "outputs" / "one", {"seed": 0}, {"seed": 1})
    return tmp_path


def test_a_table_goes_to_standard_output(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "table2")
    shown = capsys.readouterr()
    assert "-105.00 ± 0.00 (2)" in shown.out
    assert shown.err == ""


def test_the_effect_of_overridden_keys_goes_to_standard_output_and_to_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    variant = {"run_id": "b", "variant": "method.episodes=2", "aer": -95.0}
    leave_run(folder / "outputs" / "two", variant | {"seed": 0}, variant | {"seed": 1})
    report(monkeypatch, "variants")
    shown = capsys.readouterr()
    assert "| -95.00 ± 0.00 (2)" in shown.out
    assert "+0.10 [+0.10, +0.10]" in shown.out
    for ending in ("pdf", "png"):
        assert f"report/variants.{ending}" in shown.err
        assert (folder / "report" / f"variants.{ending}").stat().st_size > 1000


def test_without_overridden_keys_there_is_nothing_to_draw(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "variants")
    shown = capsys.readouterr()
    assert "no runs with overridden keys" in shown.out
    assert "variants: no rows to draw yet" in shown.err


def test_several_tables_stand_in_the_reports_order(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "table7", "table2")
    out = capsys.readouterr().out
    assert out.index("**Table 2.") < out.index("**Table 7.")


def test_rows_of_several_folders_count(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    leave_run(folder / "more", {"run_id": "b", "seed": 2, "aer": -111.0})
    report(monkeypatch, "table2", "--outputs", "outputs", "more")
    assert "-107.00 ± 2.83 (3)" in capsys.readouterr().out


def test_csv_is_one_frame_of_all_tables(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "table2", "table7", "--format", "csv")
    lines = list(csv.DictReader(capsys.readouterr().out.strip().splitlines()))
    assert {line["table"] for line in lines} == {"table2", "table7"}
    assert len(lines) == 63 + 28


def test_latex_needs_its_format_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "table8", "--format", "latex")
    assert r"\label{tab:table8}" in capsys.readouterr().out


def test_the_last_policies_can_be_scored(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "table2", "--score", "last")
    assert "-110.00 ± 0.00 (2)" in capsys.readouterr().out


def test_a_figure_is_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "curves", "--to", "pictures")
    assert capsys.readouterr().err.split() == ["pictures/curves.pdf", "pictures/curves.png"]
    assert (folder / "pictures/curves.png").read_bytes().startswith(b"\x89PNG")


def test_all_is_a_page(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch)
    assert capsys.readouterr().out == "report/index.html\n"
    page = (folder / "report/index.html").read_text(encoding="utf-8")
    assert all(f'id="{name}' in page for name in (*TABLES, *FIGURES))


def test_an_empty_folder_gives_a_whole_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report(monkeypatch)
    assert "not run" in (tmp_path / "report/index.html").read_text(encoding="utf-8")


def test_the_audit_is_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    report(monkeypatch, "--audit")
    out = capsys.readouterr().out
    assert "0.55" in out
    assert "0.63" in out  # IUPE on Acrobot, recomputed
    assert "Table 2. " not in out


def test_skipped_files_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = leave_run(folder / "outputs" / "torn", {"run_id": "torn"})
    (torn / "results.csv").write_text("run_id,env\nx\n")
    report(monkeypatch, "table2")
    assert "skipped: outputs/torn/results.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["table10"], r"table10: unknown target; choose from table1, table2, .*, all, results$"),
        (["table2", "--outputs", "nowhere"], r"--outputs nowhere: no such folder$"),
        (["table2", "--format", "pdf"], r"argument --format: invalid choice: 'pdf'.*$"),
        (["table2", "--score", "worst"], r"argument --score: invalid choice: 'worst'.*$"),
        (["--to", "outputs/one/results.csv"], r"--to outputs/one/results.csv: cannot be written"),
        (["curves", "--to", "outputs/one/results.csv"], r"--to .*: cannot be written \(.*\)$"),
        (["--color"], r"unrecognized arguments: --color$"),
    ],
)
def test_a_mistake_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    with pytest.raises(SystemExit, match=f"^ril-report: {says}"):
        report(monkeypatch, *arguments)


def test_a_reader_that_has_enough_ends_it_quietly(folder: Path) -> None:
    command = f"{sys.executable} -m ril.cli.report table2 table4 table6 --format md | head -n 1"
    done = subprocess.run(
        command, shell=True, cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("**Table 2.")
    assert done.stderr == ""


def test_a_locale_without_the_papers_signs_is_no_reason_to_fail(folder: Path) -> None:
    command = [sys.executable, "-m", "ril.cli.report", "table2"]
    poor = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, cwd=folder, env=poor, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"-105.00 +- 0.00 (2)" in done.stdout


def test_tables_need_neither_torch_nor_matplotlib(folder: Path) -> None:
    code = (
        "import sys; sys.argv = ['ril-report', 'table2']; from ril.cli.report import main; main();"
        "sys.exit('loaded' if {'torch', 'matplotlib'} & set(sys.modules) else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_version_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ril.__version__", "1.2.3", raising=False)
    with pytest.raises(SystemExit) as end:
        report(monkeypatch, "--version")
    assert (end.value.code, capsys.readouterr().out) == (0, "ril-report 1.2.3\n")


def test_results_are_a_page_and_two_figures_of_their_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report(monkeypatch, "results", "--to", "pages")
    assert capsys.readouterr().out.split() == [
        "pages/results.md",
        "pages/assets/table2-light.svg",
        "pages/assets/table2-dark.svg",
    ]
    first, *_ = (folder / "pages/results.md").read_text(encoding="utf-8").splitlines()
    assert "`ril-report results --outputs outputs --to pages`" in first
