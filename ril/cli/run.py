"""`ril-run`: compose the configuration with Hydra and pass it to `ril.run.experiment.run`."""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ril import kernels
from ril.cli import as_command
from ril.cli.command import MISTAKES, SWEEP_GROUPS, cell_command, refuse, run_command
from ril.cli.configuration import from_hydra, store_schemas
from ril.cli.output import unfailing
from ril.config.schema import Config
from ril.io.errors import UserError


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
    settings = HydraConfig.get()
    alone = settings.mode != RunMode.MULTIRUN
    if alone:
        _refuse_sweep()
    else:
        # The rows name the command that runs this cell, not the sweep's or the worker's.
        sys.argv = cell_command(settings.overrides.task, settings.runtime.config_sources)
    if alone and not composed.exact:
        kernels.release()  # before anything imports NumPy or torch
    config = from_hydra(composed)
    with unfailing("ril-run"):
        _train(_from_origin(config, Path(settings.runtime.cwd)), alone=alone)


def _from_origin(config: Config, origin: Path) -> Config:
    """Take paths from the folder in which the command was given, even if Hydra has left it."""
    if Path.cwd() != origin:  # hydra.job.chdir=true
        config.output_dir = str(origin / config.output_dir)
        if config.demonstrations is not None:
            config.demonstrations = str(origin / config.demonstrations)
    return config


def _train(config: Config, *, alone: bool) -> None:
    from rich.console import Console

    from ril.cli.display import ConsoleDisplay, is_live
    from ril.cli.variant import own_folders, refuse_shadowed, variant
    from ril.io.signals import Stopped
    from ril.report.beside import paper_cell
    from ril.run.experiment import run
    from ril.run.loggers import LoggedDisplay, make_logger

    runtime = HydraConfig.get().runtime
    refuse_shadowed(runtime.config_sources)
    apart = variant(config, runtime.choices["env"], own_folders(runtime.config_sources))
    console = Console(highlight=False)
    shown = ConsoleDisplay(
        console, live=alone and is_live(console), alone=alone, paper_number=paper_cell
    )
    logger = make_logger(config.logging, runtime.choices["logging"])
    logged = LoggedDisplay(shown, logger) if logger is not None else None
    try:
        run(config, logged or shown, apart)
    except Stopped as stopped:
        print(f"ril-run: {stopped}", file=sys.stderr)
        sys.exit(stopped.exit_status)
    finally:
        shown.stop()
        if logged is not None:
            logged.end()


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


if __name__ == "__main__":
    from ril.cli.run import main as command

    as_command("ril-run", command)
