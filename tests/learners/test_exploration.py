from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import copied
from torch import Tensor

from ril.config.schema import Config
from ril.learners.exploration import Explorer, epsilon_greedy, exploration_ratio, sample_softmax
from ril.task import Task
from ril.vectorized import networks
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network

pytestmark = pytest.mark.quick

BELOW_ONE = 1 - 2**-24  # the largest number that a stream's uniform numbers reach


def test_softmax_samples_have_its_probabilities() -> None:
    logits = torch.tensor([0.3, -1.0, 2.0, 0.0])
    grid = (torch.arange(10_000) + 0.5) / 10_000
    actions = sample_softmax(logits.expand(10_000, 4), grid)
    shares = torch.bincount(actions, minlength=4) / 10_000
    torch.testing.assert_close(shares, logits.softmax(dim=0), rtol=0, atol=2e-4)


@pytest.mark.parametrize("size", [2, 3, 7, 18])
def test_softmax_samples_are_actions_even_close_to_one(size: int) -> None:
    logits = torch.randn(5_000, size, generator=torch.Generator().manual_seed(0))
    # Rounding leaves some sums of probabilities below the number that is drawn.
    assert (logits.softmax(dim=-1).cumsum(dim=-1)[:, -1] <= BELOW_ONE).any()
    actions = sample_softmax(logits, torch.full((5_000,), BELOW_ONE))
    assert (actions == size - 1).all()


@pytest.mark.parametrize(("number", "likely"), [(0.0, 1), (0.5, 1), (BELOW_ONE, 1)])
def test_softmax_samples_never_take_the_impossible(number: float, likely: int) -> None:
    logits = torch.tensor([[-1000.0, 0.0, -1000.0]])
    assert sample_softmax(logits, torch.tensor([number])).item() == likely


LOGITS = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(1))
UNIFORM = torch.rand(2, 2, 50, generator=torch.Generator().manual_seed(2))


def explored(epsilon: list[float], kind: str) -> Tensor:
    return epsilon_greedy(LOGITS, torch.tensor(epsilon), UNIFORM, kind)


@pytest.mark.parametrize("kind", ["softmax", "uniform"])
def test_without_epsilon_actions_are_greedy(kind: str) -> None:
    assert torch.equal(explored([0.0, 0.0], kind), LOGITS.argmax(dim=-1))


def test_with_epsilon_one_actions_are_softmax_samples() -> None:
    assert torch.equal(explored([1.0, 1.0], "softmax"), sample_softmax(LOGITS, UNIFORM[1]))


def test_with_epsilon_one_actions_are_uniform() -> None:
    grid = ((torch.arange(600) + 0.5) / 600).expand(2, 1, 600)
    actions = epsilon_greedy(torch.randn(1, 600, 3), torch.ones(1), grid, "uniform")
    assert torch.bincount(actions.flatten()).tolist() == [200] * 3


def test_epsilon_is_the_chance_to_explore() -> None:
    whether = ((torch.arange(1000) + 0.5) / 1000)[None]
    what = torch.full((1, 1000), BELOW_ONE)  # the last action
    logits = torch.tensor([9.0, 0.0]).expand(1, 1000, 2)
    actions = epsilon_greedy(logits, torch.tensor([0.3]), torch.stack((whether, what)), "uniform")
    assert actions.sum().item() == 300


def test_epsilon_is_of_each_seed() -> None:
    actions, greedy = explored([0.0, 1.0], "softmax"), LOGITS.argmax(dim=-1)
    assert torch.equal(actions[0], greedy[0])
    assert not torch.equal(actions[1], greedy[1])


GRID = ((np.arange(1000) + 0.5) / 1000).astype(np.float32)[None]


def test_a_certain_policy_does_not_explore() -> None:
    logits = torch.tensor([0.0, 200.0, 0.0]).expand(1, 1000, 3)
    assert exploration_ratio(logits, GRID).tolist() == [0.0]


@pytest.mark.parametrize("actions", [2, 4, 5])
def test_an_undecided_policy_explores_all_but_the_greedy_action(actions: int) -> None:
    ratio = exploration_ratio(torch.zeros(1, 1000, actions), GRID)
    assert ratio.tolist() == pytest.approx([1 - 1 / actions], abs=1e-3)


def test_exploration_ratio_is_the_mass_beside_the_greedy_action() -> None:
    probabilities = torch.tensor([0.1, 0.25, 0.65])
    ratio = exploration_ratio(probabilities.log().expand(1, 1000, 3), GRID)
    assert ratio.tolist() == pytest.approx([0.35], abs=2e-3)


def test_exploration_ratio_is_of_each_seed() -> None:
    logits = torch.tensor([[[0.0, 0.0]], [[200.0, 0.0]]]).expand(2, 1000, 2)
    ratio = exploration_ratio(logits, np.concatenate((GRID, GRID)))
    assert ratio.tolist() == pytest.approx([0.5, 0.0], abs=1e-3)


@pytest.fixture
def explorer(quick: Any, make_task: Callable[[Config], Task]) -> Callable[..., Explorer]:
    def made(*overrides: str) -> Explorer:
        config = quick("seeds=[3,5]", *overrides)
        task = make_task(config)
        policy = Network.initialize(MLP(4, (8,), 2), task.seeds, "policy", task.device)
        return Explorer(config.method.exploration, task, policy)

    return made


def test_without_epsilon_an_explorer_plays_greedily(explorer: Any) -> None:
    one = explorer()
    episodes = one.play(np.zeros(2))
    for seed, length in enumerate(episodes.lengths):
        both = np.stack([episodes.observations[seed, :length]] * 2)
        greedy = networks.greedy(one.policy.infer(both.reshape(-1, 4))).reshape(2, length)[seed]
        np.testing.assert_array_equal(episodes.actions[seed, :length], greedy)


def test_an_explorer_departs_from_the_greedy_action_as_often_as_epsilon_says(explorer: Any) -> None:
    one = explorer("method.exploration.kind=uniform")
    departures = []
    for _ in range(40):
        episodes = one.play(np.full(2, 0.4))
        for seed, length in enumerate(episodes.lengths):
            both = np.stack([episodes.observations[seed, :length]] * 2)
            greedy = networks.greedy(one.policy.infer(both.reshape(-1, 4))).reshape(2, length)[seed]
            departures += (episodes.actions[seed, :length] != greedy).tolist()
    assert len(departures) > 700
    assert np.mean(departures) == pytest.approx(0.2, abs=0.05)  # half of what is uniform is greedy


def test_each_episode_has_a_start_of_its_own(explorer: Any) -> None:
    one = explorer()
    starts = np.concatenate([one.play(np.ones(2)).observations[:, 0] for _ in range(5)])
    assert len(np.unique(starts, axis=0)) == 10


def test_an_explorers_loaded_state_resumes_bit_identically(explorer: Any) -> None:
    one, resumed = explorer(), explorer()
    for _ in range(3):
        one.play(np.ones(2))
    resumed.load_state_dict(copied(one.state_dict()))
    found, expected = resumed.play(np.ones(2)), one.play(np.ones(2))
    np.testing.assert_array_equal(found.observations, expected.observations)
    np.testing.assert_array_equal(found.actions, expected.actions)
