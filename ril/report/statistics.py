"""Bootstrap intervals of means over few runs, and aggregates over environments.

A report has hundreds of intervals. Resampling indices are drawn once per number of runs, from a
fixed seed: every report has the same intervals, and each costs one matrix product.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

RESAMPLES = 10_000
CONFIDENCE = 0.95

#: A value and the low and high end of its interval; the ends are NaN without an interval.
Estimate = tuple[float, float, float]
_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Aggregate:
    """A method's performance P over environments and seeds, after Agarwal et al. (2021).

    Attributes:
        mean: mean of the environments' means.
        median: median of the environments' means.
        iqm: interquartile mean: of the middle half of all runs of all environments.
        optimality_gap: mean of max(0, 1 − P) over all runs: the distance below the expert.
    """

    mean: Estimate
    median: Estimate
    iqm: Estimate
    optimality_gap: Estimate


def mean_interval(values: ArrayLike) -> tuple[float, float] | None:
    """Compute the 95 % percentile bootstrap interval of a mean over seeds.

    Args:
        values: (seeds,).

    Returns:
        Its low and high end; None for fewer than two seeds.
    """
    return average_interval([values])


def average_interval(by_env: Sequence[ArrayLike]) -> tuple[float, float] | None:
    """Compute the 95 % interval of the mean over environments (Tables 2, 4 and 5).

    Args:
        by_env: (seeds,) values by environment; seeds are resampled within each.

    Returns:
        Its low and high end; None where an environment has fewer than two seeds.
    """
    arrays = [np.asarray(values, dtype=float) for values in by_env]
    if min(map(len, arrays), default=0) < 2:
        return None
    # Relative to the first value, so that equal values get exactly that value as interval.
    firsts = np.mean([values[0] for values in arrays])
    means = [_weights(len(v), stream) @ (v - v[0]) for stream, v in enumerate(arrays)]
    low, high = firsts + _ends(np.mean(means, axis=0))
    return float(low), float(high)


def aggregate(by_env: Mapping[str, ArrayLike]) -> Aggregate:
    """Aggregate a method's performance over environments, with stratified bootstrap intervals.

    Args:
        by_env: P of each run, (seeds,), by environment.

    Returns:
        Aggregates with 95 % intervals, which are NaN where an environment has only one seed.

    Raises:
        ValueError: no environment is given, or one has no run.
    """
    runs = [np.asarray(values, dtype=float) for values in by_env.values()]
    if min(map(len, runs), default=0) == 0:
        raise ValueError("every environment needs a run")
    values = _aggregates([v[np.newaxis] for v in runs])[:, 0]
    ends = np.full((2, len(values)), np.nan)
    if min(map(len, runs)) > 1:
        resampled = [v[_indices(len(v), stream)] for stream, v in enumerate(runs)]
        ends = _ends(_aggregates(resampled))
    return Aggregate(
        *((float(v), float(a), float(b)) for v, a, b in zip(values, *ends, strict=True))
    )


def _aggregates(runs: Sequence[_Floats]) -> _Floats:
    """Compute `Aggregate`'s fields, (4, resamples), from (resamples, seeds) per environment."""
    means = np.stack([values.mean(axis=1) for values in runs])
    # Repeat runs so that each environment has the same weight.
    common = math.lcm(*(values.shape[1] for values in runs))
    repeated = [np.repeat(values, common // values.shape[1], axis=1) for values in runs]
    pooled = np.concatenate(repeated, axis=1)
    iqm = stats.trim_mean(pooled, 0.25, axis=1)
    gap = np.maximum(0, 1 - pooled).mean(axis=1)
    return np.stack([means.mean(axis=0), np.median(means, axis=0), iqm, gap])


def probability_of_improvement(x: Mapping[str, ArrayLike], y: Mapping[str, ArrayLike]) -> Estimate:
    """Estimate P(X > Y) + ½P(X = Y) for runs of X and Y, averaged over environments.

    Args:
        x: scores of the runs of X, (seeds,), by environment.
        y: those of Y; only common environments count.

    Returns:
        The probability with its 95 % interval, which is NaN where X or Y has only one seed in an
        environment. All three are NaN without a common environment.
    """
    values, resampled, sure = [], [], True
    for number, env in enumerate(env for env in x if env in y):
        a, b = np.asarray(x[env], dtype=float), np.asarray(y[env], dtype=float)
        beats = (1 + np.sign(np.subtract.outer(a, b))) / 2
        values.append(beats.mean())
        sure &= min(len(a), len(b)) > 1
        ours, theirs = _weights(len(a), 2 * number), _weights(len(b), 2 * number + 1)
        resampled.append(((ours @ beats) * theirs).sum(axis=1))
    if not values:
        return (np.nan,) * 3
    low, high = _ends(np.mean(resampled, axis=0)) if sure else (np.nan, np.nan)
    return float(np.mean(values)), float(low), float(high)


@cache
def _indices(count: int, stream: int) -> NDArray[np.int64]:
    """Draw the runs of each resample, (resamples, count); streams are independent."""
    return np.random.default_rng([count, stream]).integers(count, size=(RESAMPLES, count))


@cache
def _weights(count: int, stream: int) -> _Floats:
    """Compute the share of each of `count` runs in each resample, (resamples, count)."""
    shares: _Floats = (_indices(count, stream)[..., np.newaxis] == np.arange(count)).mean(axis=1)
    return shares


def _ends(resampled: _Floats) -> _Floats:
    """Compute both ends of the percentile interval along the last axis."""
    tail = (1 - CONFIDENCE) / 2
    ends: _Floats = np.quantile(resampled, [tail, 1 - tail], axis=-1)
    return ends
