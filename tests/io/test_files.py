"""Files and folders that outlive a crash of the machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ril.io import files
from ril.io.files import make_folder


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The inodes of what was fsynced, in order."""
    inodes: list[int] = []
    monkeypatch.setattr(files.os, "fsync", lambda fd: inodes.append(os.fstat(fd).st_ino))
    return inodes


def test_the_names_of_new_folders_are_fsynced_in_the_folders_above_them(
    tmp_path: Path, synced: list[int]
) -> None:
    make_folder(tmp_path / "new" / "below")
    assert (tmp_path / "new" / "below").is_dir()
    assert synced == [path.stat().st_ino for path in (tmp_path / "new", tmp_path)]


def test_a_folder_that_exists_is_made_only_where_it_may(tmp_path: Path, synced: list[int]) -> None:
    make_folder(tmp_path, exist_ok=True)
    assert synced == []
    with pytest.raises(FileExistsError):
        make_folder(tmp_path)
