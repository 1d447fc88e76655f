"""From Hydra's configuration to a checked `Config`, and what identifies it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from ril.config.schema import Config
from ril.io.errors import UserError
from ril.learners.online_q_learning import OnlineQLearningConfig
from ril.methods.bc import BCConfig
from ril.methods.ril_sequential import RILSequentialConfig

#: Keys that cannot change a number; the demonstrations enter by their content.
_NOT_IN_RUN_ID = ("output_dir", "resume", "demonstrations", "processes", "logging")
#: Numbers must be above 0, but for these, which lie within bounds (both included).
_BOUNDS = {
    "epsilon": (0, 1),
    "discount": (0, 1),
    "initial_epsilon": (0, 1),
    "final_epsilon": (0, 1),
    "learning_starts": (0, math.inf),
    "alpha": (0, math.inf),
    "beta": (0, 1),
    "beta1": (0, 0.9999),
    "gamma": (0, 1),
    "gae_lambda": (0, 1),
    "ent_coef": (0, math.inf),
    "standardise_steps": (0, math.inf),
    "momentum": (0, 0.9999),
    "stats_decay": (0, 0.9999),
    "target_interval": (0, math.inf),
    "loss_tolerance": (0, math.inf),
    "negative_slope": (0, math.inf),
    "n": (1, math.inf),
    "expert_return": (-math.inf, math.inf),
    "imitation_weight": (0, math.inf),
    "min_confidence": (0, 1),
    "tau": (1e-6, 1),
}
_CHOICES: dict[str, tuple[str | bool, ...]] = {
    "method.exploration.kind": ("softmax", "uniform"),
    "method.inverse_dynamics.inputs": ("states", "change"),
    "method.inverse_dynamics.standardise": ("change", True, False),
    "method.inverse_dynamics.labels": ("argmax", "sample"),
    "method.q_learning.loss": ("huber", "mse"),
    "method.goal_sampler.memory": ("run", "epoch", "none"),
    "method.latent_policy.changes": ("raw", "scaled", "standardised"),
    "method.discriminator.reward": ("positive", "negative"),
}


def from_hydra(composed: DictConfig) -> Config:
    """The composed configuration as checked dataclasses.

    Raises:
        UserError: a value is missing, or lies outside what it may be.
    """
    for key in sorted(OmegaConf.missing_keys(composed)):
        raise UserError(f"{key}: must be given")
    config = cast(Config, OmegaConf.to_object(composed))
    config.seeds = _seeds(config.seeds)
    if ".." in Path(config.env.name).parts or Path(config.env.name).is_absolute():
        raise UserError(f"env.name={config.env.name}: must name a folder below output_dir")
    for key in _added(config):
        raise UserError(f"{key}: no such key")

    for group in ("method", "ablation", "evaluation"):
        for key, value in leaves(OmegaConf.to_container(composed[group]), group):
            _check(key, value)
    _check("processes", config.processes)
    epochs_between_looks(config.evaluation.every, epochs=1)
    if not (isinstance(config.compile, bool) or config.compile == "auto"):
        raise UserError(f"compile={config.compile}: must be auto, true or false")
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
    if key in _CHOICES and (type(value), value) not in [(type(c), c) for c in _CHOICES[key]]:
        allowed = ", ".join(str(choice).lower() for choice in _CHOICES[key])
        raise UserError(f"{key}={value}: must be one of {allowed}")
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


def epochs_between_looks(every: Any, epochs: int) -> int:
    """What `evaluation.every` means for a run of that many epochs: a count, or a share of them.

    Raises:
        UserError: it is neither.
    """
    if type(every) is int:
        return every
    share = re.fullmatch(r"(\d+(?:\.\d+)?)%", str(every))
    if share is None or not 0 < float(share[1]) <= 100:
        raise UserError(
            f"evaluation.every={every}: must be a count of epochs, or a share of them like 1%"
        )
    return max(1, int(epochs * float(share[1]) / 100))


def idle_ablations(config: Config) -> tuple[str, ...]:
    """Keys of `ablation` that cannot change the method's numbers."""
    if isinstance(config.method, HalvesConfig | RILSequentialConfig):
        return ()
    if isinstance(config.method, ReinforcementConfig):
        return ("k", "n", "trajectories")
    return ("k", "n")


def run_id(config: Config, demonstrations_sha256: str) -> str:
    """Ten hexadecimal digits made of all that can change the numbers, and of nothing else."""
    content = dataclasses.asdict(config)
    for key in _NOT_IN_RUN_ID:
        del content[key]
    del content["env"]["vectorized"]  # is equal bit for bit
    content["demonstrations"] = demonstrations_sha256
    # Of auto, rounding may differ between machines anyway.
    online = isinstance(getattr(config.method, "q_learning", None), OnlineQLearningConfig)
    compiles = online or isinstance(config.method, BCConfig)
    if config.compile == "auto" or not compiles:
        del content["compile"]
    for key in idle_ablations(config):
        del content["ablation"][key]
    goal_sampler = content["method"].get("goal_sampler")
    if goal_sampler and not goal_sampler["keep_pre"]:
        del goal_sampler["keep_pre"]  # runs from before it came, which are the same, have none
    canonical = json.dumps(content, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:10]


def run_folder(config: Config, demonstrations_sha256: str) -> Path:
    """Where a cell's run is kept: `<output_dir>/<env>/<method>/<run_id>`."""
    identifier = run_id(config, demonstrations_sha256)
    return Path(config.output_dir) / config.env.name / config.method.name / identifier
