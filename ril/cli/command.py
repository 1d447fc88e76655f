"""Run a Hydra command, and report a user's mistake in one line instead of a traceback."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
import yaml
from hydra._internal.hydra import Hydra  # Hydra's help and flags have no public interface
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril import __version__
from ril.cli.configuration import unknown_key, wrong_type
from ril.cli.output import written
from ril.io.errors import UserError, one_line
from ril.io.paths import config_folder

MISTAKES = (UserError, HydraException, OmegaConfBaseException, OSError, yaml.YAMLError)
#: Groups whose choices may be sweeps.
SWEEP_GROUPS = ("experiment=", "ablation=")
_LAUNCHERS = {"ray": "ray", "submitit": "slurm"}  # launcher: the extra that installs it
_TRACEBACK_WANTED = "HYDRA_FULL_ERROR" in os.environ


def run_command(config_name: str, job: Callable[[DictConfig], None], *, stopped: str) -> None:
    """Have Hydra compose a configuration from the command line and call a job with it.

    Args:
        config_name: name of a file in `conf/`.
        job: called with the composed configuration.
        stopped: the message if Ctrl-C interrupts the command before the job handles signals.

    Raises:
        SystemExit: the user made a mistake, or stopped the command.
    """
    with written(Path(sys.argv[0]).stem):
        if "--version" in sys.argv[1:]:
            print(f"{Path(sys.argv[0]).stem} {__version__}")
        else:
            _run(config_name, job, stopped)


def _run(config_name: str, job: Callable[[DictConfig], None], stopped: str) -> None:
    """Compose and call; see `run_command`."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # so that Hydra raises its errors
    if "--hydra-help" not in sys.argv:
        # Skip Hydra's list of all groups, which takes 0.2 s and which ril's help does not show.
        Hydra.format_config_groups = lambda *_, **__: ""  # type: ignore[method-assign]
    composed = False

    def after_composing(config: DictConfig) -> None:
        nonlocal composed
        composed = True
        job(config)

    try:
        arguments = _arguments()
        if arguments.cfg == "job" and not arguments.resolve:
            sys.argv.append("--resolve")  # so that values by environment are shown as values
        folder = str(config_folder())
        task = after_composing if not arguments.multirun else job  # workers unpickle the job
        hydra.main(version_base="1.3", config_path=folder, config_name=config_name)(task)()
    except BrokenPipeError:
        raise  # `written` ends the command
    except MISTAKES as error:
        refuse(error)
    except ValueError as error:
        if composed:
            raise
        refuse(error)  # raised by Hydra, such as for group=null or two exclusive flags
    except KeyboardInterrupt:
        sys.exit(stopped)


def _arguments() -> Any:
    """Parse the flags and overrides of the command line.

    Raises:
        SystemExit: the flags cannot be parsed.
        UserError: a key has several values without -m.
    """
    parser = get_args_parser()
    parser.error = _refuse_flags  # type: ignore[method-assign]
    arguments = parser.parse_args()
    if not arguments.multirun:
        given = [each for each in arguments.overrides if re.search(r"[,(]", each)]
        for override in OverridesParser.create().parse_overrides(given):
            if override.is_sweep_override():
                raise UserError(
                    f"{override.input_line}: several values are a sweep, which needs -m"
                )
    return arguments


def _refuse_flags(message: str) -> NoReturn:
    rest = message.removeprefix("unrecognized arguments: ")
    if rest != message and all("=" in each for each in rest.split()):
        message = f"{rest}: give all key=value together, before the flags or after them"
    sys.exit(f"{Path(sys.argv[0]).stem}: {message}")


def refuse(error: Exception) -> NoReturn:
    """Exit with status 1 and describe the mistake in one line."""
    if _TRACEBACK_WANTED:
        raise error
    sys.exit(f"{Path(sys.argv[0]).stem}: {in_one_line(error)}")


def cell_command(overrides: Sequence[str], sources: Iterable[Any]) -> list[str]:
    """Return the command line, as a list, that runs one cell of a sweep alone.

    Args:
        overrides: the cell's `key=value`.
        sources: Hydra's sources of configuration.
    """
    given = (each.path for each in sources if each.provider == "command-line")
    flags = [f"--config-dir={folder}" for folder in given]
    return ["ril-run", *flags, *overrides]


def in_one_line(error: Exception) -> str:
    """Describe a mistake in the user's terms."""
    if isinstance(error, UserError):
        return one_line(error)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if not group:
            return f"--config-name {choice}: no such file"
        allowed = ", ".join(error.options or ())
        extra = _LAUNCHERS.get(choice.partition("_")[0]) if group == "hydra/launcher" else None
        more = f"; install it with pip install -e '.[{extra}]'" if extra else ""
        near = difflib.get_close_matches(choice, error.options or (), n=1)
        meant = f"is it {near[0]}? Or " if near else ""
        return f"{group}={choice}: unknown; {meant}choose one of {allowed}{more}"
    if isinstance(error, OverrideParseException):
        key, _, value = str(error.override).partition("=")
        quoted = ""
        if value and value[0] not in "[{(\"'":
            quoted = f"; put quotes around the value: '{key}=\"{value}\"'"
        return f"{error.override}: cannot be read as key=value{quoted}"
    fault = error.__cause__ or error
    if isinstance(fault, ConfigKeyError | ConfigAttributeError) and fault.full_key:
        if fault.object_type is None or fault.object_type is dict:
            return f"{fault.full_key}: does not exist; add it as +{fault.full_key}=…"
        known = list(getattr(fault.object_type, "__dataclass_fields__", ()))
        return unknown_key(fault.full_key, known)
    if isinstance(fault, OmegaConfBaseException) and fault.full_key:
        return wrong_type(fault, str(fault.full_key))
    groups = [each for each in sys.argv[1:] if re.fullmatch(r"\w+=(null|\[\])", each)]
    if isinstance(fault, ValueError) and groups:
        return f"{' '.join(groups)}: must be one of the group's choices"
    return one_line(fault)
