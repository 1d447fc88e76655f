from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pandas as pd
import pytest

from ril.errors import UserError
from ril.files import write_atomically
from ril.results import CurvePoint, Row, load_results, write_csv

ROW = Row(
    run_id="0123456789",
    env="mountaincar",
    method="ril",
    variant="method.q_learning.loss=mse",
    seed=0,
    k=2.0,
    n=150.0,
    trajectories=1,
    expert_return=None,
    epochs=150,
    total_timesteps=2_000_000,
    best_epoch=95,
    aer=-105.25,
    aer_std=6.5,
    aer_last=-110.0,
    performance=1.25,
    env_samples=16000,
    expert_samples=15900,
    pre_samples=15000,
    samples_to_best=20000,
    random_return=-200.0,
    expert_return_measured=-106.0,
    wall_seconds=61.5,
    commit="12345e678901",
)


def row(**changes: object) -> Row:
    return dataclasses.replace(ROW, **changes)


def test_a_file_is_written_whole(tmp_path: Path) -> None:
    write_atomically(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


def test_a_file_takes_the_place_of_the_old(tmp_path: Path) -> None:
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
        raise OSError("no space left on device")

    write_atomically(tmp_path / "file", b"old")
    if step == "fsync":
        monkeypatch.setattr(os, "fsync", interrupt)
    else:
        monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(OSError, match="no space left"):
        write_atomically(tmp_path / "file", b"new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"file": b"old"}


def test_rows_come_back(tmp_path: Path) -> None:
    write_csv(tmp_path / "results.csv", [ROW])
    found = load_results([tmp_path]).iloc[0].to_dict()
    expected = dataclasses.asdict(ROW)
    assert pd.isna(found.pop("expert_return"))
    assert expected.pop("expert_return") is None
    assert found == expected


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


def test_results_are_those_of_all_folders_below(tmp_path: Path) -> None:
    for number, folder in enumerate(["one/a", "one/b", "two/c/d"]):
        (tmp_path / folder).mkdir(parents=True)
        write_csv(tmp_path / folder / "results.csv", [row(run_id=f"run{number}", seed=number)])
    found = load_results([tmp_path / "one", tmp_path / "two"])
    assert found["seed"].tolist() == [0, 1, 2]


def test_no_results_are_the_empty_table_with_its_columns(tmp_path: Path) -> None:
    found = load_results([tmp_path])
    assert found.empty
    assert found.columns.tolist() == [field.name for field in dataclasses.fields(Row)]


def test_the_same_row_in_two_folders_counts_once(tmp_path: Path) -> None:
    for folder in ("here", "copy"):
        (tmp_path / folder).mkdir()
        write_csv(tmp_path / folder / "results.csv", [ROW, row(seed=1)])
    assert load_results([tmp_path])["seed"].tolist() == [0, 1]


@pytest.mark.parametrize("identifier", ["0123456789", "12345e6789", "9999999e99", "abcdef0123"])
def test_run_ids_stay_text(tmp_path: Path, identifier: str) -> None:
    write_csv(tmp_path / "results.csv", [row(run_id=identifier)])
    assert load_results([tmp_path])["run_id"].tolist() == [identifier]


def test_a_row_without_a_variant_is_of_the_method_as_it_comes(tmp_path: Path) -> None:
    write_csv(tmp_path / "results.csv", [row(variant="")])
    assert load_results([tmp_path])["variant"].tolist() == [""]


def test_columns_of_older_rows_are_filled_up(tmp_path: Path) -> None:
    (tmp_path / "results.csv").write_text("run_id,seed,aer\nabc,0,-100.5\n")
    found = load_results([tmp_path])
    assert found.columns.tolist() == [field.name for field in dataclasses.fields(Row)]
    assert found["aer"].tolist() == [-100.5]


def test_of_a_cell_run_twice_the_newest_rows_count(tmp_path: Path) -> None:
    for folder, aer, written in (("a", -100.0, 2_000), ("a-2", -90.0, 1_000)):
        (tmp_path / folder).mkdir()
        write_csv(tmp_path / folder / "results.csv", [row(aer=aer)])
        os.utime(tmp_path / folder / "results.csv", (written, written))
    assert load_results([tmp_path])["aer"].tolist() == [-100.0]


@pytest.mark.parametrize("content", [b"", b"what,ever\n1,2\n", b"\xff\xfe\x00"])
def test_a_file_without_rows_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "results.csv").write_bytes(content)
    with pytest.raises(UserError, match=r"results\.csv: "):
        load_results([tmp_path])
