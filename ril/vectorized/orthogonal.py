"""Orthogonal initialization of actor-critics, as in Stable-Baselines3."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ril.vectorized.architectures import ActorCritic
from ril.vectorized.networks import Network, parameter_count
from ril.vectorized.streams import Streams


def orthogonal(
    architecture: ActorCritic, seeds: Sequence[int], purpose: str, device: torch.device
) -> Network:
    """Make networks with orthogonal weights, as Stable-Baselines3 initializes them.

    Rows or columns, whichever are fewer, are orthogonal. Their norm is √2 in hidden layers, 0.01
    in the policy's last layer, so that all actions are about equally likely at first, and 1 in the
    value function's. Biases are 0.

    Args:
        architecture: the architecture of each network.
        seeds: S seeds; equal seeds and purpose give equal networks.
        purpose: names the stream of random numbers.
        device: device of the parameters.
    """
    streams = Streams(seeds, purpose)
    network = Network(architecture, torch.zeros(len(seeds), parameter_count(architecture)))
    gains = {"output.actor.weight": 0.01, "output.critic.weight": 1.0}
    with torch.no_grad():
        for name, parameter in network.parameters.items():
            if name.endswith("bias"):
                continue
            rows, columns = parameter.shape[1:]
            # torch's decomposition, not NumPy's, has the same digits on every machine.
            normal = torch.from_numpy(streams.normal(max(rows, columns), min(rows, columns)))
            q, r = torch.linalg.qr(normal)
            # With the signs of R's diagonal, Q is uniform over all orthogonal matrices.
            q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
            parameter.copy_(gains.get(name, math.sqrt(2)) * (q if rows >= columns else q.mT))
    return Network(architecture, network.flat.to(device))
