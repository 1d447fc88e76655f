"""Where the files that come with the package lie."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


def config_folder() -> Path:
    """Hydra's groups: `ril/conf` in an installed wheel, `conf` beside `ril` in a source tree.

    Raises:
        FileNotFoundError: neither is there, so the installation is broken.
    """
    for folder in (_PACKAGE / "conf", _PACKAGE.parent / "conf"):
        if (folder / "env").is_dir():
            return folder
    raise FileNotFoundError(f"no configuration beside {_PACKAGE}; install ril again")


def docs_folder() -> Path:
    """A page per method and `deviations.md`: `ril/docs` in an installed wheel, else `docs`.

    Raises:
        FileNotFoundError: neither is there, so the installation is broken.
    """
    for folder in (_PACKAGE / "docs", _PACKAGE.parent / "docs"):
        if (folder / "deviations.md").is_file():
            return folder
    raise FileNotFoundError(f"no documentation beside {_PACKAGE}; install ril again")
