from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest

from ril.run import provenance


def test_a_command_can_be_given_again(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["-m", "seeds=[0],[1]", "demonstrations=my file.npz"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/ril-run", *arguments])
    assert shlex.split(provenance.command()) == ["ril-run", *arguments]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Code of which a digest is taken."""
    for name in ("training.py", "methods/ril.py", "display.py", "report/cli.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1\n")
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("training.py", True),
        ("methods/ril.py", True),
        ("display.py", False),
        ("report/a.py", False),
    ],
)
def test_an_origin_knows_the_code_that_numbers_come_from(
    package: Path, name: str, counts: bool
) -> None:
    before = provenance.origin("0")["code"]
    (package / name).write_text("2\n")
    assert (provenance.origin("0")["code"] != before) is counts


def test_an_origin_knows_the_names_of_its_files(package: Path) -> None:
    before = provenance.origin("0")["code"]
    (package / "training.py").rename(package / "trained.py")
    assert provenance.origin("0")["code"] != before
