from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ril.io.errors import UserError

#: What of RIL is IUPE: no reinforcement, and its keys as conf/method/iupe.yaml has them.
AS_IUPE = (
    "method.reinforcement=false",
    "method.inverse_dynamics.labels=sample",
    "method.goal_sampler.upper_limit=false",
    "method.exploration.epsilon=1.0",
    "method.exploration.kind=softmax",
)
BOTH = ("method.episodes=3", "method.epochs=6")


@pytest.fixture(scope="module")
def both(make_method: Callable[..., Any]) -> tuple[Any, ...]:
    """IUPE and RIL without its other half, trained, with their progress."""
    iupe, ril = make_method("iupe", *BOTH), make_method("ril", *AS_IUPE, *BOTH)
    return iupe, ril, list(iupe.train()), list(ril.train())


def test_it_is_rils_imitation_bit_for_bit(both: Any) -> None:
    iupe, ril, _, _ = both
    assert torch.equal(iupe.policy.flat, ril.policy.flat)
    found, expected = (each.imitation.inverse_dynamics.network.flat for each in (iupe, ril))
    assert torch.equal(found, expected)


def test_its_progress_is_rils(both: Any) -> None:
    _, _, of_iupe, of_ril = both
    assert len(of_iupe) == len(of_ril) == 6
    for found, expected in zip(of_iupe, of_ril, strict=True):
        assert found.metrics.keys() == expected.metrics.keys()
        for name, values in expected.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], values, err_msg=name)
        for name in ("env_samples", "expert_samples", "pseudo_labels", "stopped"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert found.pre_samples == expected.pre_samples


def test_the_goal_sampler_mixes_without_equation_2(both: Any) -> None:
    _, _, progress, _ = both
    goals = np.array([each.metrics["goals"] for each in progress])
    assert ((goals > 0) & (goals < 1)).any()  # so that I^s depends on the success ratio


@pytest.mark.parametrize(
    "override",
    [
        "method.inverse_dynamics.labels=argmax",
        "method.exploration.epsilon=null",
        "method.exploration.kind=uniform",
        "method.goal_sampler.upper_limit=true",
        "method.goal_sampler.keep_pre=true",
        "method.reinforcement=true",
    ],
)
def test_each_of_its_keys_makes_a_difference(
    both: Any, make_method: Callable[..., Any], override: str
) -> None:
    key = override.partition("=")[0]
    others = [each for each in AS_IUPE if not each.startswith(key)]
    ril = make_method("ril", *others, override, *BOTH)
    list(ril.train())
    assert not torch.equal(ril.policy.flat, both[0].policy.flat)


def test_it_plays_as_many_episodes_as_asked(both: Any) -> None:
    _, _, progress, _ = both
    samples = np.array([np.zeros(2), *(each.env_samples for each in progress)])
    returns = np.array([each.metrics["training_return"] for each in progress])
    # CartPole pays 1 for each step.
    np.testing.assert_allclose(np.diff(samples, axis=0), 3 * returns)


def test_its_configuration_is_rils_but_for_its_keys(compose: Any) -> None:
    iupe, ril = (
        compose("env=cartpole", "method=iupe"),
        compose("env=cartpole", "method=ril", *AS_IUPE),
    )
    for key in (
        "network",
        "inverse_dynamics",
        "cloning",
        "exploration",
        "goal_sampler",
        "stopping",
    ):
        assert getattr(iupe.method, key) == getattr(ril.method, key)


def test_equation_2_is_refused(make_method: Callable[..., Any]) -> None:
    with pytest.raises(UserError, match=r"^method\.goal_sampler\.upper_limit=true: .*method=ril"):
        make_method("iupe", "method.goal_sampler.upper_limit=true")
