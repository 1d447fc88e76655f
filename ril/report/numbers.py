"""How numbers are written: digits by quantity, intervals, and real minus signs."""

from __future__ import annotations

import math
import re

_DIGITS = {
    "aer": 2,
    "performance": 2,
    "reward": 2,
    "divergence": 4,
    "greedy_divergence": 4,
    "agreement": 2,
    "agreement_of_cells": 2,
}


def number(quantity: str, mean: float | None, std: float | None = None) -> str:
    """Write a mean, and its ± if given, with the digits of a quantity; "" for None."""
    digits = _DIGITS.get(quantity, 0)
    values = (value for value in (mean, std) if value is not None)
    return " ± ".join(f"{value:z,.{digits}f}" for value in values)


def with_interval(estimate: tuple[float, float, float], sign: str = "-") -> str:
    """Write a value of P and its interval, if it has one; `sign="+"` is for changes."""
    value, *ends = (f"{part:{sign}z.2f}" for part in estimate)
    return value if math.isnan(estimate[1]) else f"{value} [{', '.join(ends)}]"


def signed(text: str) -> str:
    """Replace the hyphens of negative numbers by minus signs, which are as wide as digits."""
    return re.sub(r"(?<![^\s\[])-(?=\d)", "−", text)
