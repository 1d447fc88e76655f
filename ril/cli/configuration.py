"""From what Hydra composes to a checked `Config`, and the resolvers that `conf/` uses."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, cast

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril.config.fields import check
from ril.config.schema import AblationConfig, Config, EnvironmentConfig, EvaluationConfig
from ril.io.errors import UserError
from ril.io.paths import config_folder

T = TypeVar("T")
#: Keys below a group that may be given without its name by mistake.
_NESTED = (
    *(f"env.{field.name}" for field in fields(EnvironmentConfig)),
    *(f"ablation.{field.name}" for field in fields(AblationConfig)),
    *(f"evaluation.{field.name}" for field in fields(EvaluationConfig)),
    *("method.epochs", "method.total_timesteps"),
)


@dataclass
class ComposedConfig(Config):
    """What Hydra composes: a `Config`, and keys on which its values depend.

    Attributes:
        fidelity: "works", or "paper" for values as the paper prints them.
        quick: budgets of `experiment=quick`, in place of the methods' own.
    """

    fidelity: str = MISSING
    quick: Any = None


def store_schemas() -> None:
    """Tell Hydra the types of the keys of `conf/`, but for those below `method`.

    The keys below `method` depend on its choice, which a sweep knows only cell by cell, so
    `from_hydra` checks them. They also need the method's module, which imports torch.
    """
    schema = OmegaConf.structured(ComposedConfig)
    OmegaConf.set_struct(schema.method, False)
    ConfigStore.instance().store(name="schema", node=schema)


def by_env(choices: Mapping[str, Any], *, _root_: DictConfig) -> Any:
    """Resolve `${by_env:{cartpole: 8, other: 32}}` to the value of the chosen environment."""
    value = choices[_root_.env.name if _root_.env.name in choices else "other"]
    return OmegaConf.create(value) if isinstance(value, list) else value


def by_fidelity(choices: Mapping[str, Any], *, _root_: DictConfig) -> Any:
    """Resolve `${by_fidelity:{works: 5e-4, paper: 5e-7}}` to the value of the chosen fidelity."""
    return choices[_root_.fidelity]


def choices(group: str) -> str:
    """Resolve `${choices:method}` to a group's choices, for the help text.

    Returns:
        A line for each: its name, and the first comment of its file.
    """
    lines = []
    for file in sorted((config_folder() / group).glob("*.yaml")):
        comments = (
            line.removeprefix("# ")
            for line in file.read_text(encoding="utf-8").splitlines()
            if line.startswith("# ") and "@package" not in line
        )
        lines.append(f"    {file.stem:<19}{next(comments, '')}")
    return "\n".join(lines)


# On import, so that the worker processes of a sweep have them too.
for resolver in (by_env, by_fidelity, choices):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


def from_hydra(composed: DictConfig) -> Config:
    """Turn the composed configuration into checked dataclasses.

    Raises:
        UserError: a value is missing or not allowed, or a key is unknown.
    """
    from ril.methods.registry import spec  # imports torch

    if composed.fidelity not in ("works", "paper"):
        raise UserError(f"fidelity={composed.fidelity}: must be one of works, paper")
    for key in sorted(OmegaConf.missing_keys(composed)):
        raise UserError(f"{key}: must be given")
    values = cast(dict[str, Any], OmegaConf.to_container(composed, resolve=True))
    method = values["method"]
    name = method.get("name")
    values["method"] = {"name": name}
    own = {field.name for field in fields(Config)}
    extra = {field.name for field in fields(ComposedConfig)} - own
    config = _typed(Config, {key: each for key, each in values.items() if key not in extra})
    config.method = _typed(spec(name).config, method, "method")
    if ".." in Path(config.env.name).parts or Path(config.env.name).is_absolute():
        raise UserError(f"env.name={config.env.name}: must name a folder below output_dir")
    config.seeds = _seeds(config.seeds)
    check(config)
    config.evaluation.interval(epochs=1)
    return config


def _typed(kind: type[T], values: Mapping[str, Any], parent: str = "") -> T:
    """The values as a dataclass.

    Args:
        kind: of dataclass.
        values: by key.
        parent: their key; "" for the root.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(kind), values)
        for key in sorted(OmegaConf.missing_keys(typed)):
            raise UserError(f"{_full(parent, key)}: must be given")
        return cast(T, OmegaConf.to_object(typed))
    except (ConfigKeyError, ConfigAttributeError) as error:
        holder: Any = error.object_type or kind
        known = [field.name for field in fields(holder)]
        method = f"method={values.get('name')}" if parent == "method" else ""
        raise UserError(unknown_key(_full(parent, str(error.full_key)), known, method)) from None
    except OmegaConfBaseException as error:
        key = _full(parent, str(error.full_key))
        raise UserError(f"{key}: {str(error).splitlines()[0]}") from None


def _full(parent: str, key: str) -> str:
    return f"{parent}.{key}" if parent else key


def unknown_key(key: str, known: Iterable[str], method: str = "") -> str:
    """Say that a key does not exist, and which one may have been meant.

    Args:
        key: in full.
        known: names that exist in its place.
        method: "method=ril", where that decides which keys exist.
    """
    names = [name for name in known if name != "quick"]  # which experiment=quick sets
    near = difflib.get_close_matches(key.rpartition(".")[2], names, n=1) or names
    if "." not in key:
        near = [each for each in _NESTED if each.rpartition(".")[2] == key] or near
    return f"{key}: no such key{f' of {method}' if method else ''}; is it {', '.join(near)}?"


def _seeds(given: Any) -> list[int]:
    """A count n to the seeds 0..n−1; a list to itself."""
    seeds = list(range(given)) if type(given) is int else given
    if (
        not isinstance(seeds, list)
        or not seeds
        or any(type(seed) is not int or seed < 0 for seed in seeds)
        or len(set(seeds)) < len(seeds)
    ):
        raise UserError(
            f"seeds={given}: must be a count of 1 or more, or a list of different integers ≥ 0"
        )
    return seeds
