"""Configurations as trees: their leaves, one leaf changed, and what a kept file held."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import reduce
from typing import Any

from omegaconf import OmegaConf

from helpers.runs import composed
from ril.cli.configuration import from_hydra
from ril.config.schema import Config
from ril.methods.registry import spec

#: The four environments of the paper.
PAPERS_ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
#: An environment of a user's own.
GYM = ("env=gym", "env.id=MountainCar-v0")


def parts(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All dataclasses of a configuration by full key, itself first."""
    yield key, node
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        if dataclasses.is_dataclass(value):
            yield from parts(value, f"{key}.{field.name}" if key else field.name)


def at(config: Any, key: str) -> Any:
    """The value of a full key."""
    return reduce(getattr, key.split("."), config)


def put(config: Config, key: str, value: Any) -> Any:
    """Change a value in place, unchecked; return what it was."""
    parent, _, name = key.rpartition(".")
    part = at(config, parent) if parent else config
    before = getattr(part, name)
    setattr(part, name, value)
    return before


def checked(method: str, key: str, value: Any) -> Config:
    """The default configuration of a method with one value given, as `ril-run` checks it."""
    given = composed(f"method={method}").copy()
    OmegaConf.update(given, key, value, force_add=True)
    return from_hydra(given)


def of_file(values: dict[str, Any]) -> Config:
    """The configuration that a `config.yaml` holds, which must have every key and no other."""
    config = Config()
    config.method = spec(values["method"]["name"]).config()
    _fill(config, values)
    return config


def _fill(node: Any, values: dict[str, Any]) -> None:
    assert [field.name for field in dataclasses.fields(node)] == list(values)
    for name, value in values.items():
        if dataclasses.is_dataclass(getattr(node, name)):
            _fill(getattr(node, name), value)
        else:
            setattr(node, name, value)
