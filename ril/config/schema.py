"""The configuration that all methods share: a dataclass per group of `conf/`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from ril.config.fields import part


@dataclass
class GoalConfig:
    """When an episode counts as having reached the goal; every condition that is set must hold."""

    minimum_return: float | None = None
    minimum_final_reward: float | None = None
    terminated: bool | None = None


@dataclass
class EnvironmentConfig:
    """`conf/env/*.yaml`: a Gymnasium environment."""

    name: str = MISSING
    id: str = MISSING
    solved_return: float | None = None
    goal: GoalConfig = part(GoalConfig)
    observation_low: list[float] | None = None
    observation_high: list[float] | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)
    vectorized: bool = True


@dataclass
class MethodConfig:
    """What every method has; all that `random` and `expert` have."""

    name: str = MISSING


@dataclass
class AblationConfig:
    """What the paper varies (§6.3, §6.4, §7)."""

    k: float = MISSING
    n: float = MISSING
    trajectories: int = MISSING
    expert_return: float | None = None


@dataclass
class EvaluationConfig:
    """How a policy is scored."""

    episodes: int = MISSING
    every: Any = MISSING
    selection_episodes: int = MISSING


@dataclass
class Config:
    """One run: one cell of one table."""

    env: EnvironmentConfig = part(EnvironmentConfig)
    method: MethodConfig = part(MethodConfig)
    ablation: AblationConfig = part(AblationConfig)
    evaluation: EvaluationConfig = part(EvaluationConfig)
    seeds: Any = MISSING
    demonstrations: str | None = None
    output_dir: str = MISSING
    processes: int | None = None
    device: str = MISSING
    compile: Any = MISSING
    resume: bool = MISSING
    logging: Any = None
