from __future__ import annotations

import io
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states

from ril.io.errors import UserError
from ril.run.checkpoints import load_checkpoint, save_checkpoint
from ril.run.provenance import origin

ORIGIN = {"run_id": "0123456789", "ril": "1.0", "code": "abc", "torch": "2.0"}
STATE: dict[str, Any] = {"weights": torch.arange(9.0), "epoch": 3, "names": ["a", "b"]}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path / "checkpoint.pt", ORIGIN, STATE)
    return tmp_path / "checkpoint.pt"


def refusal(path: Path, origin: dict[str, str] = ORIGIN) -> str:
    with pytest.raises(UserError) as refused:
        load_checkpoint(path, origin)
    said = str(refused.value)
    assert said.startswith(f"{path}: ")
    assert said.endswith("delete it, or give resume=false, to start again")
    assert "\n" not in said
    return said


def test_what_was_saved_is_loaded(path: Path) -> None:
    assert_equal_states(load_checkpoint(path, ORIGIN), STATE)


@pytest.mark.parametrize("share", np.linspace(0, 0.999, 9))
def test_a_torn_one_is_refused(path: Path, share: float) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "cannot be read" in refusal(path)


@pytest.mark.parametrize("share", np.linspace(0, 1, 9))
def test_one_with_a_single_wrong_bit_is_refused(path: Path, share: float) -> None:
    content = bytearray(path.read_bytes())
    content[int(share * (len(content) - 1))] ^= 1
    path.write_bytes(content)
    assert "cannot be read" in refusal(path)


def saved_by_torch() -> bytes:
    buffer = io.BytesIO()
    torch.save({"method": {}, "record": {}, "seconds": 0.0}, buffer)
    return buffer.getvalue()


@pytest.mark.parametrize("content", [b"", b"garbage", bytes(1000), saved_by_torch()])
def test_another_file_is_refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert "not a checkpoint of ril" in refusal(path)


def test_one_of_another_version_is_refused(path: Path) -> None:
    head, _, rest = path.read_bytes().partition(b"\n")
    path.write_bytes(head.rstrip(b"0123456789") + b"99\n" + rest)
    assert "written by another version of ril" in refusal(path)


@pytest.mark.parametrize("key", ORIGIN)
def test_one_of_another_run_or_code_names_what_differs(path: Path, key: str) -> None:
    said = refusal(path, ORIGIN | {key: "other"})
    assert f"({key} {ORIGIN[key]}; now {key} other)" in said


def test_an_origin_has_the_run_the_code_and_what_it_computes_with(compose: Any) -> None:
    found = origin("0123456789", compose())
    assert list(found) == [
        *("run_id", "ril", "code", "digits", "torch", "numpy", "gymnasium", "stable-baselines3")
    ]
    assert found["torch"] == version("torch")


class Bomb:
    """What leaves a file when it is unpickled."""

    def __init__(self, leaves: Path) -> None:
        self.leaves = leaves

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.leaves),)


def test_one_that_would_run_code_does_not(path: Path, tmp_path: Path) -> None:
    bomb = tmp_path / "exploded"
    save_checkpoint(path, ORIGIN, {"weights": Bomb(bomb)})  # its sum is right
    assert "cannot be read (UnpicklingError)" in refusal(path)
    assert not bomb.exists()


def test_the_bomb_would_go_off(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    torch.save(Bomb(tmp_path / "exploded"), buffer)
    buffer.seek(0)
    torch.load(buffer, weights_only=False)
    assert (tmp_path / "exploded").exists()
