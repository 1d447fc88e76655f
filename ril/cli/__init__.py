"""The commands ril-run, ril-report and ril-expert; the only package in `ril/` that uses Hydra."""

import sys
from collections.abc import Callable


def as_command(name: str, main: Callable[[], None]) -> None:
    """Run a command whose module Python was told to run (`python -m`).

    Args:
        name: the command's name, such as "ril-run".
        main: its function, of the module that is imported by its own name, since worker processes
            find nothing in `__main__`.
    """
    sys.argv[0] = name
    main()
