"""Where the files that come with the package lie."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def config_folder() -> Path:
    """Hydra's groups: `ril/conf` in an installed wheel, `conf` beside `ril` in a source tree.

    Raises:
        FileNotFoundError: neither is there, so the installation is broken.
    """
    return _shipped("conf", "env", "configuration")


def docs_folder() -> Path:
    """A page per method and `deviations.md`: `ril/docs` in an installed wheel, else `docs`.

    Raises:
        FileNotFoundError: neither is there, so the installation is broken.
    """
    return _shipped("docs", "deviations.md", "documentation")


def _shipped(name: str, holds: str, what: str) -> Path:
    """A folder of that name, within the package or beside it, that holds what it should."""
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / holds).exists():
            return folder
    raise FileNotFoundError(f"no {what} beside {_PACKAGE}; install ril again")
