"""What a run is asked to do: one dataclass per group of `conf/`, which holds all the values."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator
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

    inputs: str = MISSING
    standardise: bool = MISSING
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


@dataclass
class CloningConfig:
    """π_φ's imitation half (Alg. 1, line 9)."""

    learning_rate: float = MISSING
    updates: int = MISSING
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
    """How long π_φ counts as improving (Alg. 1, line 6; §3.4, step vii)."""

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


#: Keys that cannot change a number; the demonstrations enter by their content.
_NOT_IN_RUN_ID = ("output_dir", "resume", "demonstrations")
#: Numbers must be above 0, but for these, which lie within bounds (both included).
_BOUNDS = {
    "epsilon": (0, 1),
    "discount": (0, 1),
    "target_interval": (0, math.inf),
    "loss_tolerance": (0, math.inf),
    "negative_slope": (0, math.inf),
    "n": (1, math.inf),
    "expert_return": (-math.inf, math.inf),
}
_CHOICES = {
    "method.exploration.kind": ("softmax", "uniform"),
    "method.inverse_dynamics.inputs": ("states", "change"),
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
    for key in _added(config):
        raise UserError(f"{key}: no such key")

    for group in ("method", "ablation", "evaluation"):
        for key, value in leaves(OmegaConf.to_container(composed[group]), group):
            _check(key, value)
    return config


def _added(node: Any, parent: str = "") -> Iterator[str]:
    """Full keys that no dataclass has, as `+key=value` adds them."""
    if dataclasses.is_dataclass(node):
        known = {field.name for field in dataclasses.fields(node)}
        for name, child in vars(node).items():
            if name not in known:
                yield f"{parent}{name}"
            yield from _added(child, f"{parent}{name}.")


def leaves(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    """All values below a node of the configuration, with their full keys; a list is one."""
    if isinstance(node, dict):
        for name, child in node.items():
            yield from leaves(child, f"{key}.{name}")
    else:
        yield key, node


def _check(key: str, value: Any) -> None:
    """Refuse a value outside its bounds or choices."""
    name = key.rpartition(".")[2]
    if key in _CHOICES and value not in _CHOICES[key]:
        raise UserError(f"{key}={value}: must be one of {', '.join(_CHOICES[key])}")
    if isinstance(value, list):
        for entry in value:
            _check(key, entry)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    low, high = _BOUNDS.get(name, (None, math.inf))
    if low is None and not 0 < value < math.inf:
        raise UserError(f"{key}={value}: must be a finite number above 0")
    if low is not None and not low <= value <= high:
        allowed = f"{low} or more" if high == math.inf else f"within {low}..{high}"
        raise UserError(f"{key}={value}: must be {allowed}")


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
