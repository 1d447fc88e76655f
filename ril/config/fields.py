"""Bounds of configuration values, declared in each dataclass field beside its type."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from omegaconf import MISSING

from ril.io.errors import UserError
from ril.io.numbers import LARGEST


def within(low: float, high: float, default: Any = MISSING) -> Any:
    """Declare a field whose numbers must lie in [low, high]."""
    return dataclasses.field(default=default, metadata={"bounds": (low, high)})


def at_least(low: float, default: Any = MISSING) -> Any:
    """Declare a field whose numbers must be finite and no less than `low`."""
    return within(low, math.inf, default)


def any_number(default: Any = MISSING) -> Any:
    """Declare a field whose numbers must be finite."""
    return within(-math.inf, math.inf, default)


def one_of(*choices: str | bool, default: Any = MISSING) -> Any:
    """Declare a field whose value must equal one of `choices` and have its type."""
    return dataclasses.field(default=default, metadata={"choices": choices})


def part(config: type) -> Any:
    """Declare a field that holds another configuration dataclass."""
    return dataclasses.field(default_factory=config)


def check(config: Any, prefix: str = "") -> None:
    """Check each value against the bounds of its field; without bounds, numbers must be above 0.

    Args:
        config: a configuration dataclass; nested dataclasses are checked too.
        prefix: the beginning of the fields' full keys, such as "method.".

    Raises:
        UserError: a value is not allowed; the message names its full key and what is allowed.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            check(value, f"{prefix}{field.name}.")
        else:
            _check_value(f"{prefix}{field.name}", value, field.metadata)


def _check_value(key: str, value: Any, metadata: Any) -> None:
    choices = metadata.get("choices")
    # True == 1 in Python, so types are compared too.
    if choices and (type(value), value) not in [(type(choice), choice) for choice in choices]:
        allowed = ", ".join(str(choice).lower() for choice in choices)
        raise UserError(f"{key}={value}: must be one of {allowed}")
    for number in value if isinstance(value, list) else [value]:
        if isinstance(number, bool) or not isinstance(number, int | float):
            continue
        if isinstance(number, int) and number > LARGEST:
            raise UserError(f"{key}={number}: must be a whole number below 2**53")
        if "bounds" not in metadata:
            if not 0 < number < math.inf:
                raise UserError(f"{key}={number}: must be a finite number above 0")
            continue
        low, high = metadata["bounds"]
        if not (low <= number <= high and math.isfinite(number)):
            raise UserError(f"{key}={number}: must be {_range(low, high)}")


def _range(low: float, high: float) -> str:
    if high < math.inf:
        return f"within {low}..{high}"
    return "a finite number" if low == -math.inf else f"{low} or more"
