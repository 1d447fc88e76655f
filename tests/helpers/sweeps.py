"""Sweeps of two small cells by Hydra's launchers, whose processes are forks of this one."""

from __future__ import annotations

import copy
import importlib.util
import io
import os
import runpy
import signal
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from joblib.externals.loky import reusable_executor
from joblib.externals.loky.backend import context, resource_tracker

from helpers.crashes import Cell, Command, alone, overrides
from helpers.runs import composed
from ril.cli.configuration import from_hydra
from ril.cli.run import main
from ril.cli.variant import default_config
from ril.io.paths import config_folder
from ril.run.identity import run_folder
from ril.run.prepare import prepare

_HASTE = 30  # submitit's seconds in a second
#: Without Hydra, a run that starts from nothing, from a checkpoint, or when its rows are written …
ALONE = ("alone", "resumed", "finished")
#: … or a sweep of two by a launcher.
LAUNCHERS = (*ALONE, "basic", "joblib", "submitit_local")


def is_installed(launcher: str) -> bool:
    """Whether a launcher can be used here."""
    return launcher != "submitit_local" or importlib.util.find_spec("submitit") is not None


def cell(launcher: str, method: str, work: Path) -> Cell:
    """A method's cell, alone or the first of a sweep, in an empty folder."""
    if launcher in ALONE:
        command = alone(method)
        command(work / "warm")
        made = Cell(command, work)
        if launcher != "alone":
            done = [(each.name, each.file) for each in made.whole().operations]
            rows = done.index(("rename", "results.csv")) + 1
            made.interrupt(rows if launcher == "finished" else len(done) // 2)
        return made
    _remember_compositions()
    _fork_workers()
    argv = ["ril-run", "-m", f"hydra/launcher={launcher}", *overrides(method), "seeds=[0,1],[2,3]"]
    first = from_hydra(composed(*overrides(method), "seeds=[0,1]"))
    first.output_dir = ""
    watched = run_folder(first, prepare(first).demonstrations.sha256)
    _warm(argv, method, work)
    return Cell(_sweep(argv), work, str(watched))


def _sweep(argv: Sequence[str]) -> Command:
    def command(output: Path) -> None:
        sys.argv = [*argv, f"output_dir={output}"]
        GlobalHydra.instance().clear()
        try:
            main()
        finally:
            if reusable_executor._executor is not None:  # as at the interpreter's end
                reusable_executor._executor.shutdown(wait=True, kill_workers=True)

    return command


def _warm(argv: list[str], method: str, work: Path) -> None:
    """Compose here what the forks compose, and import what they import."""
    basic = [*argv[:2], "hydra/launcher=basic", *argv[3:]]
    GlobalHydra.instance().clear()
    Plugins.instance()
    sweeper = sys.modules["hydra_plugins.ril_sweeper"].CellSweeper
    launch, sweeper._launch = sweeper._launch, lambda *_: None
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        with suppress(SystemExit):  # no cell is run
            _sweep(argv)(work / "outputs")
        sweeper._launch = launch
        _sweep(basic)(work / "warm")
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        default_config("cartpole", method)


def _remember_compositions() -> None:
    """Have Hydra compose each configuration once, which takes most of the time of a sweep."""
    compose = ConfigLoaderImpl._load_configuration_impl
    if compose.__name__ == "remembered":
        return
    memory: dict[Any, Any] = {}

    def remembered(self: Any, *given: Any, **options: Any) -> Any:
        sources = [each.path for each in self.config_search_path.get_path()]
        key = repr((sources, given, sorted(options.items())))
        if key not in memory:
            memory[key] = compose(self, *given, **options)
        return copy.deepcopy(memory[key])

    ConfigLoaderImpl._load_configuration_impl = remembered


def _fork_workers() -> None:
    """Have joblib and submitit fork their processes."""
    warnings.filterwarnings("ignore", "`fork` start method should not be used with `loky`")
    context.set_start_method("fork", force=True)
    resource_tracker.ensure_running()
    if is_installed("submitit_local"):
        import submitit.core.core
        import submitit.local.local

        submitit.local.local.subprocess = SimpleNamespace(Popen=_Forked)
        # Of a killed job, submitit waits 15 s for the result.
        hasty = SimpleNamespace(time=lambda: _HASTE * time.time(), sleep=lambda _: time.sleep(0.01))
        submitit.core.core._time = hasty


class _Forked:
    """A `python -m module …` in a fork, with what submitit uses of `subprocess.Popen`."""

    def __init__(
        self, command: Sequence[str], env: Mapping[str, str], stdout: Any = None,
        stderr: Any = None, **_: Any,
    ) -> None:  # fmt: skip
        self.returncode: int | None = None
        parent = os.getpid()
        self.pid = os.fork()
        if self.pid:
            return
        status = 1
        with suppress(BaseException):
            os.environ.clear()
            os.environ.update(env)
            for number, file in ((1, stdout), (2, stderr)):
                if file is not None:
                    os.dup2(file.fileno(), number)
            start = command.index("-m")
            sys.argv = list(command[start + 1 :])
            # submitit makes the job's folder while Python starts, which a fork does not wait for.
            job = env.get("SUBMITIT_LOCAL_JOB_ID", str(os.getpid()))
            while not Path(command[-1].replace("%j", job)).exists() and os.getppid() == parent:
                time.sleep(0.01)
            try:
                runpy.run_module(command[start + 1], run_name="__main__", alter_sys=True)
                status = 0
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else int(end.code is not None)
        os._exit(status)

    def poll(self) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)
