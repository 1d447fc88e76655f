"""Save and load trained policies: `load_policy("outputs/…/policy.pt", seed=0)`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.environments.environment import Environment, Floats
from ril.io.errors import UserError
from ril.io.files import tensor_bytes, write_atomically
from ril.vectorized.architectures import MLP, Dueling, Standardized
from ril.vectorized.latent_networks import ActionRemapping, LatentDynamics, LatentPolicy
from ril.vectorized.networks import Architecture, Network

_ARCHITECTURES: dict[str, type[Architecture]] = {
    kind.__name__: kind
    for kind in (MLP, Dueling, Standardized, LatentPolicy, LatentDynamics, ActionRemapping)
}


class Policy:
    """The trained policy of one seed, for raw observations.

    Attributes:
        env_id: the id of the Gymnasium environment in which it was trained.
    """

    def __init__(self, env_id: str, network: Network, low: Tensor, high: Tensor) -> None:
        self.env_id = env_id
        self._network = network
        self._center, self._half = (high + low) / 2, (high - low) / 2

    @torch.no_grad()
    def values(self, observations: Floats) -> Floats:
        """Return the outputs (N, |A|), logits or Q-values, for raw observations (N, obs)."""
        raw = torch.as_tensor(observations, dtype=torch.float32)
        values: Floats = self._network(((raw - self._center) / self._half)[None])[0].numpy()
        return values

    def probabilities(self, observations: Floats) -> Floats:
        """Return softmax probabilities (N, |A|) for raw observations (N, obs)."""
        values = torch.from_numpy(self.values(observations))
        probabilities: Floats = values.softmax(dim=-1).numpy()
        return probabilities

    def predict(self, observations: Floats) -> NDArray[np.int64]:
        """Return greedy actions (N,) for raw observations (N, obs), or () for one (obs,)."""
        batch = np.atleast_2d(observations)
        actions: NDArray[np.int64] = self.values(batch).argmax(axis=-1)
        return actions.reshape(np.shape(observations)[:-1])


def save_policies(
    path: Path,
    environment: Environment,
    architecture: Architecture,
    seeds: Sequence[int],
    *,
    best: Tensor,
    last: Tensor,
) -> None:
    """Write the best and last policies of all seeds, as tensors and plain values only.

    Args:
        path: the file to write.
        environment: the environment in which the policies act.
        architecture: the architecture that all policies have.
        seeds: the S seeds.
        best: (S, P) parameters of each seed's best policy.
        last: (S, P) parameters of each seed's last policy.
    """
    content = {
        "env_id": environment.config.id,
        "observation_low": torch.from_numpy(environment.low),
        "observation_high": torch.from_numpy(environment.high),
        "architecture": _described(architecture),
        "seeds": list(seeds),
        "best": best.cpu(),
        "last": last.cpu(),
    }
    write_atomically(path, tensor_bytes(content))


def _described(architecture: Architecture) -> dict[str, Any]:
    """Describe an architecture and its nested architectures by plain values."""
    plain: dict[str, Any] = {"kind": type(architecture).__name__}
    for field in fields(architecture):
        value = getattr(architecture, field.name)
        plain[field.name] = _described(value) if type(value).__name__ in _ARCHITECTURES else value
    return plain


def _built(description: dict[str, Any]) -> Architecture:
    """Build an architecture from its description."""
    values: dict[str, Any] = {
        k: _built(v) if isinstance(v, dict) else v for k, v in description.items()
    }
    kind: str = values.pop("kind")
    return _ARCHITECTURES[kind](**values)


def load_policy(path: str | Path, seed: int, which: str = "best") -> Policy:
    """Load one seed's policy from a run's `policy.pt`; no code in the file is executed.

    Args:
        path: the file to read.
        seed: one of the run's seeds.
        which: "best" or "last".

    Raises:
        UserError: the file cannot be read, or does not hold that seed's policy.
    """
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        seeds = content["seeds"]
        architecture = _built(content["architecture"])
    except Exception as error:
        raise UserError(f"{path}: not a policy that ril saved ({type(error).__name__})") from None
    if seed not in seeds:
        raise UserError(f"seed={seed}: {path} has {seeds}")
    if which not in ("best", "last"):
        raise UserError(f"which={which}: must be best or last")
    index = seeds.index(seed)
    network = Network(architecture, content[which][index : index + 1].clone())
    return Policy(
        content["env_id"], network, content["observation_low"], content["observation_high"]
    )
