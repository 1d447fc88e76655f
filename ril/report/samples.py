"""How many samples a seed needs (§5.2.2), from its learning curve."""

from __future__ import annotations

import pandas as pd

from ril.report.paper.tables import solved_return


def samples_to_best(curves: pd.DataFrame) -> pd.Series[float]:
    """Samples at the first look that reaches a seed's highest return, by seed.

    Args:
        curves: a line per look: seed, epoch, samples, aer.
    """
    ordered = curves.sort_values(["seed", "epoch"])
    best = ordered.groupby("seed")["aer"].transform("max")
    return _first(ordered[ordered["aer"] >= best])


def samples_to_solved(curves: pd.DataFrame, env: str) -> pd.Series[float]:
    """Samples at the first look that reaches the environment's threshold, by seed that does.

    Args:
        curves: a line per look: seed, epoch, samples, aer.
        env: whose threshold (§4.1).
    """
    ordered = curves.sort_values(["seed", "epoch"])
    return _first(ordered[ordered["aer"] >= solved_return(env)])


def _first(looks: pd.DataFrame) -> pd.Series[float]:
    return looks.groupby("seed")["samples"].first()
