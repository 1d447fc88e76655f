"""`ril-run`: Hydra composes the configuration, `experiment.run` does the rest."""

from __future__ import annotations

import difflib
import os
import sys

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from ril.config import Config, RILConfig
from ril.errors import UserError
from ril.paths import config_folder


def main() -> None:
    """The console command; a mistake of the user's is one line on stderr and exit status 1."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    store.store(group="schema/method", name="ril", node=RILConfig)
    traceback_wanted = "HYDRA_FULL_ERROR" in os.environ
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's own errors then reach the handlers below
    folder = str(config_folder())
    try:
        hydra.main(version_base="1.3", config_path=folder, config_name="config")(_run)()
    except (UserError, HydraException, OmegaConfBaseException, OSError) as error:
        if traceback_wanted:
            raise
        sys.exit(f"ril-run: {in_one_line(error)}")
    except KeyboardInterrupt:
        sys.exit("ril-run: stopped; the same command goes on from the last checkpoint")


def _run(composed: DictConfig) -> None:
    """One job: a run, or one cell of a sweep."""
    from rich.console import Console

    from ril.config import from_hydra

    for key in sorted(OmegaConf.missing_keys(composed)):
        raise UserError(f"{key}: must be given")
    config = from_hydra(composed)

    from ril.display import ConsoleDisplay
    from ril.experiment import run

    console = Console(highlight=False)
    alone = HydraConfig.get().mode != RunMode.MULTIRUN
    display = ConsoleDisplay(console, live=alone and console.is_terminal)
    try:
        run(config, display)
    finally:
        display.stop()


def in_one_line(error: Exception) -> str:
    """What was wrong, in the user's terms."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        allowed = ", ".join(error.options or ())
        return f"{group}={choice}: unknown, choose one of {allowed}"
    cause = error.__cause__
    if isinstance(cause, ConfigKeyError) and cause.full_key:
        parent, _, key = cause.full_key.rpartition(".")
        known = [] if cause.object_type is None else list(_fields(cause.object_type))
        near = difflib.get_close_matches(key, known, n=1) or known
        where = f" of {parent}" if parent else ""
        return f"{cause.full_key}: no such key{where}; is it {', '.join(near)}?"
    return " ".join(str(cause or error).split())


def _fields(kind: type) -> list[str]:
    return list(getattr(kind, "__dataclass_fields__", ()))
