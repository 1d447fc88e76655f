"""Uniformly random actions: where `performance` is 0 (§4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.methods.spec import MethodSpec
from ril.vectorized.evaluation import random_returns


def measure(
    environment: Environment, _: Demonstrations, seeds: list[int], episodes: int
) -> NDArray[np.float64]:
    """Return (S, episodes) returns of random actions."""
    return random_returns(environment, seeds, episodes)


SPEC = MethodSpec("random", MethodConfig, measure=measure, budget="")
