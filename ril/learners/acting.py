"""ε-greedy actions, one of each seed, eager or by one compiled graph."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ril.environments.environment import Floats, Integers
from ril.learners.exploration import epsilon_greedy
from ril.vectorized.compiling import compile_graph, pad_rows, with_fallback
from ril.vectorized.networks import Network, by_name

#: From observations (S, obs), ε (S,) and random numbers (2, S, 1) in [0, 1) to actions (S,).
Act = Callable[[Floats, Tensor, Tensor], Integers]


def acting(policy: Network, kind: str, *, compiled: bool) -> Act:
    """Make the function that chooses an ε-greedy action for each of S seeds.

    Args:
        policy: its outputs are Q-values or logits.
        kind: distribution of exploring actions, as for `epsilon_greedy`.
        compiled: whether the forward pass and the choice are one compiled graph. Its outputs differ
            from the eager ones in the last bits.
    """

    def eager(observations: Floats, epsilon: Tensor, uniform: Tensor) -> Integers:
        actions = epsilon_greedy(policy.infer(observations), epsilon, uniform, kind)
        return actions[:, 0].cpu().numpy()

    if not compiled:
        return eager

    @compile_graph
    def graph(flat: Tensor, observations: Tensor, epsilon: Tensor, uniform: Tensor) -> Tensor:
        parameters = by_name(policy.architecture, flat)
        outputs = policy.architecture.forward(parameters, pad_rows(observations))
        # All rows are returned: without the padding ones, the number of seeds would change digits.
        return epsilon_greedy(outputs, epsilon, uniform, kind)

    @torch.no_grad()
    def in_one_call(observations: Floats, epsilon: Tensor, uniform: Tensor) -> Integers:
        rows = torch.from_numpy(observations).to(policy.flat.device)[:, None]
        actions: Integers = graph(policy.flat, rows, epsilon, uniform).cpu().numpy()
        return actions[:, 0]

    return with_fallback(in_one_call, eager)
