"""Hydra's sweeper for `ril-run -m`; here, since Hydra takes plugins from this package only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra._internal.core_plugins import basic_sweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobStatus
from omegaconf import DictConfig

from ril.io.errors import UserError

if TYPE_CHECKING:
    from ril.cli.sweep import Cell
    from ril.cli.sweep_progress import SweepProgress

_LAUNCHES = 4  # of a cell at most, as Ray has it


class CellSweeper(basic_sweeper.BasicSweeper):
    """Runs the cells of one or several sweeps by any launcher, those that are not finished.

    Args:
        max_batch_size: cells handed to the launcher at a time; None for all.
        params: values by key, as of Hydra's own sweeper.
        sweeps: the like, for one sweep after the other.
    """

    def __init__(
        self,
        max_batch_size: int | None,
        params: dict[str, str] | None = None,
        sweeps: Sequence[Mapping[str, str]] | None = None,
    ) -> None:
        super().__init__(max_batch_size, params)
        self.sweeps = sweeps

    def sweep(self, arguments: list[str]) -> None:
        """Run what the command line asks for, and say what became of it.

        Raises:
            UserError: no cell can be run; nothing was written.
            SystemExit: a cell failed, or the user stopped the sweep.
        """
        # Here, since Hydra loads plugins at every start.
        from ril.cli.sweep import expand, plan
        from ril.cli.sweep_progress import SweepProgress

        assert self.config is not None
        assert self.hydra_context is not None
        config = self.config
        loader = self.hydra_context.config_loader
        parser = OverridesParser.create(config_loader=loader)
        lines = expand(self.sweeps, [*self._parse_config(), *arguments], parser)
        overrides = [job for line in lines for job in self.split_arguments(line, None)[0]]

        def compose(job: list[str]) -> DictConfig:
            return loader.load_sweep_config(config, job)

        cells = plan(overrides, compose, config)
        try:
            Path(config.output_dir).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            at = f"output_dir={config.output_dir}"
            raise UserError(f"{at}: cannot be written ({error.strerror})") from None
        progress = SweepProgress(cells, config.hydra.launcher, Path(config.output_dir))
        with progress.watched():
            pending = progress.pending
            size = self.max_batch_size or len(pending) or 1
            for begun in range(0, len(pending), size):
                self._launch(pending[begun : begun + size], begun, progress)
        progress.report()

    def _launch(self, cells: Sequence[Cell], begun: int, progress: SweepProgress) -> None:
        """Have the launcher run some cells; again, where a worker of it was killed."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        from ril.cli.command import in_one_line

        assert self.launcher is not None
        for _ in range(_LAUNCHES):
            left = [cell for cell in cells if not cell.is_done]
            if not left:
                return
            try:
                returned = self.launcher.launch([cell.overrides for cell in left], begun)
            except TerminatedWorkerError:  # joblib gives the others up too; Ray and Slurm do not
                progress.lost(left, "a worker was killed, perhaps for want of memory")
            except Exception as error:
                return progress.lost(left, in_one_line(error))
            else:
                for cell, job in zip(left, returned, strict=True):
                    if job.status == JobStatus.FAILED:  # its property would say so and raise
                        cell.mistake = in_one_line(job._return_value)
                return
