"""The pages have the form that readers and `CONTRIBUTING.md` rely on."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
METHODS = sorted(file.stem for file in (ROOT / "conf" / "method").glob("*.yaml"))
SECTIONS = [
    "Command",
    "What it sees",
    "How its budget counts",
    "Settings by environment",
    "Deviations",
    "Results",
]


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_a_page_with_the_same_sections(name: str) -> None:
    page = (ROOT / "docs" / "methods" / f"{name}.md").read_text(encoding="utf-8")
    assert page.startswith(f"# `method={name}`")
    found = re.findall(r"^## (.*)$", page, re.MULTILINE)
    assert [section for section in found if section in SECTIONS] == SECTIONS


def test_the_readme_stays_short() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 110


def test_every_page_has_a_place_in_the_navigation() -> None:
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"[\w/]+\.md", yaml.dump(yaml.safe_load(text)["nav"])))
    added = {f"methods/{name}.md" for name in METHODS}  # by scripts/docs_navigation.py
    assert pages - listed - added == set()
