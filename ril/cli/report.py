"""`ril-report`: the rows on disk as the paper's tables and figures, beside its own numbers."""

from __future__ import annotations

import argparse
import io
import os
import sys
from pathlib import Path
from typing import NoReturn

TABLES = tuple(f"table{number}" for number in range(1, 10))
FIGURES = ("figure2", "figure3", "figure4", "figure5", "curves", "sensitivity")
TARGETS = (*TABLES, *FIGURES, "statistics", "variants", "all")
FORMATS = ("md", "csv", "latex", "html")
_EXAMPLES = """\
examples:
  ril-report                                  everything on one page: report/index.html
  ril-report table2 table3                    two tables, as Markdown
  ril-report table7 --format latex            for a paper of your own
  ril-report all --format csv > numbers.csv   every number with its interval and verdict
  ril-report figure4 curves --to figures      PDF and PNG
  ril-report table4 --score last              last policies instead of best ones
  ril-report --audit                          where the paper contradicts itself
  ril-report --outputs outputs/reference      the rows that come with ril's source
"""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        sys.exit(f"ril-report: {message}")


def main() -> None:
    """The console command; a mistake of the user's is one line on stderr and exit status 1."""
    arguments = _parser().parse_args()
    targets = arguments.targets or ([] if arguments.audit else ["all"])
    unknown = [target for target in targets if target not in TARGETS]
    if unknown:
        sys.exit(f"ril-report: {unknown[0]}: unknown, choose of {', '.join(TARGETS)}")
    # Path.is_dir raises where one may not look.
    is_folder = os.path.isdir
    missing = [str(folder) for folder in arguments.outputs or [] if not is_folder(folder)]
    if missing:
        ordered = "; give it before --outputs" if missing[0] in TARGETS else ""
        sys.exit(f"ril-report: --outputs {', '.join(missing)}: no such folder{ordered}")

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch's; on networks this small more are slower
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # ± in a locale that has none is no reason to fail
    from ril.io.errors import UserError
    from ril.report.write import Wanted, write

    everything = "all" in targets
    wanted = Wanted(
        targets=tuple(name for name in TARGETS[:-1] if everything or name in targets),
        audit=arguments.audit,
        form=arguments.format or ("html" if everything else "md"),
        score=arguments.score,
        outputs=tuple(arguments.outputs or [Path("outputs")]),
        to=arguments.to,
    )
    try:
        write(wanted)
        sys.stdout.flush()
    except BrokenPipeError:  # who reads the tables wants no more of them
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (UserError, OSError) as error:
        sys.exit(f"ril-report: {error}")
    except KeyboardInterrupt:
        sys.exit("ril-report: stopped")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="ril-report",
        description="Show the rows on disk as the paper's tables and figures, beside its numbers.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "targets", nargs="*", metavar="WHAT", help=f"any of {', '.join(TARGETS)} (default: all)"
    )
    parser.add_argument(
        "--format", choices=FORMATS, help="default: md, but html of all; figures are files"
    )
    parser.add_argument(
        "--score", choices=("best", "last"), default="best", help="of each run's policies"
    )
    parser.add_argument(
        "--outputs", nargs="+", type=Path, metavar="DIR", help="folders of runs (default: outputs)"
    )
    parser.add_argument(
        "--to", type=Path, default=Path("report"), metavar="DIR", help="of files (default: report)"
    )
    parser.add_argument(
        "--audit", action="store_true", help="where the paper's numbers contradict each other"
    )
    return parser


if __name__ == "__main__":
    main()
