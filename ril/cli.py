"""`ril-run`: Hydra composes the configuration, `experiment.run` does the rest."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ril.command import MISTAKES, refuse, run_command
from ril.config import from_hydra, leaves
from ril.errors import UserError
from ril.paths import config_folder
from ril.schema import METHOD_CONFIGS, Config


def main() -> None:
    """The console command; a mistake of the user's is one line on stderr and exit status 1."""
    store_schemas()
    run_command("config", _job, stopped="ril-run: stopped")


def store_schemas() -> None:
    """Tell Hydra which keys and types the files of `conf/` may have."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    for name, schema in METHOD_CONFIGS.items():
        store.store(group="schema/method", name=name, node=schema)


def _job(composed: DictConfig) -> None:
    """A run, or one cell of a sweep, whose other cells a mistake does not end."""
    try:
        _run(composed)
    except MISTAKES as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise
        refuse(error)  # here already: Hydra says a line of its own of what leaves a job


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
        sys.exit(f"ril-run: {str(stopped) or 'stopped'}")
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
    # A label, what changes no number, and budgets.
    aside = {"env.name", "env.vectorized", "method.epochs", "method.total_timesteps"}
    aside |= {key for key, value in before.items() if value == "???"}  # of env=gym: its id
    apart = [key for key in given if key not in aside and given[key] != before.get(key)]
    return " ".join(f"{key}={given[key]}" for key in apart)


def _values(composed: DictConfig) -> dict[str, Any]:
    """What makes a method what it is, by full key."""
    groups = OmegaConf.masked_copy(composed, ["env", "method", "evaluation", "demonstrations"])
    return {key[1:]: value for key, value in leaves(OmegaConf.to_container(groups), "")}
