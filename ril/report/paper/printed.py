"""The paper's numbers exactly as printed, and the ranges that their rounding allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
import yaml

from ril.report.paper.tables import TABLES

#: The axes of `tables.yaml` that define a number's setting.
SETTING = ["method", "env", "trajectories", "k", "n", "expert_return"]
#: A frame of numbers; pandas-stubs types the cells of a DataFrame too widely.
Frame: TypeAlias = Any
#: A value, and the lowest and highest value that is rounded to it.
Range = tuple[float, float, float]


class Printed:
    """The tables of `tables.yaml`, with numbers and keys as text.

    Args:
        text: contents of such a file; None for the paper's own.
    """

    def __init__(self, text: str | None = None) -> None:
        if text is None:
            text = (Path(__file__).parent / "tables.yaml").read_text(encoding="utf-8")
        # The base loader keeps numbers as text, with all printed digits.
        content: dict[str, Any] = yaml.load(text, yaml.BaseLoader)
        self._content = {name: content[name] for name in TABLES}

    def cells(self, quantity: str = "aer") -> Frame:
        """Return all numbers of a quantity, a row each, in the paper's order.

        Returns:
            Text: `table`; each of `SETTING`, "" where it does not apply or is the usual expert;
            `mean`; and `std`, "" where none is printed.
        """
        found: list[dict[str, str]] = []
        columns = ["table", *SETTING, "mean", "std"]
        for table, content in self._content.items():
            level: dict[tuple[str, ...], Any] = {(): content["values"].get(quantity, {})}
            for _ in content["axes"]:
                level = {(*at, key): node[key] for at, node in level.items() for key in node}
            for at, numbers in level.items():
                cell = dict.fromkeys(columns, "") | {"table": table, **content["setting"]}
                cell |= dict(zip(content["axes"], at, strict=True))
                found.append(cell | dict(zip(("mean", "std"), numbers, strict=False)))
        cells = pd.DataFrame(found, columns=columns)
        # The first expert of each environment in Table 9 is the usual one.
        usual = cells[cells["expert_return"] != ""].drop_duplicates("env").index
        cells.loc[usual, "expert_return"] = ""
        return cells

    def means(self, table: str, quantity: str = "aer") -> Frame:
        """Return the numbers of one table: environments down, keys of the other axis across."""
        return self._frame(table, quantity, 0)

    def stds(self, table: str, quantity: str = "aer") -> Frame:
        """Return the numbers after ± of one table, laid out as `means`; NaN where missing."""
        return self._frame(table, quantity, 1)

    def _frame(self, table: str, quantity: str, place: int) -> pd.DataFrame:
        content = self._content[table]
        frame = pd.DataFrame(content["values"][quantity])
        if content["axes"][0] == "env":
            frame = frame.T
        number = frame.map(
            lambda c: float(c[place]) if len(c) > place else None, na_action="ignore"
        )
        return number.astype(float)


def rounded(text: str) -> Range:
    """Return a printed number and its rounding range, ± half a unit of its last digit."""
    number = Decimal(text)
    half = Decimal((0, (5,), int(number.as_tuple().exponent) - 1))
    return float(number), float(number - half), float(number + half)


def propagate(function: Callable[..., float], ranges: Sequence[Range]) -> Range:
    """Propagate rounding ranges through a function that is monotone in each argument.

    The function is evaluated where each argument is at one of its ends.
    """
    corners = [function(*corner) for corner in product(*(ends for _, *ends in ranges))]
    return function(*(value for value, _, _ in ranges)), min(corners), max(corners)


def agree(one: Range, other: Range) -> bool:
    """Return whether two ranges overlap, up to floating-point error."""
    return one[1] <= other[2] + 1e-9 and other[1] <= one[2] + 1e-9
