"""`ril-verify`: run finished runs again and compare every digit of their rows and curves."""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ril import kernels
from ril.cli import as_command
from ril.cli.arguments import Parser, folder_of
from ril.cli.command import MISTAKES, in_one_line
from ril.cli.output import unfailing, written
from ril.io.errors import UserError

if TYPE_CHECKING:
    from ril.run.verify import Comparison

_REFERENCE = Path("outputs/reference")
_EXAMPLES = """\
examples:
  ril-verify outputs/reference/mountaincar/ril/0f15b63b19   one run
  ril-verify outputs --sample 3                             three runs, drawn at random
  ril-verify --sample 5 --seeds 1                           one seed each of five reference runs
"""


def main() -> None:
    """Run the command; a difference or a user's mistake is exit status 1."""
    with written("ril-verify"):
        _main()


def _main() -> None:
    parser = Parser(
        "ril-verify",
        "Run finished runs again, and compare every digit of their rows and curves.",
        _EXAMPLES,
    )
    parser.add_argument(
        "runs",
        nargs="*",
        type=folder_of,
        metavar="RUN",
        default=[_REFERENCE],
        help=f"folder of a run, or one that contains runs (default: {_REFERENCE})",
    )
    parser.add_argument("--sample", type=int, metavar="N", help="verify N of them, drawn at random")
    parser.add_argument("--seeds", type=int, metavar="N", help="only the first N seeds of each run")
    try:
        arguments = parser.parse_args()
        with unfailing("ril-verify"):
            differs = _verify_all(arguments)
        sys.exit(differs)
    except MISTAKES as error:
        sys.exit(f"ril-verify: {in_one_line(error)}")
    except KeyboardInterrupt:
        sys.exit("ril-verify: stopped")


def _verify_all(arguments: argparse.Namespace) -> bool:
    """Verify the chosen runs one after another; return whether some digit differs."""
    for name in ("sample", "seeds"):
        if (value := getattr(arguments, name)) is not None and value < 1:
            raise UserError(f"--{name} {value}: must be at least 1")
    folders = []
    for given in arguments.runs:
        found = sorted(file.parent for file in given.rglob("results.csv"))
        if not found:
            raise UserError(f"{given}: has no finished run")
        folders += found
    if arguments.sample:
        folders = sorted(random.sample(folders, min(arguments.sample, len(folders))))

    if all("\nexact: false\n" in _text(folder / "config.yaml") for folder in folders):
        kernels.release()  # before anything imports NumPy or torch
    from ril.cli.configuration import from_file

    configs = [from_file(folder / "config.yaml") for folder in folders]

    from rich.console import Console

    from ril.cli.display import ConsoleDisplay, count, is_live
    from ril.run.verify import verify

    class Quiet(ConsoleDisplay):
        """A run's display without its result, which the comparison replaces."""

        def finished(self, rows: Path, *, skipped: bool) -> None:
            self.stop()

    console = Console(highlight=False)
    differing = 0
    for folder, config in zip(folders, configs, strict=True):
        config.seeds = config.seeds[: arguments.seeds]
        display = Quiet(console, live=is_live(console))
        try:
            comparison = verify(folder, config, display)
        finally:
            display.stop()
        differing += bool(comparison.differing)
        console.print(f"{folder}: {_result(comparison)}", soft_wrap=True, markup=False)
    agree = f"{len(folders) - differing} of {count(len(folders), 'run')}"
    console.print(f"agree in every digit: {agree}", markup=False)
    return differing > 0


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


def _result(comparison: Comparison) -> str:
    """Describe a comparison, in one line if everything agrees."""
    from ril.cli.display import count

    seeds = comparison.seeds
    evaluations = f"{count(comparison.evaluations, 'evaluation')} during training"
    if not comparison.differing:
        return f"every digit agrees: {count(len(seeds), 'seed')}, {evaluations}"
    lines = [f"differs: {len(comparison.differing)} of {count(len(seeds), 'seed')}"]
    for seed in comparison.differing:
        epoch = comparison.first_epoch.get(seed)
        since = f"from epoch {epoch} on" if epoch is not None else "after training"
        columns = ", ".join(comparison.columns.get(seed, ["only the curve"]))
        lines.append(f"  seed {seed}: {since} ({columns})")
    reasons = [f"the run had {reason}" for reason in comparison.reasons]
    lines += [f"  {reason}" for reason in reasons or ["nothing that ril records explains it"]]
    return "\n".join(lines)


if __name__ == "__main__":
    from ril.cli.verify import main as command

    as_command("ril-verify", command)
