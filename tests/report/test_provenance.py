from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.made_rows import rows

from ril.report.provenance import Run, runs

CONTENT = {
    "command": "ril-run env=mountaincar method=ril",
    "started": "2026-11-22T13:56:25+00:00",
    "python": "3.11.7",
    "versions": {"torch": "2.13.0", "numpy": "2.4.6", "gymnasium": "1.4.0", "pandas": "3.1.1"},
    "processor": "A processor",
    "cores": 2,
}


def run(folder: Path, content: bytes | None, *cells: dict[str, object]) -> Run:
    """The one run of some rows with that `provenance.json`."""
    if content is not None:
        (folder / "provenance.json").write_bytes(content)
    made = rows(*(cells or ({"commit": "0123456789ab"},)))
    [found] = runs(made.assign(folder=[folder] * len(made)))
    return found


def test_what_a_run_is(tmp_path: Path) -> None:
    assert run(tmp_path, json.dumps(CONTENT).encode()) == Run(
        "a",
        "mountaincar",
        "ril",
        "",
        "0",
        "0123456789ab",
        "ril-run env=mountaincar method=ril",
        "2026-11-22 13:56",
        "Python 3.11.7, torch 2.13.0, numpy 2.4.6, gymnasium 1.4.0",
        "A processor, 2 cores",
    )


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    assert run(tmp_path, None).fault == "no provenance.json"


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff\xfe", b"[1]", b"null", b'{"versions": 1}', b"[" * 100_000],
)
def test_a_broken_file_is_said(tmp_path: Path, content: bytes) -> None:
    assert run(tmp_path, content).fault == "provenance.json cannot be read"


def test_a_folder_in_its_place_is_said(tmp_path: Path) -> None:
    (tmp_path / "provenance.json").mkdir()
    assert run(tmp_path, None).fault == "provenance.json cannot be read"


@pytest.mark.parametrize("content", [b"{}", b'{"processor": 1, "cores": [2], "started": null}'])
def test_what_a_file_lacks_is_left_empty(tmp_path: Path, content: bytes) -> None:
    found = run(tmp_path, content)
    assert (found.fault, found.command, found.software) == ("", "", "")


@pytest.mark.parametrize(
    ("seeds", "says"), [((0,), "0"), ((2, 0, 1), "0–2"), ((0, 1, 3, 7, 8), "0–1, 3, 7–8")]
)
def test_seeds_in_words(tmp_path: Path, seeds: tuple[int, ...], says: str) -> None:
    assert run(tmp_path, None, *({"seed": seed} for seed in seeds)).seeds == says


def test_runs_are_those_of_the_rows_in_their_order() -> None:
    found = runs(rows({"run_id": "b"}, {"run_id": "a"}, {"run_id": "b", "seed": 1}))
    assert [(each.run_id, each.seeds) for each in found] == [("b", "0–1"), ("a", "0")]


def test_no_rows_are_no_runs() -> None:
    assert runs(rows({}).iloc[:0]) == []
