"""`ril-run`: Hydra composes the configuration, `experiment.run` does the rest."""

from __future__ import annotations

import difflib
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril.config import from_hydra, leaves
from ril.errors import UserError
from ril.paths import config_folder
from ril.schema import METHOD_CONFIGS, Config

_TRACEBACK_WANTED = "HYDRA_FULL_ERROR" in os.environ
_MISTAKES = (UserError, HydraException, OmegaConfBaseException, OSError)


def main() -> None:
    """The console command; a mistake of the user's is one line on stderr and exit status 1."""
    store_schemas()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's own errors then reach the handlers below
    folder = str(config_folder())
    try:
        hydra.main(version_base="1.3", config_path=folder, config_name="config")(_job)()
    except _MISTAKES as error:
        _refuse(error)
    except KeyboardInterrupt:
        sys.exit("ril-run: stopped")


def store_schemas() -> None:
    """Tell Hydra which keys and types the files of `conf/` may have."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    for name, schema in METHOD_CONFIGS.items():
        store.store(group="schema/method", name=name, node=schema)


def _refuse(error: Exception) -> NoReturn:
    if _TRACEBACK_WANTED:
        raise error
    sys.exit(f"ril-run: {in_one_line(error)}")


def _job(composed: DictConfig) -> None:
    """A run, or one cell of a sweep, whose other cells a mistake does not end."""
    try:
        _run(composed)
    except _MISTAKES as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise
        _refuse(error)  # here already: Hydra says a line of its own of what leaves a job


def _run(composed: DictConfig) -> None:
    from rich.console import Console

    for key in sorted(OmegaConf.missing_keys(composed)):
        raise UserError(f"{key}: must be given")
    config = from_hydra(composed)

    from ril.display import ConsoleDisplay
    from ril.experiment import run

    console = Console(highlight=False)
    alone = HydraConfig.get().mode != RunMode.MULTIRUN
    display = ConsoleDisplay(console, live=alone and console.is_terminal)
    try:
        run(config, display, _variant(composed))
    except KeyboardInterrupt as stopped:
        sys.exit(f"ril-run: {stopped or 'stopped'}")
    finally:
        display.stop()


def _variant(composed: DictConfig) -> str:
    """What was set apart from the method as it comes on its environment, as key=value."""
    chosen = HydraConfig.get().runtime.choices
    in_worker = not GlobalHydra.instance().is_initialized()  # of a sweep, which starts from anew
    folder = str(config_folder())
    with hydra.initialize_config_dir(folder, version_base="1.3") if in_worker else nullcontext():
        usual = hydra.compose("config", [f"{group}={chosen[group]}" for group in ("env", "method")])
    before, given = _values(usual), _values(composed)
    if given["demonstrations"] is not None:
        given["demonstrations"] = Path(given["demonstrations"]).name
    budget = {"method.epochs", "method.total_timesteps"}
    apart = [key for key in given if key not in budget and given[key] != before.get(key)]
    return " ".join(f"{key}={given[key]}" for key in apart)


def _values(composed: DictConfig) -> dict[str, Any]:
    """What makes a method what it is, by full key."""
    groups = OmegaConf.masked_copy(composed, ["env", "method", "evaluation", "demonstrations"])
    return {key[1:]: value for key, value in leaves(OmegaConf.to_container(groups), "")}


def in_one_line(error: Exception) -> str:
    """What was wrong, in the user's terms."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        allowed = ", ".join(error.options or ())
        return f"{group}={choice}: unknown, choose one of {allowed}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be read as key=value"
    fault = error.__cause__ or error
    if isinstance(fault, ConfigKeyError | ConfigAttributeError) and fault.full_key:
        parent, _, key = fault.full_key.rpartition(".")
        known = [] if fault.object_type is None else list(_fields(fault.object_type))
        if not known:
            return f"{fault.full_key}: not there yet; give it as +{fault.full_key}=…"
        near = difflib.get_close_matches(key, known, n=1) or known
        where = f" of {parent}" if parent else ""
        return f"{fault.full_key}: no such key{where}; is it {', '.join(near)}?"
    if isinstance(fault, OmegaConfBaseException) and fault.full_key:
        return f"{fault.full_key}: {str(fault).splitlines()[0]}"
    return " ".join(str(fault).split())


def _fields(kind: type) -> list[str]:
    return list(getattr(kind, "__dataclass_fields__", ()))
