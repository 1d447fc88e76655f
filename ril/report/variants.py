"""Methods with overridden keys, compared with their default configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.report.aggregates import methods
from ril.report.evidence import Evidence, budgets, largest_group
from ril.report.layout import Grid
from ril.report.numbers import number, with_interval
from ril.report.paper.tables import ENVIRONMENTS, main_setting
from ril.report.statistics import Estimate, average_interval

DEFAULT = "default"


@dataclass(frozen=True)
class Variant:
    """A configuration of a method, in every environment in which it was run.

    Attributes:
        method: the paper's name.
        keys: overridden keys, "key=value key=value"; "" for the default configuration.
        returns: (seeds,) AER, by environment.
        gains: (seeds,) performance P minus that of the same seed by default, by environment.
    """

    method: str
    keys: str
    returns: dict[str, NDArray[np.float64]]
    gains: dict[str, NDArray[np.float64]]

    def gain(self, *environments: str) -> Estimate:
        """Average the gain in P over environments, with its 95 % interval (NaN for one seed)."""
        values = [self.gains[env] for env in environments or self.gains]
        low, high = average_interval(values) or (np.nan, np.nan)
        return float(np.mean([each.mean() for each in values])), low, high


def variants(evidence: Evidence, score: str) -> list[Variant]:
    """List every method that was run with overridden keys: the default first, then each variant.

    In the setting of the main experiments. Variants whose budget is not the default's are ignored.

    Args:
        evidence: our rows.
        score: which policy of each run counts: "best" or "last".
    """
    column = "aer" if score == "best" else "aer_last"
    found: dict[tuple[str, str], Variant] = {}
    for method in methods(evidence):
        for env in ENVIRONMENTS:
            setting = main_setting(method, env)
            default = evidence.of_setting(setting)
            if default.empty:
                continue
            for keys, rows in _by_keys(default, evidence.matching(setting, variants=True)):
                both = rows.merge(default[["seed", column]], on="seed", suffixes=("", "_default"))
                scale = both["expert_return_measured"] - both["random_return"]
                gains = (both[column] - both[f"{column}_default"]) / scale
                variant = found.setdefault((method, keys), Variant(method, keys, {}, {}))
                variant.returns[env] = rows[column].to_numpy(dtype=np.float64)
                if not gains.empty:
                    variant.gains[env] = gains.to_numpy(dtype=np.float64)
    with_variants = {method for method, keys in found if keys}
    return [variant for variant in found.values() if variant.method in with_variants]


def _by_keys(default: pd.DataFrame, others: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the default's rows, then those of each variant with the same budget."""
    yield "", default
    comparable = others[budgets(others).isin(set(budgets(default)))]
    for keys, rows in comparable.groupby("variant"):
        yield str(keys), largest_group(rows)


def variants_grid(found: list[Variant], score: str) -> Grid:
    """Lay out returns by environment, and the change in performance P, as a table."""
    environments = [env for env in ENVIRONMENTS if any(env in each.returns for each in found)]
    body = []
    for each in found:
        texts = []
        for env in environments:
            values = each.returns.get(env)
            texts.append(
                ""
                if values is None
                else f"{number('aer', values.mean(), values.std())} ({len(values)})"
            )
        changed = with_interval(each.gain(), "+") if each.keys and each.gains else ""
        first = "" if each.keys else each.method
        body.append([first, each.keys or DEFAULT, *texts, changed])
    names = [ENVIRONMENTS[env] for env in environments]
    return Grid(
        "variants",
        "Effect of overridden keys: AER, mean ± standard deviation over seeds (number of seeds), "
        f"{score} policies; and the change in P against the default, with its 95 % interval",
        2,
        ["Method", "Overridden keys", *names, "Change in P"],
        body,
        [
            "the change is the mean over environments, from the seeds that both have"
            if body
            else "no runs with overridden keys"
        ],
    )
