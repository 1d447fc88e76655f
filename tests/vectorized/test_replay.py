from __future__ import annotations

import io
from collections import deque

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ril.vectorized.replay import Replay, random_indices
from ril.vectorized.rollout import Episodes

OBS = 2
CPU = torch.device("cpu")
BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))


def numbered_episodes(lengths: list[int], first: int = 0) -> Episodes:
    """Episodes whose transitions all differ; what lies beyond an episode's end is −1."""
    shape = (len(lengths), max(lengths))
    numbers = first + np.arange(np.prod(shape)).reshape(shape)
    beyond = np.arange(shape[1]) >= np.array(lengths)[:, None]
    numbers = np.where(beyond, -1, numbers)
    states = np.stack([numbers, numbers + 0.5], axis=-1).astype(np.float32)
    terminated = (numbers % 3 == 0) & ~beyond
    return Episodes(
        states, numbers % 5, numbers.astype(np.float32), states + 1, terminated, np.array(lengths)
    )


def transitions(episodes: Episodes, episode: int) -> list[tuple[float, ...]]:
    """One episode's transitions as plain tuples, oldest first."""
    return [
        (
            *episodes.observations[episode, step].tolist(),
            int(episodes.actions[episode, step]),
            float(episodes.rewards[episode, step]),
            *episodes.next_observations[episode, step].tolist(),
            float(episodes.terminated[episode, step]),
        )
        for step in range(episodes.lengths[episode])
    ]


def stored(replay: Replay, seed: int) -> list[tuple[float, ...]]:
    """What the filled slots of a seed hold, as plain tuples."""
    fields = replay.everything()
    return [
        (
            *fields.observations[seed, slot].tolist(),
            int(fields.actions[seed, slot]),
            float(fields.rewards[seed, slot]),
            *fields.next_observations[seed, slot].tolist(),
            float(fields.terminated[seed, slot]),
        )
        for slot in range(replay.sizes[seed])
    ]


#: Rounds of one seed-major batch of episodes each: lengths, and which of them are kept.
rounds = st.lists(
    st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=4, max_size=4), max_size=6
)


@given(rounds=rounds, capacity=st.integers(1, 9))
def test_each_seed_holds_its_newest_transitions(
    rounds: list[list[tuple[int, bool]]], capacity: int
) -> None:
    replay = Replay(2, capacity, OBS, CPU)
    models = [deque(maxlen=capacity), deque(maxlen=capacity)]
    for number, batch in enumerate(rounds):
        episodes = numbered_episodes([length for length, _ in batch], first=100 * number)
        keep = np.array([kept for _, kept in batch])
        replay.append(episodes, keep=keep)
        for episode in np.flatnonzero(keep):
            models[episode // 2].extend(transitions(episodes, int(episode)))
    for seed, model in enumerate(models):
        assert sorted(stored(replay, seed)) == sorted(model)


@given(lengths=st.lists(st.integers(1, 12), min_size=1, max_size=5), capacity=st.integers(1, 9))
def test_all_episodes_are_appended_without_keep(lengths: list[int], capacity: int) -> None:
    replay, model = Replay(1, capacity, OBS, CPU), deque(maxlen=capacity)
    episodes = numbered_episodes(lengths)
    replay.append(episodes)
    for episode in range(len(lengths)):
        model.extend(transitions(episodes, episode))
    assert sorted(stored(replay, 0)) == sorted(model)


def test_the_oldest_gives_way_first() -> None:
    replay = Replay(1, 3, OBS, CPU)
    for first in (0, 10):
        replay.append(numbered_episodes([2], first=first))
    assert sorted(reward for *_, reward, _, _, _ in stored(replay, 0)) == [1, 10, 11]


def test_a_cleared_memory_is_empty() -> None:
    replay = Replay(1, 4, OBS, CPU)
    replay.append(numbered_episodes([3]))
    replay.clear()
    assert stored(replay, 0) == []


def test_a_cleared_memory_fills_from_the_first_slot() -> None:
    replay = Replay(1, 4, OBS, CPU)
    replay.append(numbered_episodes([3]))
    replay.clear()
    episodes = numbered_episodes([2], first=50)
    replay.append(episodes)
    assert stored(replay, 0) == transitions(episodes, 0)


def test_at_takes_each_seeds_own_rows() -> None:
    replay = Replay(2, 3, OBS, CPU)
    replay.append(numbered_episodes([3, 3]))
    batch = replay.everything().at(torch.tensor([[2, 0], [1, 1]]))
    assert batch.rewards.tolist() == [[2, 0], [4, 4]]
    assert batch.observations[:, :, 1].tolist() == [[2.5, 0.5], [4.5, 4.5]]


def added(replay: Replay, episodes: Episodes, step: int) -> int:
    """Add one transition of each seed's only episode; returns the slot."""
    fields = ("observations", "actions", "rewards", "next_observations", "terminated")
    return replay.add(*(getattr(episodes, name)[:, step] for name in fields))


@given(count=st.integers(1, 20), capacity=st.integers(1, 9))
def test_transitions_added_one_by_one_are_as_appended(count: int, capacity: int) -> None:
    episodes = numbered_episodes([count, count])
    one_by_one, at_once = Replay(2, capacity, OBS, CPU), Replay(2, capacity, OBS, CPU)
    for step in range(count):
        added(one_by_one, episodes, step)
    at_once.append(episodes)
    assert_equal_states(one_by_one.state_dict(), at_once.state_dict())


@given(before=st.integers(1, 12), capacity=st.integers(1, 9))
def test_episodes_follow_single_transitions(before: int, capacity: int) -> None:
    first, second = numbered_episodes([before] * 2), numbered_episodes([5] * 2, first=100)
    mixed, appended = Replay(2, capacity, OBS, CPU), Replay(2, capacity, OBS, CPU)
    for step in range(before):
        added(mixed, first, step)
    appended.append(first)
    for memory in (mixed, appended):
        memory.append(second)
    assert_equal_states(mixed.state_dict(), appended.state_dict())


def test_added_transitions_take_the_slots_of_a_ring() -> None:
    replay, episodes = Replay(3, 4, OBS, CPU), numbered_episodes([6] * 3)
    found = [added(replay, episodes, step) for step in range(6)]
    assert found == [0, 1, 2, 3, 0, 1]


def test_added_transitions_lie_where_it_says() -> None:
    replay, episodes = Replay(2, 4, OBS, CPU), numbered_episodes([6] * 2)
    for step in range(6):
        slot = added(replay, episodes, step)
        for seed in (0, 1):
            assert stored(replay, seed)[slot] == transitions(episodes, seed)[step]


def test_memories_grow_with_added_transitions_until_they_are_full() -> None:
    replay, episodes = Replay(2, 3, OBS, CPU), numbered_episodes([5] * 2)
    sizes = []
    for step in range(5):
        added(replay, episodes, step)
        sizes.append(replay.sizes.tolist())
    assert sizes == [[1, 1], [2, 2], [3, 3], [3, 3], [3, 3]]


def test_a_loaded_memory_resumes_bit_identically() -> None:
    replay, resumed = Replay(2, 5, OBS, CPU), Replay(2, 5, OBS, CPU)
    replay.append(numbered_episodes([4, 7]))
    buffer = io.BytesIO()
    torch.save(replay.state_dict(), buffer)
    buffer.seek(0)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    for memory in (replay, resumed):
        memory.append(numbered_episodes([3, 2], first=50))
    assert [stored(resumed, seed) for seed in (0, 1)] == [stored(replay, seed) for seed in (0, 1)]


@given(
    sizes=st.lists(st.integers(1, 2**31), min_size=1, max_size=4),
    numbers=st.lists(
        st.floats(0, float(BELOW_ONE), width=32) | st.just(float(BELOW_ONE)), min_size=1, max_size=6
    ),
)
def test_random_indices_lie_below_each_seeds_size(sizes: list[int], numbers: list[float]) -> None:
    uniform = np.tile(np.array(numbers, dtype=np.float32), (len(sizes), 1))
    indices = random_indices(uniform, np.array(sizes)).numpy()
    assert indices.shape == uniform.shape
    assert (indices >= 0).all()
    assert (indices < np.array(sizes)[:, None]).all()


@pytest.mark.parametrize("shape", [(2, 12), (2, 3, 4)])
def test_random_indices_are_equally_likely(shape: tuple[int, ...]) -> None:
    grid: NDArray[np.float32] = ((np.arange(12) + 0.5) / 12).astype(np.float32)
    uniform = np.stack([grid, grid]).reshape(shape)
    indices = random_indices(uniform, np.array([4, 6])).reshape(2, -1)
    assert torch.bincount(indices[0]).tolist() == [3] * 4
    assert torch.bincount(indices[1]).tolist() == [2] * 6


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=5),
    capacity=st.integers(1, 20),
    count=st.integers(1, 25),
)
def test_the_newest_are_those_that_came_last_each_as_likely(
    lengths: list[int], capacity: int, count: int
) -> None:
    replay = Replay(1, capacity, OBS, CPU)
    episodes = numbered_episodes(lengths)
    replay.append(episodes)
    all_of_them = [each for k in range(len(lengths)) for each in transitions(episodes, k)]
    expected = all_of_them[-min(count, capacity) :]
    uniform = ((np.arange(2 * len(expected)) + 0.5) / (2 * len(expected))).astype(np.float32)
    slots = replay.newest(uniform[None, :, None], count)
    assert slots.shape == (1, len(uniform), 1)
    drawn = replay.everything().at(slots[..., 0])
    rewards = sorted(drawn.rewards[0].tolist())
    of_expected = sorted(float(reward) for *_, reward, _, _, _ in expected)
    assert rewards == [reward for reward in of_expected for _ in range(2)]


def test_the_newest_are_each_seeds_own() -> None:
    """One seed has three of four slots filled, the other has gone round once."""
    replay = Replay(2, 4, OBS, CPU)
    episodes = numbered_episodes([3, 3, 3, 3])
    replay.append(episodes, keep=np.array([True, False, True, True]))
    every = np.tile(np.array([0.1, 0.4, 0.6, 0.9], dtype=np.float32), (2, 1))
    assert replay.newest(every[:, ::2], 2).tolist() == [[2, 1], [1, 0]]
    assert replay.newest(every, 4).tolist() == [[2, 1, 1, 0], [1, 0, 3, 2]]
