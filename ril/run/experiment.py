"""One run of one cell: prepare it, claim its folder, train and score, write its rows."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from ril.config.schema import Config
from ril.environments.examination import examine
from ril.io.errors import NotFiniteError, UserError, one_line, printable
from ril.io.files import WriteError
from ril.io.locks import claimed
from ril.io.signals import Stopped, stop_on_signals
from ril.run.earlier import has_rows, refuse_changed_demonstrations
from ril.run.prepare import Cell, prepare
from ril.run.provenance import command, digits
from ril.run.training import Display, Run, measure_reference, train_and_score
from ril.run.write import write_end, write_results, write_start
from ril.vectorized.compiling import fallbacks


def run(config: Config, display: Display, variant: str = "") -> Path:
    """Train and score one cell.

    Args:
        config: configuration of the run.
        display: shows the run to the user.
        variant: the keys with non-default values, for the column `variant`; see `Row`.

    Returns:
        The run's folder, `<output_dir>/<env>/<method>/<run_id>`; `results.csv` in it has a row
        per seed.

    Raises:
        UserError: a value or file cannot be used; no row has been written.
        Stopped: the user stopped it; the message says how to resume.
    """
    try:
        cell = prepare(config)
        with closing(cell.environment):
            return _run(cell, display, printable(variant))
    except (MemoryError, RuntimeError) as error:
        said = one_line(error)
        if isinstance(error, RuntimeError) and "can't allocate memory" not in said:  # torch's
            raise
        raise UserError(
            f"out of memory{': ' * bool(said)}{said}; fewer seeds, shorter episodes, or a smaller "
            "replay memory need less"
        ) from error


def _run(cell: Cell, display: Display, variant: str) -> Path:
    """Train and score a prepared cell; return its folder."""
    config = cell.config
    if config.resume:
        if has_rows(cell.folder, config):
            display.finished(cell.folder / "results.csv", skipped=True)
            return cell.folder
        refuse_changed_demonstrations(cell.folder, config, cell.demonstrations.sha256)
    doubts = examine(cell.environment)
    fallbacks.clear()  # of an earlier run of this process
    method = cell.build_method()

    def waits_for(holder: str) -> None:
        name = f"env={config.env.name} method={config.method.name}"
        display.noted(f"{name}: {holder} is running this cell; waiting for its rows")

    resume = f"; resume with {command()}" if config.resume else ""
    try:
        with (
            claimed(cell.folder, new=not config.resume, wait=waits_for) as claim,
            stop_on_signals() as stop,
        ):
            # The process that held the folder may have written the rows meanwhile.
            if config.resume and has_rows(claim.folder, config):
                display.finished(claim.folder / "results.csv", skipped=True)
                return claim.folder
            if not claim.exclusive:
                display.noted(
                    f"{claim.folder}: this file system has no locks; do not run the same cell "
                    "twice at the same time"
                )
            if config.exact and (why := digits(config)) != "exact":
                display.noted(f"{why}: last digits may differ from other machines'")
            for doubt in doubts:
                display.noted(doubt)
            commit = write_start(claim.folder, cell, doubts)
            stop.immediate = method is None  # measuring a reference can be repeated
            display.started(config, claim.folder, 0 if method is None else method.epochs)
            try:
                if method is None:
                    outcome = measure_reference(cell)
                else:
                    outcome = train_and_score(Run(cell, method, claim, stop), display)
                claim.check()
                write_results(claim.folder, cell, outcome, variant, commit)
            except NotFiniteError as error:
                write_end(claim.folder, cell, variant, f"ended: {error}")
                raise UserError(f"{error}; the run ended without rows") from error
    except Stopped as stopped:
        raise Stopped(f"{stopped}{resume}", stopped.number) from None
    except WriteError as error:
        raise UserError(f"{error}{resume}") from None
    display.finished(claim.folder / "results.csv", skipped=False)
    return claim.folder
