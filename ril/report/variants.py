"""What a method does with keys set apart, beside the same method as it comes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.report.aggregates import methods
from ril.report.evidence import Evidence, fullest, lengths
from ril.report.layout import Grid, number, with_interval
from ril.report.paper.tables import ENVIRONMENTS, Setting
from ril.report.statistics import Estimate, average_interval

AS_IT_COMES = "as it comes"


@dataclass(frozen=True)
class Variant:
    """A method with keys set apart, in every environment in which it was run so.

    Attributes:
        method: by the paper's name.
        keys: and their values, "key=value key=value"; "" for the method as it comes.
        returns: (seeds,) AER, by environment.
        gains: (seeds,) performance P less that of the same seed as it comes, by environment.
    """

    method: str
    keys: str
    returns: dict[str, NDArray[np.float64]]
    gains: dict[str, NDArray[np.float64]]

    def gain(self, *environments: str) -> Estimate:
        """Mean over environments of the gain in P, and its 95 % interval (NaN for one seed)."""
        values = [self.gains[env] for env in environments or self.gains]
        low, high = average_interval(values) or (np.nan, np.nan)
        return float(np.mean([each.mean() for each in values])), low, high


def variants(evidence: Evidence, score: str) -> list[Variant]:
    """Every method that was run with keys set apart: first as it comes, then each variant.

    From one expert trajectory or none, as the paper's main results. Runs of another length than
    those of the method as it comes are left out.

    Args:
        evidence: our rows.
        score: of each run's "best" or "last" policy.
    """
    column = "aer" if score == "best" else "aer_last"
    found: dict[tuple[str, str], Variant] = {}
    for method in methods(evidence):
        for env in ENVIRONMENTS:
            setting = Setting(method, env, trajectories=1, k=2, n=150)
            whole = evidence.of_setting(setting)
            if whole.empty:
                continue
            for keys, rows in _by_keys(whole, evidence.matching(setting, variants=True)):
                both = rows.merge(whole[["seed", column]], on="seed", suffixes=("", "_whole"))
                scale = both["expert_return_measured"] - both["random_return"]
                gains = (both[column] - both[f"{column}_whole"]) / scale
                variant = found.setdefault((method, keys), Variant(method, keys, {}, {}))
                variant.returns[env] = rows[column].to_numpy(dtype=np.float64)
                if not gains.empty:
                    variant.gains[env] = gains.to_numpy(dtype=np.float64)
    apart = {method for method, keys in found if keys}
    return [variant for variant in found.values() if variant.method in apart]


def _by_keys(whole: pd.DataFrame, others: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows as they come, then those of each variant that trained as long."""
    yield "", whole
    as_long = others[lengths(others).isin(set(lengths(whole)))]
    for keys, rows in as_long.groupby("variant"):
        yield str(keys), fullest(rows)


def variants_grid(found: list[Variant], score: str) -> Grid:
    """As a table: returns by environment, and what the keys change in performance P."""
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
        body.append([first, each.keys or AS_IT_COMES, *texts, changed])
    names = [ENVIRONMENTS[env] for env in environments]
    return Grid(
        "variants",
        "What keys change: AER, mean ± standard deviation over seeds (number of seeds), "
        f"{score} policies; and P less that of the method as it comes, with its 95 % interval",
        2,
        ["Method", "Keys", *names, "Change in P"],
        body,
        [
            "the change is of the seeds that both have, the mean over environments"
            if body
            else "no runs with keys set apart"
        ],
    )
