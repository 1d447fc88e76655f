"""How many samples a seed needs (§5.2.2), from its learning curve."""

from __future__ import annotations

import pandas as pd

#: Reward thresholds in Gymnasium's registry. The paper calls CartPole solved at 195 (§4.1).
THRESHOLDS = {"cartpole": 475.0, "acrobot": -100.0, "mountaincar": -110.0, "lunarlander": 200.0}


def samples_to_best(curves: pd.DataFrame) -> pd.Series[float]:
    """Return, by seed, the samples at the first evaluation with the seed's highest return.

    Args:
        curves: a row per evaluation: seed, epoch, samples, aer.
    """
    ordered = curves.sort_values(["seed", "epoch"])
    best = ordered.groupby("seed")["aer"].transform("max")
    return _first(ordered[ordered["aer"] >= best])


def samples_to_threshold(curves: pd.DataFrame, threshold: float) -> pd.Series[float]:
    """Return the samples at the first evaluation that reaches a return, by seed that does.

    Args:
        curves: a row per evaluation: seed, epoch, samples, aer.
        threshold: the mean return to reach.
    """
    ordered = curves.sort_values(["seed", "epoch"])
    return _first(ordered[ordered["aer"] >= threshold])


def _first(evaluations: pd.DataFrame) -> pd.Series[float]:
    return evaluations.groupby("seed")["samples"].first()
