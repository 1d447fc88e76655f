"""The configuration that all methods share: a dataclass per group of `conf/`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from ril.config.fields import any_number, at_least, one_of, part
from ril.io.errors import UserError


@dataclass
class GoalConfig:
    """The conditions of success; an episode that meets all that are set reaches the goal (§3.2)."""

    minimum_return: float | None = any_number(None)
    minimum_final_reward: float | None = any_number(None)
    terminated: bool | None = None


@dataclass
class EnvironmentConfig:
    """`conf/env/*.yaml`: a Gymnasium environment.

    Attributes:
        name: the environment's name in rows, and its folder below `output_dir`.
        id: the id that is passed to `gymnasium.make`.
        solved_return: mean return from which the environment counts as solved (§4.1).
        goal: the conditions under which an episode succeeds.
        observation_low: raw observation that is scaled to −1; None: the space's bounds.
        observation_high: raw observation that is scaled to 1; None: the space's bounds.
        scale_observations: whether methods see scaled observations or raw ones (D5).
        kwargs: passed to `gymnasium.make`.
        vectorized: whether ril's own, faster steps are used where there are any; results are
            bit-identical either way.
    """

    name: str = MISSING
    id: str = MISSING
    solved_return: float | None = any_number(None)
    goal: GoalConfig = part(GoalConfig)
    observation_low: list[float] | None = any_number(None)
    observation_high: list[float] | None = any_number(None)
    scale_observations: bool = True
    kwargs: dict[str, Any] = field(default_factory=dict)
    vectorized: bool = True


@dataclass
class MethodConfig:
    """The base of every method's configuration; the method's file in `ril/methods/` extends it."""

    name: str = MISSING


@dataclass
class AblationConfig:
    """The values that the paper varies (§6.3, §6.4, §7)."""

    k: float = MISSING
    n: float = at_least(1)
    trajectories: int = MISSING
    expert_return: float | None = any_number(None)


@dataclass
class EvaluationConfig:
    """Settings for evaluating policies during training and for scoring them after it."""

    episodes: int = MISSING
    every: Any = MISSING
    selection_episodes: int = MISSING

    def interval(self, epochs: int) -> int:
        """Return the number of epochs between two evaluations.

        Args:
            epochs: number of epochs of the run; `every` may be a percentage of it.

        Raises:
            UserError: `every` is neither a count nor a percentage.
        """
        if type(self.every) is int:
            return self.every
        share = re.fullmatch(r"(\d+(?:\.\d+)?)%", str(self.every))
        if share is None or not 0 < float(share[1]) <= 100:
            raise UserError(
                f"evaluation.every={self.every}: must be a count of epochs, or a share of them: 1%"
            )
        return max(1, int(epochs * float(share[1]) / 100))


@dataclass
class Config:
    """The configuration of one run, which is one cell of one table."""

    env: EnvironmentConfig = part(EnvironmentConfig)
    method: MethodConfig = part(MethodConfig)
    ablation: AblationConfig = part(AblationConfig)
    evaluation: EvaluationConfig = part(EvaluationConfig)
    seeds: Any = any_number()
    demonstrations: str | None = None
    output_dir: str = MISSING
    device: str = MISSING
    exact: bool = MISSING
    compile: Any = one_of("auto", True, False)
    resume: bool = MISSING
    logging: Any = None
