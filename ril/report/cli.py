"""`ril-report`: the rows on disk as the paper's tables."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        sys.exit(f"ril-report: {message}")


def main() -> None:
    """The console command."""
    parser = _Parser(
        prog="ril-report", description="Show the rows on disk beside the paper's numbers."
    )
    parser.add_argument(
        "table", choices=["table2", "table4", "table5"], help="which of the paper's tables"
    )
    parser.add_argument(
        "--outputs",
        nargs="+",
        type=Path,
        default=[Path("outputs")],
        metavar="DIR",
        help="folders of runs (default: outputs)",
    )
    arguments = parser.parse_args()
    missing = [str(folder) for folder in arguments.outputs if not folder.is_dir()]
    if missing and arguments.outputs != parser.get_default("outputs"):
        sys.exit(f"ril-report: --outputs {', '.join(missing)}: no such folder")

    from ril.errors import UserError
    from ril.report.tables import results_table
    from ril.results import load_results

    try:
        print(results_table(load_results(arguments.outputs), arguments.table))
    except UserError as error:
        sys.exit(f"ril-report: {error}")


if __name__ == "__main__":
    main()
