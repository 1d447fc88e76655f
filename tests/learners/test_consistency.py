from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of
from helpers.states import assert_equal_states, copied
from torch import Tensor, nn
from torch.nn import functional

from ril.learners.consistency import ConsistencyConfig, ConsistentLearning
from ril.vectorized.architectures import MLP, Consistent
from ril.vectorized.networks import Network, parameter_count
from ril.vectorized.replay import Replay, random_indices
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams

CPU = torch.device("cpu")
SEEDS = (0, 1)
SIZE, ACTIONS, BATCH = 2, 3, 8
TEMPERATURE, SCALE = 0.3, 4.0
VALUE = MLP(SIZE, (5,), 1)
ARCHITECTURE = Consistent(VALUE, MLP(SIZE, (6,), ACTIONS), TEMPERATURE, SCALE)
OF_VALUE = parameter_count(VALUE)
DISCOUNT, STEPS, TAU = 0.9, 3, 0.1
CLIP, RATE = 0.05, 0.01

needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "clang++", "c++")), reason="no C++ compiler"
)


def config(**changes: object) -> ConsistencyConfig:
    values: dict[str, Any] = {
        "learning_rate": RATE,
        "updates": 6,
        "batch_size": BATCH,
        "gradient_clip": CLIP,
        "discount": DISCOUNT,
        "loss": "huber",
        "n_steps": STEPS,
        "tau": TAU,
        "value_hidden": [5],
        "value_scale": SCALE,
        "temperature": TEMPERATURE,
        "gap": None,
        "imitation_weight": 1.0,
        "min_confidence": 0.0,
        "fade": True,
        "anneal": False,
        "replay_trajectories": 10.0,
        "replay_recent": None,
    }
    return ConsistencyConfig(**(values | changes))


def episodes(
    seeds: tuple[int, ...] = SEEDS, *, per_seed: int = 3, begin: int = 0, scale: float = 1.0
) -> Episodes:
    """Random ones, which depend on their own seed alone; every other one is truncated."""
    length, count = 12, len(seeds) * per_seed
    drawn = []
    for seed in seeds:
        numbers = np.random.default_rng([seed, begin])
        states = numbers.normal(size=(2, per_seed, length, SIZE)).astype(np.float32)
        lengths = numbers.integers(6, length + 1, size=per_seed)
        rewards = scale * numbers.normal(size=(per_seed, length)).astype(np.float32)
        rewards[np.arange(length) >= lengths[:, None]] = 0.0
        actions = numbers.integers(ACTIONS, size=(per_seed, length))
        drawn.append((states[0], actions, rewards, states[1], lengths))
    observations, actions, rewards, following, lengths = map(
        np.concatenate, zip(*drawn, strict=True)
    )
    terminated = np.zeros((count, length), dtype=bool)
    terminated[np.arange(count), lengths - 1] = np.arange(count) % per_seed % 2 == 0
    return Episodes(observations, actions, rewards, following, terminated, lengths)


def expert(seeds: tuple[int, ...] = SEEDS) -> tuple[Tensor, Tensor]:
    """States, and each seed's labels for them."""
    states = np.random.default_rng(5).normal(size=(11, SIZE)).astype(np.float32)
    labels = [np.random.default_rng([5, seed]).integers(ACTIONS, size=11) for seed in seeds]
    return torch.from_numpy(states), torch.from_numpy(np.stack(labels))


def weighing(weight: float, labels: Tensor | None = None) -> Tensor:
    """The same weight for each label, by default for those of `expert()`."""
    return torch.full((len(SEEDS), 11) if labels is None else labels.shape, weight)


def learner(
    seeds: tuple[int, ...] = SEEDS,
    *,
    architecture: Consistent = ARCHITECTURE,
    filled: bool = True,
    recent: int | None = None,
    compile_step: bool = False,
    **changes: object,
) -> ConsistentLearning:
    """A learner; a filled one remembers three episodes of each seed."""
    network = Network.initialize(architecture, seeds, "policy", CPU)
    with torch.no_grad():
        for name, parameter in network.parameters.items():
            if name.endswith("gamma"):  # at 0, Adam makes whole steps of what is but rounding
                parameter.fill_(0.5)
    replay = Replay(len(seeds), 60, SIZE, CPU)
    # Empty slots must never be used.
    replay.observations.fill_(torch.nan)
    learning = ConsistentLearning(
        network, replay, config(**changes), seeds, recent=recent, compile_step=compile_step
    )
    if filled:
        learning.remember(episodes(seeds))
    return learning


class Agent(nn.Module):
    """One seed's value and policy, whose values are V + τ·log π."""

    def __init__(self, value: nn.Sequential, policy: nn.Sequential) -> None:
        super().__init__()
        self.value, self.policy = value, policy

    def forward(self, states: Tensor) -> Tensor:
        log_chances = self.policy(states).softmax(dim=1).log()
        return SCALE * self.value(states) + TEMPERATURE * log_chances

    def flat(self) -> Tensor:
        return torch.cat([flat_of(self.value), flat_of(self.policy)])


def agents_of(flat: Tensor) -> list[Agent]:
    """Each seed's agent, of parameters of both streams (S, P)."""
    values = copies_of(Network(VALUE, flat[:, :OF_VALUE]))
    policies = copies_of(Network(ARCHITECTURE.policy, flat[:, OF_VALUE:]))
    return [Agent(*each) for each in zip(values, policies, strict=True)]


def drawn(learning: ConsistentLearning, numbers: Any) -> Tensor:
    """Slots for uniform numbers (S, updates, B); half of them of the newest, if any are to be."""
    sizes = learning.replay.sizes
    if learning.recent is None:
        return random_indices(numbers, sizes)
    whole, newest = np.split(numbers, 2, axis=-1)
    of_newest = learning.replay.newest(newest, learning.recent)
    return torch.cat((random_indices(whole, sizes), of_newest), dim=-1)


@pytest.mark.parametrize(("gap", "recent"), [(None, None), (0.1, None), (0.1, 7)])
@pytest.mark.parametrize("labeled", [True, False])
@pytest.mark.parametrize("loss", ["huber", "mse"])
def test_training_is_that_of_one_agent_per_seed(
    loss: str, labeled: bool, gap: float | None, recent: int | None
) -> None:
    learning = learner(loss=loss, gap=gap, recent=recent)
    # Targets further than the gap below the best action's value; of them those of that action.
    lifted, left = 0, 0
    states, labels = expert()
    agents, averages = agents_of(learning.network.flat), agents_of(learning.network.flat)
    numbers = np.random.default_rng(6)
    weights = {  # by the number of updates that they hold for
        updates: torch.from_numpy(numbers.random(labels.shape, dtype=np.float32))
        for updates in (6, 9)
    }
    rates = {6: RATE, 9: RATE / 2}
    found = [
        learning.train(
            updates,
            states,
            labels if labeled else None,
            weights[updates] if labeled else None,
            rates[updates],
        )
        for updates in weights
    ]

    batches, cloning = (Streams(SEEDS, f"{what} batches") for what in ("replay", "cloning"))
    optimizers = [Adam(agent, RATE, CLIP) for agent in agents]
    distance = {"huber": functional.huber_loss, "mse": functional.mse_loss}[loss]
    for (updates, each), (td_losses, cloning_losses) in zip(weights.items(), found, strict=True):
        slots = drawn(learning, batches.uniform(updates, BATCH))
        shown = random_indices(cloning.uniform(updates, BATCH), np.full(2, len(states)))
        for optimizer in optimizers:
            optimizer.optimizer.param_groups[0]["lr"] = rates[updates]
        totals = torch.zeros(2, len(SEEDS))
        for update in range(updates):
            for seed, (agent, average) in enumerate(zip(agents, averages, strict=True)):
                of_expert = shown[seed, update]
                here, actions, rewards, following, ended = (
                    field[seed, slots[seed, update]] for field in learning.replay.everything()
                )
                with torch.no_grad():
                    best = average(following).max(dim=1).values
                    target = rewards + DISCOUNT**STEPS * (1 - ended) * best
                    before = average(here)
                    for i in range(BATCH) if gap is not None else ():
                        least = before[i].max() - gap
                        if target[i] < least and before[i].argmax() == actions[i]:
                            left += 1
                        elif target[i] < least:
                            target[i], lifted = least, lifted + 1
                values = agent(here)
                td = distance(values[torch.arange(BATCH), actions], target)
                total, totals[0, seed] = td, totals[0, seed] + td.detach()
                if labeled:
                    logits = agent(states[of_expert]) / TEMPERATURE
                    imitated = functional.cross_entropy(
                        logits, labels[seed, of_expert], reduction="none"
                    )
                    total = td + (each[seed, of_expert] * imitated).mean()
                    totals[1, seed] += imitated.detach().mean()
                optimizers[seed].step(total)
                with torch.no_grad():
                    pairs = zip(average.parameters(), agent.parameters(), strict=True)
                    for old, new in pairs:
                        old.lerp_(new, TAU)
        expected = totals / updates
        torch.testing.assert_close(td_losses, expected[0], rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(cloning_losses, expected[1], rtol=1e-3, atol=1e-5)
    assert (lifted > 0) == (left > 0) == (gap is not None)
    flats, of_averages = (torch.stack([a.flat() for a in each]) for each in (agents, averages))
    torch.testing.assert_close(learning.network.flat, flats, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(
        learning.policy.flat, of_averages[:, OF_VALUE:], rtol=1e-3, atol=1e-5
    )
    torch.testing.assert_close(learning.average.flat, of_averages, rtol=1e-3, atol=1e-5)


def level(network: Network, value: float) -> None:
    """Make V the same everywhere, and all actions as likely."""
    with torch.no_grad():
        for name, parameter in network.parameters.items():
            if name.startswith("output"):
                parameter.fill_(value / SCALE if name == "output.value.bias" else 0.0)


def test_half_of_each_minibatch_is_of_its_newest_steps() -> None:
    """Rewards tell where transitions come from; with γ = 0 and no slope yet, losses are theirs."""
    learning = learner(recent=1, discount=0.0, n_steps=1, loss="mse")
    learning.replay.rewards.fill_(1.0)
    learning.replay.rewards[torch.arange(2), learning.replay.newest(np.zeros((2, 1)), 1)[:, 0]] = 9
    level(learning.network, 0.0)
    value = TEMPERATURE * np.log(1 / ACTIONS)
    td_losses, _ = learning.train(1, expert()[0], None, None, RATE)
    nine, one = (9 - value) ** 2, (1 - value) ** 2
    # Of the other half, one or two may be the newest, too.
    possible = ((nine + one) / 2 + (nine - one) * np.array([0, 1, 2]) / BATCH).tolist()
    for found in td_losses.tolist():
        assert found in [pytest.approx(each, rel=1e-4) for each in possible]


def test_the_next_value_counts_by_the_number_of_steps() -> None:
    """Rewards are 0, V is 1 and all actions as likely: what is left is γ to their power."""
    learning = learner(loss="mse")
    learning.replay.rewards.fill_(0.0)
    learning.replay.terminated.fill_(0.0)
    level(learning.network, 1.0)
    level(learning.average, 1.0)
    value = 1 + TEMPERATURE * np.log(1 / ACTIONS)
    td_losses, _ = learning.train(1, expert()[0], None, None, RATE)
    error = value * (1 - DISCOUNT**STEPS)
    assert td_losses.tolist() == pytest.approx([error**2] * 2, rel=1e-4)


def test_a_seeds_training_does_not_depend_on_other_seeds() -> None:
    flats = []
    for seeds in ((5,), (3, 5, 9)):
        learning = learner(seeds)
        states, labels = expert(seeds)
        learning.train(10, states, labels, weighing(1.0, labels), RATE)
        flats.append((learning.network.flat, learning.policy.flat))
    for of_alone, of_several in zip(*flats, strict=True):
        assert torch.equal(of_several[1], of_alone[0])


def test_without_weight_labels_leave_the_training_as_without_them() -> None:
    with_labels, without = learner(), learner()
    states, labels = expert()
    td_losses = []
    for learning, given in ((with_labels, labels), (without, None)):
        td_loss, cloning_loss = learning.train(12, states, given, weighing(0.0), RATE)
        td_losses.append(td_loss)
        assert cloning_loss.any() == (given is not None)
    assert torch.equal(*td_losses)
    assert torch.equal(with_labels.network.flat, without.network.flat)
    assert torch.equal(with_labels.policy.flat, without.policy.flat)


def test_weight_makes_a_difference() -> None:
    flats = []
    for weight in (0.0, 0.5, 1.0):
        learning = learner()
        learning.train(3, *expert(), weighing(weight), RATE)
        flats.append(learning.network.flat)
    assert not torch.equal(flats[0], flats[1])
    assert not torch.equal(flats[1], flats[2])


def test_a_label_without_weight_is_not_imitated() -> None:
    """Its value does not matter: training uses the others only."""
    states, labels = expert()
    weights = weighing(1.0, labels)
    weights[:, ::2] = 0.0
    flats = []
    for given in (labels, torch.where(weights > 0, labels, (labels + 1) % ACTIONS)):
        learning = learner()
        learning.train(6, states, given, weights, RATE)
        flats.append(learning.network.flat)
    assert torch.equal(*flats)


def test_labels_are_imitated() -> None:
    """By the policy that acts; and by the more of them, the more they weigh."""
    states, labels = expert()
    agreement = []
    for weight in (0.0, 10.0):
        learning = learner(tau=0.05, gradient_clip=None)
        learning.train(400, states, labels, weighing(weight), RATE)
        greedy = learning.policy(states.expand(2, -1, -1)).argmax(dim=-1)
        agreement.append((greedy == labels).float().mean().item())
    assert agreement[0] < 0.7 < 0.9 < agreement[1]


def rewards_in(replay: Replay, seed: int) -> list[float]:
    return replay.rewards[seed, : replay.sizes[seed]].tolist()


def rewards_of_a_loop(played: Episodes, unit: float) -> list[float]:
    """Of one seed's transitions over n steps, in their order."""
    found = []
    for k, (length, ended) in enumerate(zip(played.lengths, played.ends, strict=True)):
        for t in range(length if ended else length - STEPS + 1):
            ahead = range(min(STEPS, length - t))
            found.append(sum(DISCOUNT**i * float(played.rewards[k, t + i]) for i in ahead) / unit)
    return found


def of_seed(played: Episodes, index: int, per_seed: int = 3) -> Episodes:
    rows = slice(index * per_seed, (index + 1) * per_seed)
    return Episodes(*(values[rows] for values in vars(played).values()))


def mean_size(played: Episodes) -> float:
    """Mean |reward| of the steps of one seed's episodes."""
    sizes = [
        abs(reward)
        for rewards, length in zip(played.rewards.tolist(), played.lengths, strict=True)
        for reward in rewards[:length]
    ]
    return sum(sizes) / len(sizes)


def test_rewards_are_remembered_in_units_of_their_size_in_the_first_episodes() -> None:
    learning = learner(filled=False)
    first = episodes(scale=7.0)
    learning.remember(first)
    for seed in range(len(SEEDS)):
        own = of_seed(first, seed)
        unit = mean_size(own)
        assert unit > 3
        assert learning.reward_scale[seed].item() == pytest.approx(unit)
        expected = rewards_of_a_loop(own, unit)
        assert rewards_in(learning.replay, seed) == pytest.approx(expected, rel=1e-4, abs=1e-5)
    assert learning.reward_scale[0] != learning.reward_scale[1]


def test_later_episodes_do_not_change_the_unit() -> None:
    learning = learner(filled=False)
    first, later = episodes(scale=7.0), episodes(begin=1, scale=0.01)
    learning.remember(first)
    before, stored = learning.reward_scale.clone(), learning.replay.sizes.copy()
    learning.train(3, *expert(), weighing(1.0), RATE)
    learning.remember(later)
    assert torch.equal(learning.reward_scale, before)
    for seed in range(len(SEEDS)):
        found = rewards_in(learning.replay, seed)[stored[seed] :]
        expected = rewards_of_a_loop(of_seed(later, seed), mean_size(of_seed(first, seed)))
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_where_all_rewards_are_0_the_unit_is_1_for_good() -> None:
    learning = learner(filled=False)
    learning.remember(episodes(scale=0.0))
    assert learning.reward_scale.tolist() == [1.0, 1.0]
    learning.remember(episodes(begin=1, scale=100.0))
    assert learning.reward_scale.tolist() == [1.0, 1.0]


def policy_stream_of(flat: Tensor) -> Tensor:
    """(S, B, |A|) logits of the policies among parameters of both streams (S, P)."""
    states = expert()[0]
    with torch.no_grad():
        return torch.stack([agent.policy(states) for agent in agents_of(flat)])


def logits_of(learning: ConsistentLearning) -> Tensor:
    return learning.policy(expert()[0].expand(2, -1, -1)).detach()


def test_the_policy_begins_as_the_networks_own() -> None:
    learning = learner()
    expected = policy_stream_of(learning.network.flat)
    torch.testing.assert_close(logits_of(learning), expected)
    assert learning.policy.architecture == ARCHITECTURE.policy


def test_the_policy_is_that_of_the_average_and_moves_with_it() -> None:
    learning = learner()
    before = logits_of(learning)
    learning.train(10, *expert(), weighing(1.0), RATE)
    average = learning.average.flat
    torch.testing.assert_close(logits_of(learning), policy_stream_of(average))
    assert not torch.allclose(logits_of(learning), before)
    assert not torch.allclose(logits_of(learning), policy_stream_of(learning.network.flat))


def test_the_policy_lies_in_the_averages_memory() -> None:
    learning = learner()
    learning.policy.flat.fill_(0.25)
    average = learning.average.flat
    assert (average[:, OF_VALUE:] == 0.25).all()
    assert not (average[:, :OF_VALUE] == 0.25).any()


def test_where_the_average_moves_all_the_way_the_policy_is_the_networks_own() -> None:
    learning = learner(tau=1.0)
    learning.train(5, *expert(), weighing(1.0), RATE)
    torch.testing.assert_close(learning.policy.flat, learning.network.flat[:, OF_VALUE:])


def test_a_loaded_state_resumes_bit_identically() -> None:
    learning = learner()
    states, labels = expert()
    learning.train(6, states, labels, weighing(1.0), RATE)
    resumed = learner(filled=False)
    resumed.load_state_dict(copied(learning.state_dict()))
    assert_equal_states(copied(resumed.state_dict()), copied(learning.state_dict()))
    assert torch.equal(resumed.policy.flat, learning.policy.flat)
    losses = []
    for each in (learning, resumed):
        each.remember(episodes(begin=1, scale=3.0))  # in the first ones' unit
        losses.append(each.train(5, states, labels, weighing(0.5), RATE))
    assert all(map(torch.equal, *losses))
    assert torch.equal(resumed.policy.flat, learning.policy.flat)
    assert_equal_states(copied(resumed.state_dict()), copied(learning.state_dict()))


# Sizes as in conf/, since which kernel multiplies depends on them. But values are small: where all
# slopes of Huber's loss are ±1, gradients may cancel, and Adam makes whole steps of the rest.
AS_CONFIGURED = Consistent(MLP(SIZE, (64, 64), 1), MLP(SIZE, (8, 8), ACTIONS), 0.1, 1.0)


def trained(seeds: tuple[int, ...], labeled: bool, *, compile_step: bool) -> list[Tensor]:
    """Parameters of network and average, and losses, after two parts of a training."""
    learning = learner(
        seeds,
        architecture=AS_CONFIGURED,
        recent=10,
        compile_step=compile_step,
        batch_size=64,
        gap=0.3,
    )
    states, labels = expert(seeds)
    given = labels if labeled else None
    losses = [
        torch.stack(learning.train(updates, states, given, weighing(weight, labels), rate))
        for updates, weight, rate in ((12, 0.7, 1e-3), (8, 0.2, 3e-4))
    ]
    return [learning.network.flat, learning.average.flat, *losses]


@pytest.fixture(scope="module", params=[True, False], ids=["labeled", "rewards alone"])
def among(request: pytest.FixtureRequest) -> tuple[bool, list[Tensor]]:
    """Whether there are labels, and what a compiled training of three seeds gave."""
    return request.param, trained((3, 5, 9), request.param, compile_step=True)


@needs_compiler
def test_compiled_training_is_the_eager_one_but_for_rounding(among: Any) -> None:
    labeled, found = among
    expected = trained((3, 5, 9), labeled, compile_step=False)
    before = learner((3, 5, 9), architecture=AS_CONFIGURED).network.flat
    assert (expected[0] - before).abs().max() > 0.01  # many times the tolerance
    assert not all(map(torch.equal, found, expected))  # so it was compiled
    for values, of_eager in zip(found, expected, strict=True):
        torch.testing.assert_close(values, of_eager, rtol=1e-3, atol=1e-4)


@needs_compiler
def test_a_seeds_compiled_training_does_not_depend_on_other_seeds(among: Any) -> None:
    labeled, (network, average, *losses) = among
    alone_network, alone_average, *alone_losses = trained((5,), labeled, compile_step=True)
    assert torch.equal(network[1], alone_network[0])
    assert torch.equal(average[1], alone_average[0])
    for of_several, of_alone in zip(losses, alone_losses, strict=True):
        assert torch.equal(of_several[:, 1], of_alone[:, 0])
