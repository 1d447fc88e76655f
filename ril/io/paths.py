"""Where the files that ship with the package are."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def config_folder() -> Path:
    """Find Hydra's config groups: `ril/conf` in an installed wheel, else `conf` beside `ril`.

    Raises:
        FileNotFoundError: both are missing, so the installation is broken.
    """
    return _shipped("conf", "env", "configuration")


def docs_folder() -> Path:
    """Find the documentation: `ril/docs` in an installed wheel, else `docs` beside `ril`.

    Raises:
        FileNotFoundError: both are missing, so the installation is broken.
    """
    return _shipped("docs", "deviations.md", "documentation")


def _shipped(name: str, content: str, description: str) -> Path:
    """Find the folder of that name, in the package or beside it, that has the given content."""
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / content).exists():
            return folder
    raise FileNotFoundError(
        f"{description} is missing: neither {_PACKAGE / name} nor {_PACKAGE.parent / name} has "
        f"{content}; install ril again"
    )
