from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import copied
from torch import Tensor

from ril.learners.cloning import Cloning, CloningConfig
from ril.learners.goal_sampler import Selection
from ril.learners.inverse_dynamics import InverseDynamics, InverseDynamicsConfig
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.vectorized import compiling
from ril.vectorized.architectures import MLP, Dueling
from ril.vectorized.compiling import compile_graph, worth_compiling
from ril.vectorized.descent import train_on_minibatches
from ril.vectorized.networks import Architecture, Network
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams

CPU = torch.device("cpu")
STORED = 100
COMPILERS = ("g++", "clang++", "c++")
needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in COMPILERS), reason="no C++ compiler"
)

# Sizes as in conf/, since which kernel multiplies depends on them.
PLAIN = MLP(4, (64, 64), 2, attention=False, layer_norm=False, negative_slope=0.0)
ATTENTIVE = MLP(4, (8, 8), 2)  # RIL's own on CartPole
STREAMS = Dueling(MLP(4, (64, 64), 1, False, False, 0.0), PLAIN)


def memory(seeds: tuple[int, ...]) -> Replay:
    """What each seed remembers, which depends on that seed alone."""
    replay = Replay(len(seeds), STORED, 4, CPU)
    episodes: list[tuple[np.ndarray, ...]] = []
    for seed in seeds:
        numbers = np.random.default_rng(seed)
        states = numbers.normal(size=(2, STORED, 4)).astype(np.float32)
        rewards = numbers.normal(size=STORED).astype(np.float32)
        actions, ends = numbers.integers(2, size=STORED), numbers.random(STORED) < 0.2
        episodes.append((states[0], actions, rewards, states[1], ends))
    columns = (np.stack(column) for column in zip(*episodes, strict=True))
    replay.append(Episodes(*columns, np.full(len(seeds), STORED)))
    return replay


def learner(
    architecture: Architecture,
    seeds: tuple[int, ...],
    *,
    compile_step: bool,
    full: bool,
    **changes: Any,
) -> QLearning:
    """A learner; a full one has priorities, double targets and a target network."""
    values = {
        "learning_rate": 1e-3,
        "updates": 20,
        "batch_size": 32,
        "gradient_clip": None if full else 0.5,
        "discount": 0.9,
        "loss": "huber",
        "target_interval": 6 if full else 0,
    }
    priorities = None
    if full:
        priorities = Priorities(len(seeds), STORED, 0.6, CPU)
        priorities.add(torch.arange(STORED).expand(len(seeds), STORED))
    return QLearning(
        Network.initialize(architecture, seeds, "policy", CPU),
        memory(seeds),
        TargetNetworkConfig(**(values | changes)),
        Streams(seeds, "replay batches"),
        priorities=priorities,
        double=full,
        compile_step=compile_step,
    )


#: Parts of a training of 20 updates, with the β of each.
FIRST, SECOND = (12, 0.5), (8, 0.8)


def trained(q_learning: QLearning) -> tuple[Tensor, Tensor]:
    """Parameters and losses after both parts."""
    losses = [q_learning.train(updates, beta) for updates, beta in (FIRST, SECOND)]
    return q_learning.policy.flat.clone(), torch.stack(losses)


ARCHITECTURES = {"plain": (ATTENTIVE, False), "full": (STREAMS, True)}


@pytest.fixture(scope="module", params=ARCHITECTURES)
def among(request: pytest.FixtureRequest) -> tuple[str, QLearning, Tensor, Tensor]:
    """Which kind it is; a compiled learner of three seeds, and what its training gave."""
    architecture, full = ARCHITECTURES[request.param]
    q_learning = learner(architecture, (3, 5, 9), compile_step=True, full=full)
    return request.param, q_learning, *trained(q_learning)


@needs_compiler
def test_compiled_updates_are_the_eager_ones_but_for_rounding(among: Any) -> None:
    kind, compiled, parameters, losses = among
    architecture, full = ARCHITECTURES[kind]
    eager = learner(architecture, (3, 5, 9), compile_step=False, full=full)
    before = eager.policy.flat.clone()
    expected, expected_losses = trained(eager)
    assert (expected - before).abs().max() > 5e-3  # many times the tolerance
    torch.testing.assert_close(parameters, expected, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(losses, expected_losses, rtol=1e-3, atol=1e-5)
    if full:
        weights = (each.priorities.weights for each in (compiled, eager))
        torch.testing.assert_close(*weights, rtol=1e-3, atol=1e-3)


@needs_compiler
def test_a_seeds_compiled_updates_do_not_depend_on_other_seeds(among: Any) -> None:
    kind, compiled, parameters, losses = among
    architecture, full = ARCHITECTURES[kind]
    alone = learner(architecture, (5,), compile_step=True, full=full)
    of_alone, losses_of_alone = trained(alone)
    assert torch.equal(parameters[1], of_alone[0])
    assert torch.equal(losses[:, 1], losses_of_alone[:, 0])
    if full:
        assert torch.equal(compiled.priorities.weights[1], alone.priorities.weights[0])


@needs_compiler
def test_compiled_updates_follow_a_state_that_is_loaded(among: Any) -> None:
    kind, compiled, _, _ = among
    architecture, full = ARCHITECTURES[kind]
    eager = learner(architecture, (3, 5, 9), compile_step=False, full=full)
    eager.train(*FIRST)
    compiled.policy.flat.copy_(eager.policy.flat)
    compiled.load_state_dict(copied(eager.state_dict()))
    compiled.train(*SECOND)
    eager.train(*SECOND)
    torch.testing.assert_close(compiled.policy.flat, eager.policy.flat, rtol=1e-4, atol=1e-5)


@needs_compiler
def test_compiled_inverse_dynamics_are_the_eager_ones_but_for_rounding() -> None:
    """Training on I^s (line 7); Q-learning is above."""
    losses = []
    for compile_step in (False, True):
        model = InverseDynamics(
            Network.initialize(MLP(8, (8, 8), 2), (3, 5), "inverse dynamics", CPU),
            InverseDynamicsConfig(
                inputs="change",
                standardize="change",
                learning_rate=1e-3,
                updates=20,
                batch_size=32,
                gradient_clip=0.5,
                labels="argmax",
            ),
            Streams((3, 5), "inverse dynamics batches"),
            compile_step=compile_step,
        )
        replay = memory((3, 5))
        model.standardize(replay.everything())
        losses.append(model.train(Selection(replay.everything(), replay.sizes)))
    torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-6)


@needs_compiler
def test_compiled_cloning_is_the_eager_one_but_for_rounding() -> None:
    """Training on labels (line 9)."""
    observations = torch.linspace(-1, 1, 400).view(100, 4).sin()
    labels = (observations[:, 0] > 0).long().expand(2, 100)
    losses = []
    for compile_step in (False, True):
        cloning = Cloning(
            Network.initialize(ATTENTIVE, (3, 5), "policy", CPU),
            CloningConfig(learning_rate=1e-3, updates=20, batch_size=32, gradient_clip=None),
            Streams((3, 5), "cloning batches"),
            compile_step=compile_step,
        )
        losses.append(cloning.train(observations, labels))
    torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-6)


def test_minibatches_are_used_in_order_and_losses_averaged() -> None:
    seen = []

    def step(number: float, name: str) -> Tensor:
        seen.append((number, name))
        return torch.tensor([number, 2 * number])

    mean = train_on_minibatches(step, [1.0, 2.0, 6.0], ["a", "b", "c"])
    assert seen == [(1.0, "a"), (2.0, "b"), (6.0, "c")]
    assert mean.tolist() == [3.0, 6.0]


def test_minibatches_must_be_equally_many() -> None:
    with pytest.raises(ValueError, match="shorter"):
        train_on_minibatches(lambda *_: torch.zeros(2), [1, 2], [1])


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)


@pytest.fixture
def a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/c++" if name == "c++" else None)


LONG, SHORT = 10_000_000, 1000


@pytest.mark.parametrize(
    ("wanted", "updates", "compiles"),
    [
        (True, LONG, True),
        (True, SHORT, True),
        ("auto", LONG, True),
        ("auto", SHORT, False),
        ("auto", 15_000, True),
        ("auto", 14_999, False),
        (False, LONG, False),
    ],
)
@pytest.mark.usefixtures("a_compiler")
def test_it_compiles_as_wanted_or_where_it_pays(wanted: Any, updates: int, compiles: bool) -> None:
    assert worth_compiling(wanted, updates) is compiles


@pytest.fixture
def unsaid() -> None:
    """What is said once only has not been said yet."""
    compiling._print_once.cache_clear()


@pytest.mark.parametrize("wanted", [True, "auto"])
@pytest.mark.usefixtures("no_compiler", "unsaid")
def test_without_a_compiler_it_does_not_and_says_so_once(
    wanted: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not any(worth_compiling(wanted, LONG) for _ in range(3))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ril: no C++ compiler found (g++, clang++, c++)")


@pytest.mark.usefixtures("no_compiler", "unsaid")
def test_without_a_compiler_nothing_is_said_where_none_is_wanted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert not worth_compiling(False, LONG)
    assert not worth_compiling("auto", SHORT)
    assert not capsys.readouterr().err


@pytest.mark.usefixtures("a_compiler", "unsaid")
def test_a_compiler_that_is_named_is_the_one_that_counts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CXX", "nonsense")
    assert not worth_compiling(True, SHORT)
    assert "no C++ compiler found (nonsense)" in capsys.readouterr().err


@pytest.mark.usefixtures("unsaid")
def test_where_compiling_fails_training_is_eager(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any) -> None:
        raise RuntimeError("C++ compile error\nand pages more of it")

    monkeypatch.setattr("ril.vectorized.descent.compile_graph", lambda function: broken)
    found = trained(learner(PLAIN, (3, 5), compile_step=True, full=False))
    expected = trained(learner(PLAIN, (3, 5), compile_step=False, full=False))
    assert all(map(torch.equal, found, expected))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ril: cannot compile here (RuntimeError: C++ compile error and pages")


@needs_compiler
def test_what_cannot_be_traced_is_an_error() -> None:
    def with_a_branch(x: Tensor) -> Tensor:
        return x + 1 if x.sum() > 0 else x

    with pytest.raises(Exception, match="data-dependent"):
        compile_graph(with_a_branch)(torch.zeros(2))


@needs_compiler
def test_a_tensor_that_is_no_argument_is_an_error() -> None:
    other = torch.ones(2)
    with pytest.raises(Exception, match="FakeTensor"):
        compile_graph(lambda x: x + other)(torch.zeros(2))


@needs_compiler
def test_arguments_may_be_tuples_and_none_and_repeat() -> None:
    def function(x: Tensor, pair: tuple[Tensor, Tensor], nothing: None, again: Tensor) -> Tensor:
        assert nothing is None
        x.add_(pair[0])
        return x * pair[1] + again

    x = torch.ones(2)
    assert compile_graph(function)(x, (x, 3 * x), None, x).tolist() == [8.0, 8.0]
    assert x.tolist() == [2.0, 2.0]
