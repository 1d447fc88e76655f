from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from ril.vectorized.streams import Streams

DRAWS = {
    "uniform": lambda streams: streams.uniform(4, 5),
    "integers": lambda streams: streams.integers(2**31, 4, 5),
    "normal": lambda streams: streams.normal(4, 5),
    "permutations": lambda streams: streams.permutations(4, 50),
}


@pytest.fixture(params=DRAWS)
def draw(request: pytest.FixtureRequest) -> Any:
    return DRAWS[request.param]


def test_a_seeds_draws_do_not_depend_on_other_seeds(draw: Any) -> None:
    alone, among = Streams([5], "resets"), Streams([3, 5, 9], "resets")
    for _ in range(3):
        np.testing.assert_array_equal(draw(alone)[0], draw(among)[1])


def test_seeds_draw_differently(draw: Any) -> None:
    first, second = draw(Streams([0, 1], "resets"))
    assert (first != second).any()


def test_purposes_draw_differently(draw: Any) -> None:
    assert (draw(Streams([0], "resets")) != draw(Streams([0], "exploration"))).any()


def test_draws_do_not_repeat(draw: Any) -> None:
    streams = Streams([0], "resets")
    assert (draw(streams) != draw(streams)).any()


def test_a_loaded_state_resumes_bit_identically(draw: Any) -> None:
    streams, resumed = Streams([0, 2**40], "resets"), Streams([7, 8], "other")
    draw(streams)
    buffer = io.BytesIO()
    torch.save(streams.state_dict(), buffer)
    buffer.seek(0)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    np.testing.assert_array_equal(draw(resumed), draw(streams))


def test_uniform_numbers_fill_zero_to_one() -> None:
    numbers = Streams([0], "resets").uniform(20_000)
    assert numbers.dtype == np.float32
    assert numbers.min() >= 0
    assert numbers.max() < 1
    counts, _ = np.histogram(numbers, bins=10, range=(0, 1))
    np.testing.assert_allclose(counts, 2000, rtol=0.1)


def test_integers_are_all_those_below_the_limit() -> None:
    assert set(Streams([0], "resets").integers(4, 1000).ravel().tolist()) == {0, 1, 2, 3}


def test_normal_numbers_have_mean_0_and_variance_1() -> None:
    numbers = Streams([0], "ppo").normal(20_000)
    assert (numbers.mean(), numbers.std()) == pytest.approx((0, 1), abs=0.03)


def test_every_permutation_is_drawn_equally_often() -> None:
    drawn = Streams([0], "minibatches").permutations(6000, 3)[0]
    _, counts = np.unique(drawn, axis=0, return_counts=True)
    np.testing.assert_allclose(counts, np.full(6, 1000), rtol=0.1)
