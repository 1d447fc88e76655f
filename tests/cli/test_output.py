"""Output that cannot be written, and terminals of all kinds, end no run."""

from __future__ import annotations

import errno
import io
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from helpers.runs import Ended
from rich.console import Console

from ril.cli.display import ConsoleDisplay, is_live
from ril.cli.output import unfailing
from ril.run.experiment import run

Here = Callable[..., Ended]
RANDOM = ("env=cartpole", "method=random", "seeds=1", "evaluation.episodes=2")
#: Starts ril-run after something was done to its streams.
START = "import sys; sys.argv[0] = 'ril-run'; from ril.cli.run import main; main()"


class Broken(io.TextIOBase):
    """A stream to which nothing can be written."""

    encoding = "utf-8"

    def __init__(self, error: Exception) -> None:
        self.error = error

    def write(self, _: str) -> int:
        raise self.error

    def flush(self) -> None:
        raise self.error


FAULTS = {
    "full": OSError(errno.ENOSPC, "No space left on device"),
    "no reader": BrokenPipeError(errno.EPIPE, "Broken pipe"),
    "terminal gone": OSError(errno.EIO, "Input/output error"),
    "not ready": BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"),
    "closed": ValueError("I/O operation on closed file"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_output_that_cannot_be_written_ends_no_run(
    quick: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fault: str,
) -> None:
    config = quick("method=bc")
    config.output_dir = str(tmp_path)
    monkeypatch.setattr(sys, "stdout", Broken(FAULTS[fault]))
    with unfailing("ril-run"):
        folder = run(config, ConsoleDisplay(Console(), live=False))
    assert len(pd.read_csv(folder / "results.csv")) == 2
    said = capsys.readouterr().err
    why = getattr(FAULTS[fault], "strerror", None) or str(FAULTS[fault])
    assert said == f"ril-run: the output cannot be written ({why}); continuing without it\n"


def test_without_any_stream_a_run_ends_well(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = quick("method=bc")
    config.output_dir = str(tmp_path)
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, Broken(FAULTS["full"]))
    with unfailing("ril-run"):
        print("lost", file=sys.stderr)
        run(config, ConsoleDisplay(Console(), live=True))


def test_the_streams_are_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = io.StringIO()
    monkeypatch.setattr(sys, "stdout", mine)
    with unfailing("ril-run"):
        print("seen")
        assert sys.stdout is not mine
    assert sys.stdout is mine
    assert mine.getvalue() == "seen\n"


#: A command that prints much and writes a file.
SMALL = """
from ril.cli.output import unfailing, written
with written("ril-run"), unfailing("ril-run"):
    with open("rows", "w") as file:
        print("lost ±" * 10_000)
        file.write(f"kept {file.fileno()}")
"""


def process(folder: Path, code: str, *arguments: str, shell: str = '"$@"', **more: str) -> Ended:
    """Run code in a process whose streams and variables are special."""
    done = subprocess.run(
        ["bash", "-c", shell, "bash", sys.executable, "-c", code, *arguments],
        cwd=folder,
        env={**os.environ, **more},
        capture_output=True,
        timeout=300,
    )
    return Ended(done.returncode, done.stdout.decode(), done.stderr.decode())


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_no_file_takes_the_place_of_a_closed_stream(tmp_path: Path, closed: str) -> None:
    ended = process(tmp_path, SMALL, shell=f'"$@" {closed}')
    assert (ended.status, ended.errors) == (0, "")
    kept, number = (tmp_path / "rows").read_text().split()
    assert kept == "kept"
    assert int(number) > 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize(
    ("output", "why"), [("> /dev/full", errno.ENOSPC), ("| true", errno.EPIPE)]
)
def test_a_process_whose_output_fails_says_so_and_ends_well(
    tmp_path: Path, output: str, why: int
) -> None:
    ended = process(tmp_path, SMALL, shell=f'set -o pipefail; "$@" {output}')
    said = f"ril-run: the output cannot be written ({os.strerror(why)}); continuing without it\n"
    assert (ended.status, ended.errors) == (0, said)
    assert (tmp_path / "rows").read_text().startswith("kept")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_help_into_a_full_file_is_one_line(tmp_path: Path) -> None:
    ended = process(tmp_path, START, "--help", shell='"$@" > /dev/full')
    assert ended.status == 1
    assert ended.errors.startswith("ril-run: ")
    assert ended.errors.count("\n") == 1


def test_characters_that_an_encoding_lacks_end_nothing(tmp_path: Path) -> None:
    # A folder whose name is not ASCII, in a locale and an encoding that are.
    poor = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "TERM": "dumb", "COLUMNS": "1"}
    ended = process(tmp_path, START, *RANDOM, 'output_dir="aus-zügen"', **poor)
    assert (ended.status, ended.errors) == (0, "")
    assert "AER 25.50 +- 0.00 over 1 seed" in ended.output
    assert "aus-z\\xfcgen/cartpole/random/" in ended.output


def test_help_in_ascii_is_help(here: Here, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    written = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", written)
    assert here("--help").status == 0
    written.flush()
    assert b"mountaincar" in written.buffer.getvalue()  # type: ignore[attr-defined]


def test_the_bytes_of_a_name_that_is_no_text_stay_as_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", written)
    with unfailing("ril-run"):
        print(os.fsdecode(b"a\xffb"))
    assert written.buffer.getvalue() == b"a\xffb\n"  # type: ignore[attr-defined]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8", "utf-16"])
@pytest.mark.parametrize("width", [1, 2, 80])
@pytest.mark.parametrize("live", [True, False])
def test_any_terminal_shows_a_run(
    quick: Any, tmp_path: Path, encoding: str, width: int, live: bool
) -> None:
    config = quick("method=bc", "method.epochs=1", "seeds=1")
    config.output_dir = str(tmp_path)
    written = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="ril.plain")
    console = Console(file=written, force_terminal=live, width=width, height=1, highlight=False)
    display = ConsoleDisplay(console, live=live)
    run(config, display)
    written.flush()
    text = written.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
    assert "over 1 seed" in text


@pytest.mark.parametrize(
    ("term", "live"), [("xterm", True), ("dumb", False), ("unknown", False), ("", True)]
)
def test_a_panel_needs_a_terminal_that_can_redraw_it(term: str, live: bool) -> None:
    variables = {"TERM": term} if term else {}
    console = Console(file=io.StringIO(), force_terminal=True, _environ=variables)
    assert is_live(console) is live


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("ril", "ril-run"),
        ("ril.cli", "ril-run"),
        ("ril.cli.run", "ril-run"),
        ("ril.cli.report", "ril-report"),
        ("ril.cli.expert", "ril-expert"),
        ("ril.cli.verify", "ril-verify"),
    ],
)
def test_a_module_that_python_is_told_to_run_is_its_command(
    module: str, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [module, "--version"])
    monkeypatch.delitem(sys.modules, module, raising=False)
    with suppress(SystemExit):
        runpy.run_module(module, run_name="__main__", alter_sys=False)
    assert capsys.readouterr().out.startswith(f"{command} ")


def test_a_logger_that_cannot_write_ends_no_run(
    quick: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ril.run.loggers import LoggedDisplay

    class Full:
        def start(self, *_: object) -> None: ...

        def log(self, _: object) -> None:
            raise FAULTS["full"]

        def finish(self) -> None:
            raise FAULTS["full"]

    config = quick("evaluation.every=1")
    config.output_dir = str(tmp_path)
    display = LoggedDisplay(ConsoleDisplay(Console(), live=False), Full())
    folder = run(config, display)
    display.end()
    assert (folder / "results.csv").exists()
    line = "logging: cannot be written (No space left on device); training continues without it"
    assert capsys.readouterr().out.count(line) == 1
