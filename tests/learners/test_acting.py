from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch

from ril.learners.acting import acting
from ril.vectorized import compiling
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "clang++", "c++")), reason="no C++ compiler"
)
CPU = torch.device("cpu")
SEEDS = (3, 5, 9)
STEPS = 200
RANDOM = np.random.default_rng(0)
OBSERVATIONS = RANDOM.uniform(-1, 1, (STEPS, 3, 2)).astype(np.float32)
EPSILON = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
UNIFORM = torch.from_numpy(RANDOM.random((STEPS, 2, 3, 1), dtype=np.float32))


def actions(kind: str, seeds: slice = slice(None), *, compiled: bool) -> np.ndarray:
    """(STEPS, S) the actions of some of the seeds."""
    policy = Network.initialize(MLP(2, (8, 8), 3), SEEDS[seeds], "policy", CPU)
    act = acting(policy, kind, compiled=compiled)
    steps = zip(OBSERVATIONS, UNIFORM, strict=True)
    return np.stack([act(seen[seeds], EPSILON[seeds], u[:, seeds]) for seen, u in steps])


@pytest.fixture(scope="module", params=["uniform", "softmax"])
def among(request: pytest.FixtureRequest) -> tuple[str, np.ndarray]:
    """The kind of exploring actions, and the compiled actions of all three seeds."""
    return request.param, actions(request.param, compiled=True)


def test_compiled_actions_are_the_eager_ones_but_for_rounding(
    among: tuple[str, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    kind, found = among
    assert (found == actions(kind, compiled=False)).mean() > 0.99
    assert len(np.unique(found)) == 3
    assert "cannot compile" not in capsys.readouterr().err


def test_a_seeds_compiled_actions_do_not_depend_on_other_seeds(
    among: tuple[str, np.ndarray],
) -> None:
    kind, found = among
    np.testing.assert_array_equal(actions(kind, slice(1, 2), compiled=True)[:, 0], found[:, 1])


def test_compiled_actions_follow_the_policys_parameters() -> None:
    policy = Network.initialize(MLP(2, (8,), 3), SEEDS, "policy", CPU)
    act = acting(policy, "uniform", compiled=True)
    for best in range(3):
        policy.parameters["output.bias"].detach().copy_(100 * torch.eye(3)[best])
        assert act(OBSERVATIONS[0], EPSILON[[0, 0, 0]], UNIFORM[0]).tolist() == [best] * 3


def test_where_compiling_fails_acting_is_eager(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("C++ compile error")

    compiling._print_once.cache_clear()
    monkeypatch.setattr(compiling, "_compiled", broken)
    found = actions("softmax", compiled=True)
    np.testing.assert_array_equal(found, actions("softmax", compiled=False))
    assert "cannot compile here" in capsys.readouterr().err
