"""(a) The cost of one network's update: alone, in a batch of seeds, and compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import nn
from torch.nn import functional

from bench.clock import in_turns, seconds, table
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.streams import Streams

CPU = torch.device("cpu")
STORED, BATCH, HIDDEN, DISCOUNT, RATE = 10_000, 64, 32, 0.99, 1e-3
SEEDS = (1, 10, 70)


def one_eager_model() -> Callable[[], None]:
    """Return a usual update of Q-learning: one module, its target network, torch's Adam."""

    def module() -> nn.Module:
        return nn.Sequential(
            *(nn.Linear(2, HIDDEN), nn.LayerNorm(HIDDEN), nn.LeakyReLU()),
            *(nn.Linear(HIDDEN, HIDDEN), nn.LayerNorm(HIDDEN), nn.LeakyReLU()),
            nn.Linear(HIDDEN, 3),
        )

    policy, target = module(), module()
    adam = torch.optim.Adam(policy.parameters(), RATE)
    states, following = torch.randn(2, STORED, 2)
    actions, rewards = torch.randint(3, (STORED,)), torch.randn(STORED)
    ends = torch.zeros(STORED)

    def update() -> None:
        at = torch.randint(STORED, (BATCH,))
        with torch.no_grad():
            best = target(following[at]).amax(dim=1)
            targets = rewards[at] + DISCOUNT * (1 - ends[at]) * best
        values = policy(states[at]).gather(1, actions[at, None]).squeeze(1)
        loss = functional.smooth_l1_loss(values, targets)
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_value_(policy.parameters(), 1.0)
        adam.step()

    return update


def batched(seeds: int, *, compiled: bool) -> Callable[[], None]:
    """Return ril's same update of several networks together."""
    network = MLP(2, (HIDDEN, HIDDEN), 3, attention=False)
    policy = Network.initialize(network, range(seeds), "policy", CPU)
    memory = Replay(seeds, STORED, 2, CPU)
    for field in (memory.observations, memory.next_observations, memory.rewards):
        field.normal_()
    memory.actions.random_(3)
    memory.sizes[:] = STORED
    config = TargetNetworkConfig(RATE, 1, BATCH, 1.0, DISCOUNT, "huber", 300)
    streams = Streams(range(seeds), "batches")
    learner = QLearning(policy, memory, config, streams, compile_step=compiled)
    return partial(learner.train, 1)


def floor(seeds: int) -> float:
    """Return the seconds of the update's multiplications at the rate of large matrices."""
    size, times = 256, 20
    a, b = torch.randn(2, size, size)
    rate = 2 * size**3 / seconds(lambda: a @ b, times)
    first, hidden, last = 2 * HIDDEN, HIDDEN * HIDDEN, HIDDEN * 3
    forward = first + hidden + last
    backward = forward + hidden + last  # of weights, and of inputs of all layers but the first
    return seeds * 2 * BATCH * (2 * forward + backward) / rate


def measured(rounds: int) -> tuple[str, float]:
    """Measure (a); return its table, and the speed-up of ten compiled seeds over modules."""
    alone = one_eager_model()
    works = {("eager", s): batched(s, compiled=False) for s in SEEDS}
    works |= {("compiled", s): batched(s, compiled=True) for s in SEEDS}
    for work in (alone, *works.values()):
        seconds(work, 20)  # compiles
    sides = {
        f"{how} {s}": partial(seconds, work, 2000 // (s + 9)) for (how, s), work in works.items()
    }
    sides |= {"alone": partial(seconds, alone, 200)}
    sides |= {f"floor {s}": partial(floor, s) for s in SEEDS}
    took = in_turns(sides, rounds)
    one = took["alone"]
    rows = [("one module, eager, `torch.optim.Adam`", "1", f"{one * 1e6:,.0f}", "1.0×")]
    for how, name in (
        ("eager", "ril, `compile=false`"),
        ("compiled", "ril, `compile=true`"),
        ("floor", "its multiplications alone, at the rate of large matrices"),
    ):
        for s in SEEDS:
            each = took[f"{how} {s}"] / s
            rows.append((name, str(s), f"{each * 1e6:,.1f}", f"{one / each:,.1f}×"))
    head = ("an update of Q-learning", "seeds", "µs per seed", "against one module")
    return table(head, rows), 10 * one / took["compiled 10"]
