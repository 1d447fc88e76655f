"""`ril-expert`: train an expert to a given return and save its trajectories."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ril.cli import as_command
from ril.cli.command import MISTAKES, refuse, run_command
from ril.cli.configuration import with_home
from ril.cli.display import is_live
from ril.cli.output import unfailing
from ril.experts.make import make_expert
from ril.experts.training import ExpertConfig, OnStep
from ril.io.errors import UserError


@contextmanager
def _progress(config: ExpertConfig, console: Console) -> Iterator[OnStep]:
    """Show the training: a bar on a terminal, a line per evaluation in a log file."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("steps, mean return {task.fields[mean]}"),
        TimeElapsedColumn(),
    )
    started = time.monotonic()
    live = is_live(console)
    with Progress(*columns, console=console, disable=not live) as bar:
        task = bar.add_task(config.env.name, total=config.total_timesteps, mean="…")

        def on_step(steps: int, mean: float | None) -> None:
            bar.update(task, completed=steps)
            if mean is None:
                return
            bar.update(task, mean=f"{mean:.2f}")
            if not live:
                elapsed = time.monotonic() - started
                console.print(f"{steps:>9,} steps  mean return {mean:.2f}  {elapsed:.0f} s")

        yield on_step


def _run(composed: DictConfig) -> None:
    """Train one expert and print a summary of its trajectories."""
    try:
        for key in sorted(OmegaConf.missing_keys(composed)):
            raise UserError(f"{key}: must be given")
        config = cast(ExpertConfig, OmegaConf.to_object(composed))
        console = Console(highlight=False)
        command = " ".join(["ril-expert", *HydraConfig.get().overrides.task])
        config.output = with_home("output", config.output)
        with unfailing("ril-expert"), _progress(config, console) as on_step:
            record = make_expert(
                config,
                command,
                on_step,
                lambda doubt: console.print(doubt, soft_wrap=True, markup=False),
            )
    except MISTAKES as error:
        refuse(error)  # here, since Hydra would add a line of its own
    returns, first = record["returns"], record["first"]
    console.print(
        f"{config.output}: {record['episodes']} episodes with return {returns['mean']:.2f} ± "
        f"{returns['std']:.2f}, after {record['steps_trained']:,} training steps; the first has "
        f"{first['length']} steps and return {first['return']:.2f}",
        soft_wrap=True,
    )


def main() -> None:
    """Run the console command; a mistake of the user is one line on stderr and exit status 1."""
    ConfigStore.instance().store(name="expert_schema", node=ExpertConfig)
    run_command("expert", _run, stopped="ril-expert: stopped, nothing was written")


if __name__ == "__main__":
    from ril.cli.expert import main as command

    as_command("ril-expert", command)
