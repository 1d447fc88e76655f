"""Find methods by name: `conf/method/<name>.yaml`, and `SPEC` in `ril/methods/<name>.py`."""

from __future__ import annotations

import importlib
from functools import cache

from ril.io.errors import UserError
from ril.io.paths import config_folder
from ril.methods.spec import MethodSpec


def names() -> list[str]:
    """Return the names of all methods, in alphabetical order."""
    return sorted(file.stem for file in (config_folder() / "method").glob("*.yaml"))


@cache  # the display asks after every epoch
def spec(name: str) -> MethodSpec:
    """Import one method's file and return its specification.

    Raises:
        UserError: no method has this name.
    """
    if name not in names():
        raise UserError(f"method.name={name}: must be one of {', '.join(names())}")
    found: MethodSpec = importlib.import_module(f"ril.methods.{name}").SPEC
    return found
