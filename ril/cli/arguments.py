"""Command-line arguments of the commands that Hydra does not compose."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from ril.io.errors import UserError
from ril.io.paths import expanded


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one line, without the usage.

    Args:
        prog: name of the command.
        description: what it does.
        examples: the end of its help, with its own line breaks.
    """

    def __init__(self, prog: str, description: str, examples: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")

    def error(self, message: str) -> NoReturn:
        """Exit with the message."""
        sys.exit(f"{self.prog}: {message}")


def folder_of(text: str) -> Path:
    """Convert an argument to a path, with the home folder for `~`."""
    try:
        return Path(expanded(text))
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


class _Version(argparse.Action):
    """An action that prints the version; only then is it looked up."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print it and exit."""
        import ril

        print(f"{parser.prog} {ril.__version__}")
        parser.exit()
