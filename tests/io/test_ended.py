from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from ril.io.ended import FILE, Ended, load_ended, write_ended

RUN = Ended(
    *("0123456789", "cartpole", "iupe", "method.episodes=2", [3, 7]),
    *(None, None, 1, -140.0, "ended: a loss is NaN"),
)
WITHOUT_SEEDS = json.dumps(asdict(RUN) | {"seeds": None}).encode()


def test_what_is_written_is_read(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    write_ended(tmp_path / "run", RUN)
    assert load_ended([tmp_path]) == ([RUN], [])
    assert str(RUN) == (
        "env=cartpole method=iupe method.episodes=2 seeds=[3, 7]: ended: a loss is NaN"
    )


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"{}", b"\xff", WITHOUT_SEEDS, b'{"run_id": "a"}']
)
def test_what_cannot_be_read_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    assert load_ended([tmp_path]) == ([], [f"{tmp_path / FILE}: cannot be read"])


def test_a_missing_folder_has_no_ended_run(tmp_path: Path) -> None:
    assert load_ended([tmp_path / "none"]) == ([], [])
