"""The column `variant`: the keys with non-default values."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig, OmegaConf

from ril.cli.configuration import from_hydra
from ril.config.schema import Config
from ril.demonstrations.files import are_shipped, content_hash
from ril.io.errors import UserError
from ril.io.paths import config_folder

_SECTIONS = ("env", "method", "evaluation")
#: The column `env`, a key that changes no number, and budgets, which have columns.
_ELSEWHERE = {"env.name", "env.vectorized", "method.epochs", "method.total_timesteps"}


def variant(config: Config, choice: str, folders: Sequence[str]) -> str:
    """Return the keys whose values differ from the method's defaults on the environment.

    The defaults of an environment that ril ships are ril's own: a row of that name is of the
    paper's cell only if no value differs from them, whichever files the values come from.

    Args:
        config: the run's configuration.
        choice: the value of `env=`, whose file has the defaults of an environment of the user's.
        folders: the user's own configuration folders.

    Returns:
        `key=value` of each, separated by spaces; "" if there are none.

    Raises:
        UserError: the demonstrations cannot be read.
    """
    if config.env.name in _shipped_environments():
        usual = default_config(config.env.name, config.method.name)
    else:
        usual = default_config(choice, config.method.name, folders)
    has_no_id = OmegaConf.is_missing(usual.env, "id")  # env=gym
    before, given = _values(_completed(usual, config)), _values(config)
    if has_no_id and config.env.id != config.env.name:
        del before["env.id"]
    changed = [key for key in given if _differ(key, given, before)]
    texts = [f"{key}={_text(given[key])}" for key in changed if key not in _ELSEWHERE]
    texts += [f"~{key}" for key in before if key not in given]
    if config.demonstrations is not None and not are_shipped(config):
        path = Path(config.demonstrations)
        texts.append(f"demonstrations={path.name}@{content_hash(path)[:8]}")
    return " ".join(texts)


def default_config(env: str, method: str, folders: Sequence[str] = ()) -> DictConfig:
    """Compose the default configuration of a method on an environment.

    Args:
        env: the value of `env=` on the command line.
        method: the value of `method=`.
        folders: the user's own configuration folders.
    """
    overrides = [f"env={env}", f"method={method}"]
    if folders:
        quoted = (QuotedString(f"file://{each}", Quote.double) for each in folders)
        overrides.append(f"hydra.searchpath=[{','.join(each.with_quotes() for each in quoted)}]")
    running = GlobalHydra.instance().hydra  # of this command, whose folders may be the user's
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            composed: DictConfig = hydra.compose("config", overrides)
            return composed
    finally:
        GlobalHydra.instance().hydra = running


def own_folders(sources: Iterable[Any]) -> list[str]:
    """Return the user's own folders among Hydra's sources of configuration."""
    return [path for path in _folders(sources) if path != str(config_folder())]


def refuse_shadowed(sources: Iterable[Any]) -> None:
    """Refuse a file of the user's own that Hydra would ignore, since ril has one of its name.

    Args:
        sources: Hydra's sources of configuration.

    Raises:
        UserError: there is such a file, with another content.
    """
    folders = [Path(folder) for folder in _folders(sources)]
    for first, second in itertools.combinations(folders, 2):
        for file in first.rglob("*.yaml"):
            other = second / file.relative_to(first)
            if other.is_file() and other.read_bytes() != file.read_bytes():
                raise UserError(f"{other}: would be ignored for {file}; give it another name")


def _folders(sources: Iterable[Any]) -> list[str]:
    return [source.path for source in sources if source.schema == "file"]


def _shipped_environments() -> set[str]:
    return {file.stem for file in (config_folder() / "env").glob("*.yaml")} - {"gym"}


def _completed(usual: DictConfig, config: Config) -> Config:
    """Return a default as a `Config`, with the run's name and what has no default."""
    given = OmegaConf.create(asdict(config))
    for key in {"env.name", *OmegaConf.missing_keys(usual)}:
        OmegaConf.update(usual, key, OmegaConf.select(given, key), force_add=True)
    return from_hydra(usual)


def _values(config: Config) -> dict[str, Any]:
    """Return the values on which a row's numbers depend, by full key; a list is one value."""
    values: dict[str, Any] = {}

    def collect(node: Any, key: str) -> None:
        if isinstance(node, dict) and node:
            for name, child in node.items():
                collect(child, f"{key}.{name}")
        elif key != "env.kwargs":  # no arguments
            values[key] = node

    for name, section in asdict(config).items():
        if name in _SECTIONS:
            collect(section, name)
    return values


def _differ(key: str, given: dict[str, Any], before: dict[str, Any]) -> bool:
    # As in the run_id: 1, 1.0 and true are equal in Python.
    return key not in before or json.dumps(given[key]) != json.dumps(before[key])


def _text(value: Any) -> str:
    """Return a value as text; one that looks like another, such as "1", is quoted."""
    if not isinstance(value, str):
        return str(value)
    try:
        return value if yaml.safe_load(value) == value else repr(value)
    except yaml.YAMLError:
        return repr(value)
