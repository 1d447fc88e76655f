"""`ril-report`: show our rows as the paper's tables and figures, compared with its numbers."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from ril.cli import as_command
from ril.cli.arguments import Parser, folder_of
from ril.cli.output import written

TABLES = tuple(f"table{number}" for number in range(1, 10))
FIGURES = ("figure2", "figure3", "figure4", "figure5", "curves", "sensitivity")
EVERYTHING = (*TABLES, *FIGURES, "statistics", "variants")
TARGETS = (*EVERYTHING, "all", "results")
FORMATS = ("md", "csv", "latex", "html")
_EXAMPLES = """\
examples:
  ril-report                                  everything on one page: report/index.html
  ril-report table2 table3                    two tables, as Markdown
  ril-report table7 --format latex            a table for your own paper
  ril-report all --format csv > numbers.csv   every number with its interval and verdict
  ril-report figure4 curves --to figures      figures, as PDF and PNG
  ril-report table4 --score last              last policies instead of the best
  ril-report variants                         the effect of overridden keys
  ril-report --audit                          contradictions within the paper
  ril-report --outputs outputs/reference      the rows that come with ril's source
"""


def main() -> None:
    """Run the command; a user's mistake is one line on stderr and exit status 1."""
    with written("ril-report"):
        _report()


def _report() -> None:
    arguments = _parser().parse_args()
    targets = arguments.targets or ([] if arguments.audit else ["all"])
    unknown = [target for target in targets if target not in TARGETS]
    if unknown:
        sys.exit(f"ril-report: {unknown[0]}: unknown target; choose from {', '.join(TARGETS)}")
    # Path.is_dir raises for a folder without permission.
    is_folder = os.path.isdir
    missing = [str(folder) for folder in arguments.outputs or [] if not is_folder(folder)]
    if missing:
        ordered = "; put targets before --outputs" if missing[0] in TARGETS else ""
        sys.exit(f"ril-report: --outputs {', '.join(missing)}: no such folder{ordered}")

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # more threads slow down networks this small
    from ril.io.errors import UserError
    from ril.report.write import Wanted, write

    everything = "all" in targets
    wanted = Wanted(
        targets=tuple(
            name
            for name in TARGETS
            if name != "all" and (name in targets or (everything and name in EVERYTHING))
        ),
        audit=arguments.audit,
        form=arguments.format or ("html" if everything else "md"),
        score=arguments.score,
        outputs=tuple(arguments.outputs or [Path("outputs")]),
        to=arguments.to,
    )
    try:
        write(wanted)
    except BrokenPipeError:
        raise  # `written` ends the command
    except (UserError, OSError) as error:
        sys.exit(f"ril-report: {error}")
    except KeyboardInterrupt:
        sys.exit("ril-report: stopped")


def _parser() -> Parser:
    parser = Parser(
        "ril-report",
        "Show our rows as the paper's tables and figures, compared with its numbers.",
        _EXAMPLES,
    )
    parser.add_argument(
        "targets",
        nargs="*",
        metavar="TARGET",
        help=f"one or more of {', '.join(TARGETS)} (default: all). "
        "`results` writes results.md and the figure of the README",
    )
    parser.add_argument(
        "--format", choices=FORMATS, help="format of tables (default: md; html for `all`)"
    )
    parser.add_argument(
        "--score",
        choices=("best", "last"),
        default="best",
        help="score the best or the last policy of each run (default: best)",
    )
    parser.add_argument(
        "--outputs",
        nargs="+",
        type=folder_of,
        metavar="DIR",
        help="folders of runs (default: outputs)",
    )
    parser.add_argument(
        "--to",
        type=folder_of,
        default=Path("report"),
        metavar="DIR",
        help="folder for figures and pages (default: report)",
    )
    parser.add_argument(
        "--audit", action="store_true", help="list the contradictions within the paper"
    )
    return parser


if __name__ == "__main__":
    from ril.cli.report import main as command

    as_command("ril-report", command)
