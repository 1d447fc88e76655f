"""The sweeper of `ril-run -m`; it is not in `ril/`, since Hydra looks for plugins here only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from ril import kernels
from ril.io.errors import UserError

if TYPE_CHECKING:
    from ril.cli.sweep import Cell
    from ril.cli.sweep_progress import SweepProgress

_LAUNCHES = 4  # maximum attempts per cell, as by Ray's default


class CellSweeper(Sweeper):
    """A sweeper that runs the unfinished cells of one or several sweeps with any launcher.

    Args:
        max_batch_size: number of cells passed to the launcher at a time; None for all.
        params: comma-separated values by key, as in Hydra's basic sweeper.
        sweeps: the same for several sweeps, which are run one after another.
    """

    def __init__(
        self,
        max_batch_size: int | None,
        params: Mapping[str, str] | None = None,
        sweeps: Sequence[Mapping[str, str]] | None = None,
    ) -> None:
        self.max_batch_size = max_batch_size
        self.params = params or {}
        self.sweeps = sweeps
        self.config: DictConfig
        self.hydra_context: HydraContext
        self.launcher: Launcher

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Make the launcher; Hydra calls this before `sweep`."""
        self.config = config
        self.hydra_context = hydra_context
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Run the sweep of a command line, and report the result of each cell.

        Args:
            arguments: overrides of the command line.

        Raises:
            UserError: no cell can be run; nothing was written.
            SystemExit: a cell failed, or the user stopped the sweep.
        """
        if not self.config.exact:
            kernels.release()  # for the workers, whose cells share one level
        # Imported here, since Hydra loads its plugins at every start of a command.
        from ril.cli.output import unfailing

        with unfailing("ril-run"):
            self._sweep(arguments)

    def _sweep(self, arguments: list[str]) -> None:
        from ril.cli.sweep import expand, plan
        from ril.cli.sweep_progress import SweepProgress
        from ril.io.files import make_folder

        config, loader = self.config, self.hydra_context.config_loader
        parser = OverridesParser.create(config_loader=loader)
        params = [f"{key}={values}" for key, values in self.params.items()]
        jobs = expand(self.sweeps, [*params, *arguments], parser)

        def compose(job: list[str]) -> DictConfig:
            return loader.load_sweep_config(config, job)

        cells = plan(jobs, compose, config)
        configs = (each.config for each in cells)
        places = list(dict.fromkeys(each.output_dir for each in configs if each is not None))
        for place in places:
            try:
                make_folder(Path(place), exist_ok=True)
            except OSError as error:
                at = f"output_dir={place}"
                raise UserError(f"{at}: cannot be written ({error.strerror})") from None
        # Launchers make this folder, whose default may need a cell's own `${hydra:…}`.
        if places and OmegaConf.is_interpolation(config.hydra.sweep, "dir"):
            OmegaConf.set_readonly(config.hydra, False)
            config.hydra.sweep.dir = places[0]
        progress = SweepProgress(cells, config.hydra.launcher, *map(Path, places))
        with progress.watched():
            pending = progress.pending
            size = self.max_batch_size or len(pending) or 1
            for start in range(0, len(pending), size):
                self._launch(pending[start : start + size], start, progress)
        progress.report()

    def _launch(self, cells: Sequence[Cell], first: int, progress: SweepProgress) -> None:
        """Run cells with the launcher; if a worker was killed, run the unfinished ones again."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        from ril.cli.command import in_one_line

        for _ in range(_LAUNCHES):
            left = [cell for cell in cells if not cell.is_done]
            if not left:
                return
            try:
                returned = self.launcher.launch([cell.overrides for cell in left], first)
            except TerminatedWorkerError:  # joblib, unlike Ray and Slurm, drops the other cells too
                progress.lost(left, "a worker was killed, perhaps because memory ran out")
            except Exception as error:
                return progress.lost(left, in_one_line(error))
            else:
                for cell, job in zip(left, returned, strict=True):
                    if job.status == JobStatus.FAILED:  # `return_value` would raise the error
                        cell.mistake = in_one_line(job._return_value)
                return
