"""What the commands over Hydra share: a mistake of the user's is one line, not a traceback."""

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
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril.config.schema import METHOD_CONFIGS
from ril.io.errors import UserError, one_line
from ril.io.paths import config_folder

MISTAKES = (UserError, HydraException, OmegaConfBaseException, OSError, yaml.YAMLError)
#: Groups whose choices may be sweeps.
SWEEP_GROUPS = ("experiment=", "ablation=")
_LAUNCHERS = {"ray": "ray", "submitit": "slurm"}  # by the extra that they come with
_TRACEBACK_WANTED = "HYDRA_FULL_ERROR" in os.environ


def run_command(config_name: str, job: Callable[[DictConfig], None], *, stopped: str) -> None:
    """Have Hydra compose a configuration from the command line and call a job with it.

    Args:
        config_name: a file of `conf/`.
        job: what to do.
        stopped: what to say if it is interrupted before it can say so itself.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's own errors then reach the handlers below
    if "--hydra-help" not in sys.argv:
        # It lists all groups for a second, though no help text of ours has a place for that list.
        Hydra.format_config_groups = lambda *_, **__: ""  # type: ignore[method-assign]
    parser = get_args_parser()
    parser.error = _refuse_flags  # type: ignore[method-assign]
    parser.parse_args()  # first, for Hydra says its usage besides what is wrong
    folder = str(config_folder())
    try:
        hydra.main(version_base="1.3", config_path=folder, config_name=config_name)(job)()
        sys.stdout.flush()
    except BrokenPipeError:  # who reads the output wants no more of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except MISTAKES as error:
        refuse(error)
    except ValueError as error:
        if not any(known in str(error) for known in ("Config group override", "Only one of --")):
            raise
        refuse(error)  # group=null, or two flags
    except KeyboardInterrupt:
        sys.exit(stopped)


def _refuse_flags(message: str) -> NoReturn:
    rest = message.removeprefix("unrecognized arguments: ")
    if rest != message and all("=" in each for each in rest.split()):
        message = f"{rest}: give all key=value together, before the flags or after them"
    sys.exit(f"{Path(sys.argv[0]).stem}: {message}")


def refuse(error: Exception) -> NoReturn:
    """End the command with what was wrong in one line, and exit status 1."""
    if _TRACEBACK_WANTED:
        raise error
    sys.exit(f"{Path(sys.argv[0]).stem}: {in_one_line(error)}")


def own_folders(sources: Iterable[Any]) -> list[str]:
    """The user's folders among those that Hydra composed a configuration from: --config-dir."""
    return [source.path for source in sources if source.provider == "command-line"]


def cell_command(overrides: Sequence[str], sources: Iterable[Any]) -> list[str]:
    """What runs one cell of a sweep alone."""
    flags = [f"--config-dir={folder}" for folder in own_folders(sources)]
    return ["ril-run", *flags, *overrides]


def in_one_line(error: Exception) -> str:
    """What was wrong, in the user's terms."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if not group:
            return f"--config-name {choice}: no such file"
        allowed = ", ".join(error.options or ())
        extra = _LAUNCHERS.get(choice.partition("_")[0]) if group == "hydra/launcher" else None
        more = f"; it comes with pip install -e '.[{extra}]'" if extra else ""
        return f"{group}={choice}: unknown, choose one of {allowed}{more}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be read as key=value"
    if several := re.match(r"(?:Ambiguous value for argument|Sweep parameters) '(.*)'", str(error)):
        return f"{several[1]}: several values are a sweep, which needs -m"
    if isinstance(error, ValueError) and "Config group override" in str(error):
        groups = [each for each in sys.argv[1:] if re.fullmatch(r"\w+=(null|\[\])", each)]
        return f"{' '.join(groups)}: must be one of the group's choices"
    fault = error.__cause__ or error
    if isinstance(fault, ConfigKeyError | ConfigAttributeError) and fault.full_key:
        parent, _, key = fault.full_key.rpartition(".")
        known = [] if fault.object_type is None else list(_fields(fault.object_type))
        if not known:
            return f"{fault.full_key}: not there yet; give it as +{fault.full_key}=…"
        near = difflib.get_close_matches(key, known, n=1) or known
        methods = [name for name, kind in METHOD_CONFIGS.items() if kind is fault.object_type]
        where = f" of {'='.join([parent, *methods[:1]])}" if parent else ""
        return f"{fault.full_key}: no such key{where}; is it {', '.join(near)}?"
    if isinstance(fault, OmegaConfBaseException) and fault.full_key:
        return f"{fault.full_key}: {str(fault).splitlines()[0]}"
    return one_line(fault)


def _fields(kind: type) -> list[str]:
    return list(getattr(kind, "__dataclass_fields__", ()))
