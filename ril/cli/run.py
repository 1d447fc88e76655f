"""`ril-run`: compose the configuration with Hydra and pass it to `ril.run.experiment.run`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ril import kernels
from ril.cli.command import (
    MISTAKES,
    SWEEP_GROUPS,
    cell_command,
    default_config,
    own_folders,
    refuse,
    run_command,
)
from ril.cli.configuration import from_hydra, store_schemas
from ril.io.errors import UserError
from ril.io.paths import config_folder


def main() -> None:
    """Run the console command; a mistake of the user is one line on stderr and exit status 1."""
    store_schemas()
    run_command("config", _job, stopped="ril-run: stopped")


def _job(composed: DictConfig) -> None:
    """Run one cell; a mistake ends the command, or only this cell if it is part of a sweep."""
    try:
        _run(composed)
    except MISTAKES as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise
        refuse(error)  # here, since Hydra would add a line of its own


def _run(composed: DictConfig) -> None:
    from rich.console import Console

    alone = HydraConfig.get().mode != RunMode.MULTIRUN
    if alone:
        _refuse_sweep()
    else:
        # The rows name the command that runs this cell, not the sweep's or the worker's.
        hydra_config = HydraConfig.get()
        sys.argv = cell_command(hydra_config.overrides.task, hydra_config.runtime.config_sources)
    if alone and not composed.exact:
        kernels.release()  # before anything imports NumPy or torch
    config = from_hydra(composed)

    from ril.cli.display import ConsoleDisplay
    from ril.io.signals import Stopped
    from ril.report.beside import paper_cell
    from ril.run.experiment import run
    from ril.run.loggers import LoggedDisplay, make_logger

    console = Console(highlight=False)
    shown = ConsoleDisplay(
        console, live=alone and console.is_terminal, alone=alone, paper_number=paper_cell
    )
    logger = make_logger(config.logging, HydraConfig.get().runtime.choices["logging"])
    try:
        display = LoggedDisplay(shown, logger) if logger is not None else shown
        run(config, display, _variant(composed))
    except Stopped as stopped:
        print(f"ril-run: {stopped}", file=sys.stderr)
        sys.exit(stopped.exit_status)
    finally:
        shown.stop()
        if logger is not None:
            logger.finish()


def _refuse_sweep() -> None:
    """Refuse a sweep without -m, unless the command line picks one of its cells.

    Raises:
        UserError: the command line asks for more than one cell.
    """
    given = HydraConfig.get().overrides.task
    keys = {override.partition("=")[0] for override in given}
    sweeper = HydraConfig.get().sweeper
    sweeps = sweeper.get("sweeps") or [sweeper.get("params") or {}]
    if not any(set(sweep) <= keys for sweep in sweeps):
        groups = (each for each in given if each.startswith(SWEEP_GROUPS))
        chosen = next(groups, "hydra.sweeper.params")
        raise UserError(f"{chosen}: is a sweep, which needs -m: ril-run -m {' '.join(given)}")


def _variant(composed: DictConfig) -> str:
    """Return the keys whose values differ from the method's defaults on its environment.

    Returns:
        `key=value` of each, separated by spaces; "" if there are none.
    """
    runtime = HydraConfig.get().runtime
    env, method = runtime.choices["env"], composed.method.name
    if GlobalHydra.instance().is_initialized():
        usual = default_config(env, method)
    else:  # in the worker process of a sweep
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            usual = default_config(env, method, own_folders(runtime.config_sources))
    before, given = _values(usual), _values(composed)
    if given["demonstrations"] is not None:
        given["demonstrations"] = Path(given["demonstrations"]).name
    # A folder's name, a key that changes no number, and budgets.
    ignored = {"env.name", "env.vectorized", "method.epochs", "method.total_timesteps"}
    # Keys without a default, such as env.id of env=gym.
    ignored |= {key for key, value in before.items() if value == "???"}
    changed = [key for key in given if key not in ignored and given[key] != before.get(key)]
    return " ".join(f"{key}={given[key]}" for key in changed)


def _values(composed: DictConfig) -> dict[str, Any]:
    """Return the values on which a row's numbers depend, by full key; a list is one value."""
    values: dict[str, Any] = {}

    def collect(node: Any, key: str) -> None:
        if isinstance(node, dict):
            for name, child in node.items():
                collect(child, f"{key}.{name}")
        else:
            values[key] = node

    everything = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(everything, dict)
    for name in ("env", "method", "evaluation", "demonstrations"):
        collect(everything[name], name)
    return values
