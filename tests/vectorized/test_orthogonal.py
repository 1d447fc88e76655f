from __future__ import annotations

import torch
from torch import nn

from ril.vectorized.architectures import MLP, ActorCritic
from ril.vectorized.orthogonal import orthogonal

CPU = torch.device("cpu")
SEEDS = (3, 7)


def test_weights_are_orthogonal_and_biases_are_0() -> None:
    network = orthogonal(ActorCritic(mlp((32, 16), 3), mlp((32, 16), 1)), SEEDS, "ppo", CPU)
    for name, parameter in network.parameters.items():
        for one in parameter.detach():
            if name.endswith("bias"):
                assert not one.any()
                continue
            few = one if one.shape[0] <= one.shape[1] else one.T
            gain = {"output.actor.weight": 0.01, "output.critic.weight": 1.0}.get(name, 2**0.5)
            torch.testing.assert_close(few @ few.T, gain**2 * torch.eye(len(few)), msg=name)


def mlp(hidden: tuple[int, ...], outputs: int) -> MLP:
    return MLP(6, hidden, outputs, attention=False, layer_norm=False, negative_slope=None)


def test_weights_are_uniform_over_orthogonal_matrices() -> None:
    """Their entries have the moments of torch's own initialization."""
    architecture = ActorCritic(mlp((4,), 2), mlp((4,), 1))
    ours = orthogonal(architecture, range(4000), "ppo", CPU).parameters["linear0.actor.weight"]
    torch.manual_seed(0)
    theirs = torch.stack([nn.init.orthogonal_(torch.empty(6, 4), 2**0.5) for _ in range(4000)])
    for power in (1, 2, 4):
        found, expected = (w.detach().pow(power).mean(dim=0) for w in (ours, theirs))
        torch.testing.assert_close(found, expected, rtol=0.2, atol=0.05)


def test_a_seeds_initial_networks_do_not_depend_on_other_seeds() -> None:
    architecture = ActorCritic(mlp((64, 64), 3), mlp((64, 64), 1))
    among = orthogonal(architecture, (3, 5, 9), "ppo", CPU).flat
    assert torch.equal(orthogonal(architecture, (5,), "ppo", CPU).flat[0], among[1])
    assert not torch.equal(among[0], among[1])
