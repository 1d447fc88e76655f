"""The paper's numbers as they are printed, digit by digit, and what their rounding leaves open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
import yaml

#: The axes of `paper.yaml` that say what a number was measured on.
SETTING = ["method", "env", "trajectories", "k", "n", "expert_return"]
#: A frame of numbers; to the type checker the cells of pandas' own may hold anything.
Frame: TypeAlias = Any
#: A value, and the lowest and highest that rounding leaves open.
Range = tuple[float, float, float]


class Printed:
    """The tables of `paper.yaml`, with numbers and keys as text.

    Args:
        text: of such a file; None for the paper's own.
    """

    def __init__(self, text: str | None = None) -> None:
        if text is None:
            text = (Path(__file__).parent / "tables.yaml").read_text(encoding="utf-8")
        # The plain loader keeps text, and so how many digits are printed.
        self._content: dict[str, Any] = yaml.load(text, yaml.BaseLoader)

    def cells(self, quantity: str = "aer") -> Frame:
        """All numbers of a quantity, a row each, in the paper's order.

        Returns:
            Text: `table`; each of `SETTING`, "" where it does not apply or is the usual expert;
            `mean`, and `spread`, "" where none is printed.
        """
        found: list[dict[str, str]] = []
        columns = ["table", *SETTING, "mean", "spread"]
        for table, content in self._content.items():
            level: dict[tuple[str, ...], Any] = {(): content["values"].get(quantity, {})}
            for _ in content["axes"]:
                level = {(*at, key): node[key] for at, node in level.items() for key in node}
            for at, numbers in level.items():
                cell = dict.fromkeys(columns, "") | {"table": table, **content["setting"]}
                cell |= dict(zip(content["axes"], at, strict=True))
                found.append(cell | dict(zip(("mean", "spread"), numbers, strict=False)))
        cells = pd.DataFrame(found, columns=columns)
        usual = cells[cells["expert_return"] != ""].drop_duplicates("env").index  # Table 9's firsts
        cells.loc[usual, "expert_return"] = ""
        return cells

    def means(self, table: str, quantity: str = "aer") -> Frame:
        """The numbers of one table: a row per environment, a column per key of its other axis."""
        return self._frame(table, quantity, 0)

    def spreads(self, table: str, quantity: str = "aer") -> Frame:
        """What stands after ± in one table, as `means`; NaN where nothing does."""
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
    """A printed number, and the ends of what is rounded to it: half a unit of its last digit."""
    number = Decimal(text)
    half = Decimal((0, (5,), int(number.as_tuple().exponent) - 1))
    return float(number), float(number - half), float(number + half)


def reach(function: Callable[..., float], ranges: Sequence[Range]) -> Range:
    """What a function makes of ranges.

    It is looked at where each argument is at an end, which holds the extremes of what is monotone
    in each.
    """
    corners = [function(*corner) for corner in product(*(ends for _, *ends in ranges))]
    return function(*(value for value, _, _ in ranges)), min(corners), max(corners)


def agree(one: Range, other: Range) -> bool:
    """Whether two ranges have a number in common, but for the arithmetic's own rounding."""
    return one[1] <= other[2] + 1e-9 and other[1] <= one[2] + 1e-9
