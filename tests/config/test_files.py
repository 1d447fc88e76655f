"""The files of `conf/`, and that each method has one place for each of its facts."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from helpers.runs import composed, leaves
from omegaconf import OmegaConf

from ril.io.paths import config_folder
from ril.methods.registry import names, spec

FILES = sorted(config_folder().rglob("*.yaml"))
METHODS = Path(__file__).parents[2] / "ril" / "methods"
pytestmark = pytest.mark.quick


def test_there_are_at_most_sixty() -> None:
    assert len(FILES) <= 60


def test_none_only_points_at_others() -> None:
    contents = {file: yaml.safe_load(file.read_text("utf-8")) for file in FILES}
    assert [file.name for file, content in contents.items() if set(content) == {"defaults"}] == []


def test_methods_repeat_no_three_values_in_a_row() -> None:
    blocks: dict[str, set[str]] = {}
    for file in [*config_folder().glob("method/*.yaml"), *config_folder().glob("base/*.yaml")]:
        content = yaml.safe_load(file.read_text("utf-8"))
        content.pop("defaults", None)
        values = list(leaves(content).items())
        for start in range(len(values) - 2):
            blocks.setdefault(str(values[start : start + 3]), set()).add(file.stem)
    assert {block: files for block, files in blocks.items() if len(files) > 1} == {}


@pytest.mark.parametrize("name", names())
def test_a_methods_yaml_has_the_keys_of_its_dataclass_and_no_other(name: str) -> None:
    given = OmegaConf.to_container(composed(f"method={name}").method)
    assert leaves(given).keys() == leaves(spec(name).config()).keys()


def test_each_method_has_a_yaml_and_a_python_file_of_its_name() -> None:
    with_spec = {
        file.stem
        for file in METHODS.glob("*.py")
        if re.search(r"^SPEC = ", file.read_text("utf-8"), re.MULTILINE)
    }
    assert with_spec == set(names())


@pytest.mark.parametrize("name", names())
def test_a_spec_names_its_method_and_a_budget_that_exists(name: str) -> None:
    found = spec(name)
    assert found.name == composed(f"method={name}").method.name == name
    assert (found.build is None) is (found.measure is not None) is (found.budget == "")
    assert not found.budget or hasattr(found.config(), found.budget)
