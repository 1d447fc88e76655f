"""The pages have the form that readers and `CONTRIBUTING.md` rely on."""

from __future__ import annotations

import re
from functools import reduce
from pathlib import Path
from typing import Any

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


COLUMNS = {
    "CartPole": ("env=cartpole",),
    "Acrobot": ("env=acrobot",),
    "MountainCar": ("env=mountaincar",),
    "LunarLander": ("env=lunarlander",),
    "`env=gym`": ("env=gym", "env.id=MountainCar-v0"),
}


def settings(name: str) -> list[tuple[str, str, str]]:
    """Column, full key and value of each entry of a page's table of settings, as text."""
    page = (ROOT / "docs" / "methods" / f"{name}.md").read_text(encoding="utf-8")
    section = page.partition("## Settings by environment")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    found = []
    for first, *cells in table[1:]:
        keys = re.findall(r"`([\w.]+)`", first)
        if not keys or not keys[0].startswith(("method.", "env.", "evaluation.")):
            continue
        parent = keys[0].rpartition(".")[0]
        full = [keys[0], *(f"{parent}.{key}" for key in keys[1:] if "=" not in key)]
        row = dict(zip(table[0][1:], cells, strict=True))
        for column, cell in row.items():
            text = re.sub(r"\(\w+\)|[*\[\]]", "", cell or row.get("default", "")).strip()
            values = text.split(", ")
            for label in re.sub(r"\(\w+\)", "", column).split(", "):
                if label.strip() in COLUMNS:
                    of_keys = zip(full, values, strict=True) if len(full) > 1 else [(full[0], text)]
                    found += [(label.strip(), key, value) for key, value in of_keys]
    return found


def as_text(value: object) -> str:
    """A value as the pages write it, without regard to the form of numbers."""
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def same(text: str, value: object) -> bool:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(text.replace(",", "")) == value
    return text == as_text(value)


@pytest.mark.parametrize("name", METHODS)
def test_settings_by_environment_are_those_of_the_configuration(name: str, compose: Any) -> None:
    wrong = []
    for column, key, text in settings(name):
        value = reduce(getattr, key.split("."), compose(*COLUMNS[column], f"method={name}"))
        if not same(text, value):
            wrong.append(f"{key} on {column}: {text}, but {value}")
    assert wrong == []


def test_the_pages_have_settings_to_compare() -> None:
    assert sum(len(settings(name)) for name in METHODS) > 200
