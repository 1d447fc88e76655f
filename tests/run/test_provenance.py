"""Where a run's numbers come from."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from ril.run import provenance


def test_a_command_is_quoted_for_a_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["-m", "seeds=[0],[1]", "demonstrations=my file.npz"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/ril-run", *arguments])
    assert shlex.split(provenance.command()) == ["ril-run", *arguments]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of four files, in place of ril's own."""
    for name in ("task.py", "methods/ril.py", "cli/display.py", "report/page.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1\n")
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("task.py", True),
        ("methods/ril.py", True),
        ("cli/display.py", False),
        ("report/page.py", False),
    ],
)
def test_an_origin_changes_with_the_code_that_can_change_numbers(
    package: Path, name: str, counts: bool, compose: Any
) -> None:
    before = provenance.origin("0", compose())["code"]
    (package / name).write_text("2\n")
    assert (provenance.origin("0", compose())["code"] != before) is counts


def test_an_origin_changes_with_the_names_of_files(package: Path, compose: Any) -> None:
    before = provenance.origin("0", compose())["code"]
    (package / "task.py").rename(package / "tasks.py")
    assert provenance.origin("0", compose())["code"] != before
