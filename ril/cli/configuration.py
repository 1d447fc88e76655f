"""Turn Hydra's composed configuration into a checked `Config`; define the resolvers of `conf/`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast, get_type_hints

import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril.config.fields import check
from ril.config.schema import AblationConfig, Config, EnvironmentConfig, EvaluationConfig
from ril.io.errors import UserError, one_line, printable
from ril.io.paths import config_folder, expanded

T = TypeVar("T")
#: How messages name the types of fields, by how Python writes the types.
_TYPES = {
    "list": "a list, such as '[8,8]'",
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
}
#: Keys of groups, to suggest to a user who has left out the group's name.
_NESTED = (
    *(f"env.{field.name}" for field in fields(EnvironmentConfig)),
    *(f"ablation.{field.name}" for field in fields(AblationConfig)),
    *(f"evaluation.{field.name}" for field in fields(EvaluationConfig)),
    *("method.epochs", "method.total_timesteps"),
)

_MOST_SEEDS = 100_000  # of one run; memory grows with their number


@dataclass
class ComposedConfig(Config):
    """Hydra's composed configuration: a `Config`, and keys that only choose its values.

    Attributes:
        fidelity: "works", or "paper" for values as the paper prints them.
        quick: smaller budgets, set by `experiment=quick`.
    """

    fidelity: str = MISSING
    quick: Any = None


def store_schemas() -> None:
    """Register the types of all keys with Hydra, except those below `method`.

    The keys below `method` depend on the chosen method, which may differ between the cells of a
    sweep, so `from_hydra` checks them. Their types are in the method's module, which imports torch.
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
    """Resolve `${choices:method}` to the choices of the group, for the help text.

    Returns:
        A line per choice: its name and the first comment of its file.
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


# Registered on import, so that the worker processes of a sweep have them too.
for resolver in (by_env, by_fidelity, choices):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
OmegaConf.register_new_resolver("home", expanded, replace=True)  # ${home:${output_dir}}


def from_hydra(composed: DictConfig) -> Config:
    """Turn the composed configuration into checked dataclasses.

    Raises:
        UserError: a value is missing or not allowed, or a key does not exist.
    """
    if composed.fidelity not in ("works", "paper"):
        raise UserError(f"fidelity={composed.fidelity}: must be one of works, paper")
    for key in sorted(OmegaConf.missing_keys(composed)):
        raise UserError(f"{key}: must be given")
    values = cast(dict[str, Any], OmegaConf.to_container(composed, resolve=True))
    own = {field.name for field in fields(Config)}
    extra = {field.name for field in fields(ComposedConfig)} - own
    config = _checked({key: each for key, each in values.items() if key not in extra})
    for key in ("output_dir", "demonstrations"):
        if (path := getattr(config, key)) is not None:
            setattr(config, key, with_home(key, path))
    return config


def from_file(path: Path) -> Config:
    """Read the configuration of a run from its `config.yaml`.

    Raises:
        UserError: the file cannot be read, or another version of ril wrote it.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        return _checked(values)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path}: cannot be read ({one_line(error)})") from None
    except (UserError, LookupError, TypeError, AttributeError, ValueError) as error:
        raise UserError(f"{path}: is not a configuration of this version ({error})") from None


def with_home(key: str, path: str) -> str:
    """Return the path that is a key's value with the home folder for a leading `~`.

    Raises:
        UserError: there is no such folder.
    """
    try:
        return expanded(path)
    except UserError as error:
        raise UserError(f"{key}={error}") from None


def _checked(values: Mapping[str, Any]) -> Config:
    """Turn values by key into checked dataclasses.

    Raises:
        UserError: a value is missing or not allowed, or a key does not exist.
    """
    from ril.methods.registry import spec  # imports torch

    method = values["method"]
    name = method.get("name")
    config = _typed(Config, {**values, "method": {"name": name}})
    config.method = _typed(spec(name).config, method, "method")
    _check_name(config.env.name)
    config.seeds = _seeds(config.seeds)
    check(config)
    config.evaluation.interval(epochs=1)
    return config


def _check_name(name: str) -> None:
    """Refuse a name of an environment that no folder and no row can have as it is.

    Raises:
        UserError: it is not allowed.
    """
    path = Path(name)
    if not name.isprintable():
        raise UserError(f"env.name={printable(name)}: must have no characters that are invisible")
    if path.is_absolute() or ".." in path.parts or not path.parts or name != str(path):
        raise UserError(f"env.name={name}: must name a folder below output_dir")


def _typed(kind: type[T], values: Mapping[str, Any], parent: str = "") -> T:
    """Return values as a dataclass.

    Args:
        kind: the dataclass.
        values: its values by key.
        parent: the key that holds them; "" for the root.

    Raises:
        UserError: a value is missing or of the wrong type, or a key does not exist.
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
        raise UserError(wrong_type(error, _full(parent, str(error.full_key)))) from None


def _full(parent: str, key: str) -> str:
    return f"{parent}.{key}" if parent else key


def unknown_key(key: str, known: Iterable[str], method: str = "") -> str:
    """Return the message that a key does not exist, with the keys that the user may have meant.

    Args:
        key: the full key.
        known: names of the existing keys of its group.
        method: the choice that decides which keys exist, such as "method=ril"; "" if none does.
    """
    names = [name for name in known if name != "quick"]  # only experiment=quick sets it
    near = difflib.get_close_matches(key.rpartition(".")[2], names, n=1) or names
    if "." not in key:
        near = [each for each in _NESTED if each.rpartition(".")[2] == key] or near
    budgets = {"epochs", "total_timesteps"}
    if key.removeprefix("method.") in budgets and budgets & {*names}:
        near = [f"method.{each}" for each in budgets & {*names}]
    return f"{key}: no such key{f' of {method}' if method else ''}; is it {', '.join(near)}?"


def wrong_type(error: OmegaConfBaseException, key: str) -> str:
    """Say of which type a value must be, or what else OmegaConf refuses.

    Args:
        error: the exception that OmegaConf raised.
        key: the full key of the value.
    """
    name = key.rpartition(".")[2].partition("[")[0]
    annotations = get_type_hints(error.object_type) if is_dataclass(error.object_type) else {}
    kind = str(annotations.get(name, ""))
    for found, allowed in _TYPES.items():
        if found in kind:
            return f"{key}: must be {allowed}{' or null' if 'None' in kind else ''}"
    return f"{key}: {str(error).splitlines()[0]}"


def _seeds(given: Any) -> list[int]:
    """Return the seeds 0..n−1 for a count n, and a list as it is.

    Raises:
        UserError: it is neither a count nor a list of different seeds.
    """
    if type(given) is int and given > _MOST_SEEDS:
        raise UserError(f"seeds={given}: must be at most {_MOST_SEEDS} seeds")
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
