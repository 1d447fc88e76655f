"""The report reads rows and saved policies; it runs nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ril.report

FILES = sorted(Path(ril.report.__file__).parent.rglob("*.py"))


def imported(file: Path) -> set[str]:
    """All modules that a file imports."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return names | {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_file_imports_a_method_a_run_or_a_command(file: Path) -> None:
    above = ("ril.methods", "ril.run", "ril.cli", "ril.config", "ril.task", "ril.experts")
    assert not [name for name in imported(file) if name.startswith(above)]


def test_the_papers_number_for_a_run_is_cheap_to_import() -> None:
    heavy = "{'torch', 'scipy', 'matplotlib', 'jinja2', 'gymnasium'}"
    code = f"import ril.report.beside, sys; sys.exit(str({heavy} & set(sys.modules) or ''))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""
