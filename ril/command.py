"""What the commands over Hydra share: a mistake of the user's is one line, not a traceback."""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ril.errors import UserError, one_line
from ril.paths import config_folder
from ril.schema import METHOD_CONFIGS

MISTAKES = (UserError, HydraException, OmegaConfBaseException, OSError)
_TRACEBACK_WANTED = "HYDRA_FULL_ERROR" in os.environ


def run_command(config_name: str, job: Callable[[DictConfig], None], *, stopped: str) -> None:
    """Have Hydra compose a configuration from the command line and call a job with it.

    Args:
        config_name: a file of `conf/`.
        job: what to do.
        stopped: what to say if it is interrupted before it can say so itself.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's own errors then reach the handlers below
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


def refuse(error: Exception) -> NoReturn:
    """End the command with what was wrong in one line, and exit status 1."""
    if _TRACEBACK_WANTED:
        raise error
    sys.exit(f"{Path(sys.argv[0]).stem}: {in_one_line(error)}")


def in_one_line(error: Exception) -> str:
    """What was wrong, in the user's terms."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        allowed = ", ".join(error.options or ())
        return f"{group}={choice}: unknown, choose one of {allowed}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be read as key=value"
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
