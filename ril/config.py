"""What a run is asked to do: one dataclass per group of `conf/`, which holds all the values."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any, cast

from omegaconf import MISSING, DictConfig, OmegaConf

from ril.errors import UserError


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
    goal: GoalConfig = field(default_factory=GoalConfig)
    observation_low: list[float] | None = None
    observation_high: list[float] | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)


@dataclass
class NetworkConfig:
    """The topology that policy and inverse dynamics model share (§4.1)."""

    hidden: list[int] = MISSING
    attention: bool = MISSING
    layer_norm: bool = MISSING
    negative_slope: float = MISSING


@dataclass
class InverseDynamicsConfig:
    """M_θ and its training (Alg. 1, line 7)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


@dataclass
class CloningConfig:
    """π_φ's imitation half (Alg. 1, line 9)."""

    learning_rate: float = MISSING
    passes: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


@dataclass
class QLearningConfig:
    """π_φ's reinforcement half (Alg. 1, line 13; eq. 1)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING
    discount: float = MISSING
    loss: str = MISSING
    target_interval: int = MISSING
    replay_trajectories: float = MISSING


@dataclass
class ExplorationConfig:
    """ε and what exploring means (§3.4)."""

    epsilon: float | None = MISSING
    kind: str = MISSING


@dataclass
class GoalSamplerConfig:
    """Line 14: where I^s comes from."""

    pre_steps_per_action: int = MISSING
    memory: str = MISSING


@dataclass
class StoppingConfig:
    """"while π_φ improves" (Alg. 1, line 6; §3.4, step vii)."""

    patience: int | None = MISSING
    loss_tolerance: float = MISSING


@dataclass
class MethodConfig:
    """What every method has."""

    name: str = MISSING
    epochs: int = MISSING


@dataclass
class RILConfig(MethodConfig):
    """`conf/method/ril.yaml`: Reinforced Imitation Learning."""

    imitation: bool = MISSING
    reinforcement: bool = MISSING
    episodes: int = MISSING
    network: NetworkConfig = field(default_factory=NetworkConfig)
    inverse_dynamics: InverseDynamicsConfig = field(default_factory=InverseDynamicsConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    q_learning: QLearningConfig = field(default_factory=QLearningConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    goal_sampler: GoalSamplerConfig = field(default_factory=GoalSamplerConfig)
    stopping: StoppingConfig = field(default_factory=StoppingConfig)


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
    every: int = MISSING
    selection_episodes: int = MISSING


@dataclass
class Config:
    """One run: one cell of one table."""

    env: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    ablation: AblationConfig = field(default_factory=AblationConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    seeds: Any = MISSING
    demonstrations: str | None = None
    output_dir: str = MISSING
    device: str = MISSING
    resume: bool = MISSING


#: Keys that cannot change a number.
_NOT_IN_RUN_ID = ("output_dir", "resume", "demonstrations")
_POSITIVE = (
    "method.epochs method.episodes method.inverse_dynamics.learning_rate "
    "method.inverse_dynamics.updates method.inverse_dynamics.batch_size "
    "method.inverse_dynamics.gradient_clip method.cloning.learning_rate method.cloning.passes "
    "method.cloning.batch_size method.cloning.gradient_clip method.q_learning.learning_rate "
    "method.q_learning.updates method.q_learning.batch_size method.q_learning.gradient_clip "
    "method.q_learning.replay_trajectories method.goal_sampler.pre_steps_per_action "
    "method.stopping.patience ablation.k evaluation.episodes evaluation.every "
    "evaluation.selection_episodes"
).split()
_SHARES = ("method.exploration.epsilon", "method.q_learning.discount")
_CHOICES = {
    "method.exploration.kind": ("softmax", "uniform"),
    "method.q_learning.loss": ("huber", "mse"),
    "method.goal_sampler.memory": ("run", "epoch"),
}


def from_hydra(composed: DictConfig) -> Config:
    """The composed configuration as checked dataclasses.

    Raises:
        UserError: a value lies outside what it may be.
    """
    config = cast(Config, OmegaConf.to_object(composed))
    config.seeds = _seeds(config.seeds)

    def value(key: str) -> Any:
        return OmegaConf.select(composed, key)

    for key in _POSITIVE:
        if value(key) is not None and value(key) <= 0:
            raise UserError(f"{key}={value(key)}: must be above 0")
    for key in _SHARES:
        if value(key) is not None and not 0 <= value(key) <= 1:
            raise UserError(f"{key}={value(key)}: must be within 0..1")
    for key, allowed in _CHOICES.items():
        if value(key) is not None and value(key) not in allowed:
            raise UserError(f"{key}={value(key)}: must be one of {', '.join(allowed)}")
    if config.ablation.n < 1:
        raise UserError(f"ablation.n={config.ablation.n}: must be 1 or more")
    return config


def _seeds(given: Any) -> list[int]:
    """A count n to the seeds 0..n−1; a list to itself."""
    seeds = list(range(given)) if type(given) is int else given
    if (
        not isinstance(seeds, list)
        or not seeds
        or any(type(seed) is not int or seed < 0 for seed in seeds)
        or len(set(seeds)) < len(seeds)
    ):
        raise UserError(
            f"seeds={given}: must be a count of 1 or more, or a list of different integers ≥ 0"
        )
    return seeds


def run_id(config: Config, demonstrations_sha256: str) -> str:
    """Ten hexadecimal digits made of all that can change the numbers, and of nothing else."""
    content = dataclasses.asdict(config)
    for key in _NOT_IN_RUN_ID:
        del content[key]
    content["demonstrations"] = demonstrations_sha256
    canonical = json.dumps(content, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:10]
