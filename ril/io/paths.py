"""Where the files that ship with the package are, and the home folder in paths."""

from pathlib import Path

from ril.io.errors import UserError

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


def expanded(path: str) -> str:
    """Replace a leading `~` or `~user` by the home folder, as shells do at the start of a word.

    Raises:
        UserError: there is no such user or no home folder.
    """
    if not path.startswith("~"):
        return path
    try:
        return str(Path(path).expanduser())
    except RuntimeError:
        message = f"{path}: has no home folder; write ./{path} for a path of that name"
        raise UserError(message) from None


def _shipped(name: str, content: str, description: str) -> Path:
    """Find the folder of that name, in the package or beside it, that has the given content."""
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / content).exists():
            return folder
    raise FileNotFoundError(
        f"{description} is missing: neither {_PACKAGE / name} nor {_PACKAGE.parent / name} has "
        f"{content}; install ril again"
    )
