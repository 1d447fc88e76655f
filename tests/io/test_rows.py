from __future__ import annotations

import dataclasses
import errno
import os
import re
import time
from pathlib import Path

import pandas as pd
import pytest
from helpers.rows import ROW, row

from ril.io.files import WriteError, write_atomically
from ril.io.rows import CurvePoint, Row, load_curves, load_results, write_csv


def written(folder: Path, *rows: Row) -> Path:
    """Write a results.csv of some rows, by default `ROW`, even if ril would not."""
    folder.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame([dataclasses.asdict(each) for each in rows or [ROW]])
    table.to_csv(folder / "results.csv", index=False)
    return folder / "results.csv"


def only_fault(folder: Path) -> str:
    """The message about the one thing that was left out of a folder."""
    _, [line] = load_results([folder])
    return line.removeprefix(f"{folder}/")


def test_a_file_is_written_completely(tmp_path: Path) -> None:
    write_atomically(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


def test_a_file_replaces_the_old_one(tmp_path: Path) -> None:
    write_atomically(tmp_path / "file", b"old, and longer")
    write_atomically(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


def test_writing_leaves_nothing_else(tmp_path: Path) -> None:
    write_atomically(tmp_path / "file", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_an_interrupted_write_leaves_the_old_content_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def interrupt(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    write_atomically(tmp_path / "file", b"old")
    if step == "fsync":
        monkeypatch.setattr(os, "fsync", interrupt)
    else:
        monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(WriteError, match="no space left"):
        write_atomically(tmp_path / "file", b"new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"file": b"old"}


def test_rows_come_back(tmp_path: Path) -> None:
    write_csv(tmp_path / "results.csv", [ROW])
    rows, left_out = load_results([tmp_path])
    found = rows.iloc[0].to_dict()
    expected = dataclasses.asdict(ROW)
    assert found.pop("folder") == tmp_path
    assert pd.isna(found.pop("expert_return"))
    assert expected.pop("expert_return") is None
    assert (found, left_out) == (expected, [])


def test_columns_are_the_fields_in_their_order(tmp_path: Path) -> None:
    write_csv(tmp_path / "results.csv", [ROW])
    header = (tmp_path / "results.csv").read_text().splitlines()[0]
    assert header.split(",") == [field.name for field in dataclasses.fields(Row)]


def test_each_diagnostic_is_a_column_and_missing_ones_are_empty(tmp_path: Path) -> None:
    points = [CurvePoint(0, 5, 9, -2.5, {"loss": 0.5}), CurvePoint(0, 6, 10, -2.0, {"goals": 1.0})]
    write_csv(tmp_path / "curve.csv", points)
    assert (tmp_path / "curve.csv").read_text().splitlines() == [
        "seed,epoch,samples,aer,loss,goals",
        "0,5,9,-2.5,0.5,",
        "0,6,10,-2.0,,1.0",
    ]


def test_results_of_all_folders_below_are_read(tmp_path: Path) -> None:
    for number, folder in enumerate(["one/a", "one/b", "two/c/d"]):
        written(tmp_path / folder, row(run_id=f"run{number}", seed=number))
    rows, _ = load_results([tmp_path / "one", tmp_path / "two"])
    assert rows["seed"].tolist() == [0, 1, 2]
    assert rows["folder"].tolist() == [tmp_path / "one/a", tmp_path / "one/b", tmp_path / "two/c/d"]


@pytest.mark.parametrize("folder", [".", "missing"])
def test_without_results_the_table_is_empty_and_has_its_columns(
    tmp_path: Path, folder: str
) -> None:
    rows, left_out = load_results([tmp_path / folder])
    assert rows.columns.tolist() == [*(field.name for field in dataclasses.fields(Row)), "folder"]
    assert (len(rows), left_out) == (0, [])


def test_a_folder_given_twice_counts_once(tmp_path: Path) -> None:
    written(tmp_path / "a")
    rows, left_out = load_results([tmp_path, tmp_path / "a", tmp_path / "a" / ".." / "a"])
    assert (len(rows), left_out) == (1, [])


def test_files_are_named_as_they_were_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path / "outputs" / "a", row(aer=float("nan")))
    monkeypatch.chdir(tmp_path)
    _, left_out = load_results([Path("outputs")])
    assert left_out == ["outputs/a/results.csv: line 2: seed 0: aer is '', must be a finite number"]


@pytest.mark.parametrize(
    "text", ["0123456789", "12345e6789", "9999999e99", "abcdef0123", "NA", "nan", "None", "1.0"]
)
@pytest.mark.parametrize("column", ["run_id", "env", "method", "variant", "commit"])
def test_text_stays_text(tmp_path: Path, column: str, text: str) -> None:
    written(tmp_path, row(**{column: text}))
    rows, _ = load_results([tmp_path])
    assert rows[column].tolist() == [text]


@pytest.mark.parametrize("column", ["variant", "commit"])
def test_text_that_may_be_empty_is_empty(tmp_path: Path, column: str) -> None:
    written(tmp_path, row(**{column: ""}))
    rows, left_out = load_results([tmp_path])
    assert (rows[column].tolist(), left_out) == ([""], [])


@pytest.mark.parametrize("column", ["k", "n", "trajectories", "expert_return", "total_timesteps"])
def test_numbers_that_do_not_apply_are_empty(tmp_path: Path, column: str) -> None:
    written(tmp_path, row(**{column: None}))
    rows, left_out = load_results([tmp_path])
    assert rows[column].isna().all()
    assert left_out == []


def test_a_performance_without_a_scale_is_kept(tmp_path: Path) -> None:
    level = {"random_return": -200.0, "expert_return_measured": -200.0}
    written(tmp_path, row(performance=float("nan"), **level))
    rows, left_out = load_results([tmp_path])
    assert (len(rows), left_out) == (1, [])


def test_a_performance_with_a_scale_must_not_be_empty(tmp_path: Path) -> None:
    written(tmp_path, row(performance=float("nan")))
    said = "results.csv: line 2: seed 0: performance is '', must be a finite number"
    assert only_fault(tmp_path) == said


@pytest.mark.parametrize(
    ("column", "text", "allowed"),
    [
        ("seed", "abc", "a whole number from 0"),
        ("seed", "-1", "a whole number from 0"),
        ("seed", "0.5", "a whole number from 0"),
        ("seed", "", "a whole number from 0"),
        ("epochs", "150.5", "a whole number from 0"),
        ("epochs", "1e300", "a whole number from 0"),
        ("trajectories", "some", "a whole number from 0"),
        ("k", "nan", "a finite number"),
        ("aer", "", "a finite number"),
        ("aer", "nan", "a finite number"),
        ("aer", "inf", "a finite number"),
        ("aer_last", "-inf", "a finite number"),
        ("performance", "inf", "a finite number"),
        ("env", "", "1 to 10,000 characters"),
        ("run_id", "", "1 to 10,000 characters"),
    ],
)
def test_only_a_row_with_an_invalid_value_is_left_out(
    tmp_path: Path, column: str, text: str, allowed: str
) -> None:
    lines = [{key: str(value or 0) for key, value in dataclasses.asdict(ROW).items()}] * 2
    lines[0] = lines[0] | {column: text}
    lines[1] = lines[1] | {"seed": "1"}
    pd.DataFrame(lines).to_csv(tmp_path / "results.csv", index=False)
    rows, [said] = load_results([tmp_path])
    assert rows["seed"].tolist() == [1]
    assert said.startswith(f"{tmp_path}/results.csv: line 2: ")
    assert re.search(rf"{column} is {text!r}, must (be|have) {allowed}$", said)
    assert (": seed 0: " in said) == (column != "seed")


@pytest.mark.parametrize("lost", [1, 5, 60])
def test_a_file_that_ends_within_its_last_line_keeps_the_others(tmp_path: Path, lost: int) -> None:
    file = written(tmp_path, ROW, row(seed=1))
    file.write_bytes(file.read_bytes()[:-lost])
    rows, _ = load_results([tmp_path])
    assert rows["seed"].tolist() == [0]
    assert only_fault(tmp_path) == "results.csv: line 3: is incomplete: the file ends within it"


@pytest.mark.parametrize("closed_later", [False, True])
def test_a_file_with_an_unclosed_quote_is_left_out_alone(
    tmp_path: Path, closed_later: bool
) -> None:
    file = written(tmp_path / "a", row(variant='a="b"'), row(seed=1), row(seed=2, variant='"'))
    text = file.read_text().replace('""b"""', '""b""', 1)
    file.write_text(text if closed_later else text.replace('""""', "", 1))
    written(tmp_path / "b", row(seed=3))
    assert load_results([tmp_path])[0]["seed"].tolist() == [3]
    assert only_fault(tmp_path) == "a/results.csv: has a line with an unclosed quotation mark"


def test_quoted_text_comes_back(tmp_path: Path) -> None:
    variants = ['a="b"', "a=[1,2]", '"', '""', ","]
    written(tmp_path, *(row(seed=seed, variant=text) for seed, text in enumerate(variants)))
    rows, left_out = load_results([tmp_path])
    assert (rows["variant"].tolist(), left_out) == (variants, [])


@pytest.mark.parametrize("others", [0, 1])
@pytest.mark.parametrize("columns", [0, 1, 2, 24, 26, 27, 61])
def test_only_a_line_with_another_number_of_columns_is_left_out(
    tmp_path: Path, columns: int, others: int
) -> None:
    file = written(tmp_path, *(row(seed=seed) for seed in range(1 + others)))
    header, first, *rest = file.read_text().splitlines()
    first = ",".join([*first.split(","), *["1"] * 60][:columns])
    file.write_text("\n".join([header, first, *rest, ""]))
    rows, [said] = load_results([tmp_path])
    assert rows["seed"].tolist() == [1] * others
    why = "line 2: does not have 25 columns" if columns or others else "has no rows"
    assert said == f"{file}: {why}"


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty"),
        (b"\n", "is empty"),
        (b"what,ever\n1,2\n", "missing columns: 'run_id', 'env', 'method' and 22 more"),
        (b"\xff\xfe\x00", "is not UTF-8 text"),
        (bytes(range(256)), "is not UTF-8 text"),
        (b"\x00" * 9, "missing columns: 'run_id', 'env', 'method' and 22 more"),
        (b'"' * 200_000, "missing columns: 'run_id', 'env', 'method' and 22 more"),
    ],
)
def test_a_file_that_holds_no_rows_is_named(tmp_path: Path, content: bytes, why: str) -> None:
    (tmp_path / "results.csv").write_bytes(content)
    assert only_fault(tmp_path) == f"results.csv: {why}"


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (",aer,", ",reward,", "missing columns: 'aer'"),
        (",commit", ",commit,color", "unknown columns: 'color'"),
        (",commit", ",commit,env", "repeated columns: 'env'"),
    ],
)
def test_a_file_of_another_schema_is_left_out(tmp_path: Path, old: str, new: str, why: str) -> None:
    file = written(tmp_path)
    file.write_text(file.read_text().replace(old, new, 1))
    assert only_fault(tmp_path) == f"results.csv: {why}"


def test_a_file_without_rows_is_named(tmp_path: Path) -> None:
    file = written(tmp_path)
    file.write_text(file.read_text().splitlines(keepends=True)[0])
    assert only_fault(tmp_path) == "results.csv: has no rows"


@pytest.mark.parametrize("bad", ["folder", "pipe", "broken link"])
def test_what_is_not_a_file_is_named(tmp_path: Path, bad: str) -> None:
    path = tmp_path / "results.csv"
    if bad == "folder":
        path.mkdir()
    elif bad == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("nowhere")
    assert only_fault(tmp_path) == "results.csv: is not a file"


def test_a_file_that_may_not_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    written(tmp_path)
    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert only_fault(tmp_path) == "results.csv: cannot be read (Permission denied)"


def test_only_a_row_with_an_enormous_value_is_left_out(tmp_path: Path) -> None:
    written(tmp_path, row(commit="x" * 1_000_000), row(seed=1))
    assert load_results([tmp_path])[0]["seed"].tolist() == [1]
    assert len(only_fault(tmp_path)) < 120


def test_the_csv_files_of_spreadsheets_can_be_read(tmp_path: Path) -> None:
    file = written(tmp_path)
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    rows, left_out = load_results([tmp_path])
    assert (rows["commit"].tolist(), left_out) == ([ROW.commit], [])


def test_a_repeated_seed_of_a_file_counts_once(tmp_path: Path) -> None:
    written(tmp_path, ROW, row(seed=1), row(aer=-90.0))
    assert load_results([tmp_path])[0]["aer"].tolist() == [ROW.aer, ROW.aer]
    assert only_fault(tmp_path) == "results.csv: line 4: seed 0: repeats an earlier line"


def test_the_newest_rows_of_a_run_count_and_the_older_ones_are_named(tmp_path: Path) -> None:
    for folder, aer, when in (("a", -100.0, 2_000), ("a-2", -90.0, 1_000)):
        file = written(tmp_path / folder, row(aer=aer), row(aer=aer, seed=1))
        os.utime(file, (when, when))
    assert load_results([tmp_path])[0]["aer"].tolist() == [-100.0, -100.0]
    newer = tmp_path / "a/results.csv"
    assert (
        only_fault(tmp_path) == f"a-2/results.csv: seeds 0, 1: replaced by a newer run in {newer}"
    )


def test_an_invalid_row_does_not_replace_an_older_valid_one(tmp_path: Path) -> None:
    for folder, aer, when in (("old", -100.0, 1_000), ("new", float("inf"), 2_000)):
        os.utime(written(tmp_path / folder, row(aer=aer)), (when, when))
    assert load_results([tmp_path])[0]["aer"].tolist() == [-100.0]


def with_curve(folder: Path, text: str, *rows: Row) -> pd.DataFrame:
    """Return the rows of a run whose curve.csv has the given text."""
    written(folder, *rows)
    (folder / "curve.csv").write_text(text)
    return load_results([folder])[0]


def test_the_points_of_a_run_come_back(tmp_path: Path) -> None:
    points = [CurvePoint(0, 5, 9, -2.5, {"loss": 0.5}), CurvePoint(1, 5, 10, -2.25, {})]
    written(tmp_path, ROW, row(seed=1))
    write_csv(tmp_path / "curve.csv", points)
    curves, left_out = load_curves(load_results([tmp_path])[0])
    assert curves.columns.tolist() == ["run_id", "seed", "epoch", "samples", "aer"]
    assert curves.to_numpy().tolist() == [
        [ROW.run_id, 0, 5, 9, -2.5],
        [ROW.run_id, 1, 5, 10, -2.25],
    ]
    assert left_out == []


def test_points_of_seeds_without_a_row_are_ignored(tmp_path: Path) -> None:
    rows = with_curve(tmp_path, "seed,epoch,samples,aer\n0,5,9,-2\n1,5,9,-2\n")
    assert load_curves(rows)[0]["seed"].tolist() == [0]


def test_the_curve_is_read_from_the_folder_of_the_rows(tmp_path: Path) -> None:
    for folder, aer, when in (("new", -1, 2_000), ("old", -2, 1_000)):
        with_curve(tmp_path / folder, f"seed,epoch,samples,aer\n0,5,9,{aer}\n")
        os.utime(tmp_path / folder / "results.csv", (when, when))
    assert load_curves(load_results([tmp_path])[0])[0]["aer"].tolist() == [-1]


@pytest.mark.parametrize(("method", "named"), [("ril", True), ("random", False), ("expert", False)])
def test_a_missing_curve_is_named_if_the_method_learns(
    tmp_path: Path, method: str, named: bool
) -> None:
    written(tmp_path, row(method=method))
    curves, left_out = load_curves(load_results([tmp_path])[0])
    assert curves.empty
    assert left_out == ([f"{tmp_path}/curve.csv: does not exist"] if named else [])


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("0,10,18", "line 3: does not have 4 columns"),
        ("0,10,18,", "line 3: seed 0: aer is '', must be a finite number"),
        (
            "0,10,18.5,-1",
            "line 3: seed 0: samples is '18.5', must be a whole number from 0",
        ),
        ("0,5,18,-1", "line 3: seed 0: repeats an epoch of an earlier line"),
    ],
)
def test_only_an_invalid_point_is_left_out(tmp_path: Path, line: str, why: str) -> None:
    rows = with_curve(tmp_path, f"seed,epoch,samples,aer\n0,5,9,-2\n{line}\n0,15,27,-1\n")
    curves, left_out = load_curves(rows)
    assert curves["epoch"].tolist() == [5, 15]
    assert left_out == [f"{tmp_path}/curve.csv: {why}"]


def test_many_points_with_the_same_fault_are_one_message(tmp_path: Path) -> None:
    lines = "".join(f"0,{epoch},9,nan\n" for epoch in range(50)) + "0,50,9,-1\n"
    _, left_out = load_curves(with_curve(tmp_path, "seed,epoch,samples,aer\n" + lines))
    why = "seed 0: aer is 'nan', must be a finite number"
    assert left_out == [f"{tmp_path}/curve.csv: line 2, 3, 4 …: {why}"]


def test_a_seed_without_points_is_named(tmp_path: Path) -> None:
    rows = with_curve(tmp_path, "seed,epoch,samples,aer\n0,5,9,-2\n", ROW, row(seed=1))
    _, left_out = load_curves(rows)
    assert left_out == [f"{tmp_path}/curve.csv: seed 1: has no usable point"]


def test_ten_thousand_rows_load_in_seconds(tmp_path: Path) -> None:
    for run in range(100):
        rows = [row(run_id=f"run{run}", seed=seed) for seed in range(100)]
        written(tmp_path / str(run), *rows)
    started = time.process_time()
    rows, _ = load_results([tmp_path])
    assert len(rows) == 10_000
    assert time.process_time() - started < 5
