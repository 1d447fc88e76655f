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
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ril.cli.command import (
    MISTAKES,
    SWEEP_GROUPS,
    cell_command,
    own_folders,
    refuse,
    run_command,
)
from ril.config.checks import from_hydra, leaves
from ril.config.schema import METHOD_CONFIGS, Config
from ril.io.errors import UserError
from ril.io.paths import config_folder


def main() -> None:
    """The console command; a mistake of the user's is one line on stderr and exit status 1."""
    store_schemas()
    if {"-m", "--multirun"} & set(sys.argv):
        sys.argv[1:] = map(_for_each_cell, sys.argv[1:])
    run_command("config", _job, stopped="ril-run: stopped")


def store_schemas() -> None:
    """Tell Hydra which keys and types the files of `conf/` may have."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    for name, schema in METHOD_CONFIGS.items():
        store.store(group="schema/method", name=name, node=schema)


def _for_each_cell(argument: str) -> str:
    """A key of the method as a sweep of one value.

    Hydra composes a sweep before its cells, with the default method, and refuses other methods'
    keys; sweeps it leaves to the cells.
    """
    key, _, value = argument.partition("=")
    if not key.removeprefix("+").startswith("method.") or not value:
        return argument
    try:
        swept = OverridesParser.create().parse_override(argument).is_sweep_override()
    except HydraException:  # which Hydra will say in its turn
        return argument
    return argument if swept else f"{key}=choice({value})"


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

    if HydraConfig.get().mode == RunMode.MULTIRUN:
        # The command of the cell's rows is its own, not the sweep's or the worker's.
        hydra_config = HydraConfig.get()
        sys.argv = cell_command(hydra_config.overrides.task, hydra_config.runtime.config_sources)
    else:
        _refuse_sweep()
    config = from_hydra(composed)

    from ril.cli.display import ConsoleDisplay
    from ril.io.signals import Stopped
    from ril.run.experiment import run
    from ril.run.loggers import LoggedDisplay, make_logger

    console = Console(highlight=False)
    alone = HydraConfig.get().mode != RunMode.MULTIRUN
    shown = ConsoleDisplay(console, live=alone and console.is_terminal, alone=alone)
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
    """Say that a sweep needs `-m`, unless the command line picks one of its cells."""
    given = HydraConfig.get().overrides.task
    keys = {override.partition("=")[0] for override in given}
    sweeper = HydraConfig.get().sweeper
    sweeps = sweeper.get("sweeps") or [sweeper.get("params") or {}]
    if not any(set(sweep) <= keys for sweep in sweeps):
        groups = (each for each in given if each.startswith(SWEEP_GROUPS))
        chosen = next(groups, "hydra.sweeper.params")
        raise UserError(f"{chosen}: is a sweep, which needs -m: ril-run -m {' '.join(given)}")


def _variant(composed: DictConfig) -> str:
    """What was set apart from the method as it comes on its environment, as key=value."""
    runtime = HydraConfig.get().runtime
    comes = [f"env={runtime.choices['env']}", f"method={composed.method.name}"]
    in_worker = not GlobalHydra.instance().is_initialized()  # of a sweep, which starts from anew
    if in_worker:
        own = [f"file://{folder}" for folder in own_folders(runtime.config_sources)]
        comes += [f"hydra.searchpath=[{','.join(own)}]"]
    folder = str(config_folder())
    with hydra.initialize_config_dir(folder, version_base="1.3") if in_worker else nullcontext():
        usual = hydra.compose("config", comes)
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
