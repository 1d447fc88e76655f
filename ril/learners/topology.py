"""The networks of §4.1, built from their configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import MISSING

from ril.config.fields import at_least
from ril.task import Task
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network


@dataclass
class NetworkConfig:
    """The architecture that policy and inverse dynamics model share (§4.1)."""

    hidden: list[int] = MISSING
    attention: bool = MISSING
    layer_norm: bool = MISSING
    negative_slope: float = at_least(0)


def mlp(config: NetworkConfig, inputs: int, outputs: int) -> MLP:
    """Build the architecture that policy and inverse dynamics model share (§4.1)."""
    return MLP(
        inputs,
        tuple(config.hidden),
        outputs,
        config.attention,
        config.layer_norm,
        config.negative_slope,
    )


def tanh_mlp(inputs: int, hidden: Sequence[int], outputs: int) -> MLP:
    """Build the network of PPO, ACKTR and GAIL's discriminator: Linear layers with tanh between."""
    return MLP(inputs, tuple(hidden), outputs, False, False, negative_slope=None)


def initial_policy(config: NetworkConfig, task: Task) -> Network:
    """Make the random policies π_φ that BC, IUPE and RIL begin with (Alg. 1, line 2)."""
    environment = task.environment
    topology = mlp(config, environment.observation_size, environment.action_count)
    return Network.initialize(topology, task.seeds, "policy", task.device)
