from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of
from helpers.states import assert_equal_states, copied
from torch.nn import functional

from ril.config.schema import Config
from ril.environments.environment import Environment
from ril.io.errors import UserError
from ril.learners.online_q_learning import OnlineQLearning
from ril.learners.q_learning import QLearning
from ril.task import Task
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.streams import Streams

SEEDS = (3, 5)
TOTAL = 220
CAPACITY = 50

Make = Callable[..., OnlineQLearning]


@pytest.fixture(scope="module")
def make(quick: Any, make_task: Callable[[Config], Task]) -> Make:
    """Two seeds that act and learn, as the overrides say."""

    def made(
        *overrides: str,
        kind: str = "uniform",
        seeds: tuple[int, ...] = SEEDS,
        total_steps: int = TOTAL,
        compiled: bool = False,
    ) -> OnlineQLearning:
        config = quick("method=dqn", f"method.q_learning.replay.capacity={CAPACITY}", *overrides)
        task = dataclasses.replace(make_task(config), seeds=seeds, compile=compiled)
        environment = task.environment
        architecture = MLP(environment.observation_size, (8,), environment.action_count)
        policy = Network.initialize(architecture, seeds, "policy", task.device)
        q_learning: Any = config.method.q_learning
        return OnlineQLearning(q_learning, task, policy, kind, total_steps)

    return made


MOUNTAINCAR = ("env=mountaincar", "env.goal.minimum_return=null")


def falling(steps: int, seeds: int = 2) -> np.ndarray:
    """(T, S) chances to explore, which differ between seeds."""
    line = np.linspace(1, 0.2, steps)[:, None]
    return line * np.linspace(1, 0.5, seeds)


class PlainDQN:
    """One seed of DQN, one step after another: gymnasium, a list as memory, torch.nn modules."""

    def __init__(
        self, online: OnlineQLearning, kind: str, environment: Environment, index: int
    ) -> None:
        self.config, self.kind = online.config, kind
        self.environment, self.copy = environment, environment.make()
        self.seed = SEEDS[index]
        self.policy, self.target = copies_of(online.policy)[index], copies_of(online.policy)[index]
        self.optimizer = Adam(self.policy, self.config.learning_rate, self.config.gradient_clip)
        self.exploration = Streams([self.seed], "exploration")
        self.batches = Streams([self.seed], "replay batches")
        self.actions: list[int] = []
        self.memory: list[tuple[np.ndarray, int, float, np.ndarray, bool]] = []
        self.losses: dict[int, float] = {}  # by the number of steps so far
        self.returns: dict[int, float] = {}  # of episodes, by the steps after which they ended
        self.ends = {"terminated": 0, "truncated": 0}
        self.updates = 0

    def start(self, episode: int) -> np.ndarray:
        key = [self.seed, zlib.crc32(b"online q-learning"), 0, episode]
        number = int(np.random.SeedSequence(key).generate_state(1)[0]) >> 1
        return self.environment.scale(self.copy.reset(seed=number)[0])

    def values(self, state: np.ndarray) -> torch.Tensor:
        with torch.no_grad():
            return self.policy(torch.from_numpy(state)[None])[0]

    def act(self, state: np.ndarray, epsilon: float) -> int:
        (whether, what) = self.exploration.uniform(1, 2)[0, 0]
        values = self.values(state)
        if whether >= epsilon:
            return int(values.argmax())
        if self.kind == "uniform":
            return int(what * len(values))
        up_to = values.softmax(dim=0).cumsum(dim=0).tolist()
        return next(action for action, end in enumerate(up_to) if what < end)

    def run(self, epsilon: np.ndarray) -> None:
        state, episode, total = self.start(0), 0, 0.0
        for step, chance in enumerate(epsilon, start=1):
            action = self.act(state, chance)
            raw, reward, terminated, truncated, _ = self.copy.step(action)
            following = self.environment.scale(raw)
            self.actions.append(action)
            if len(self.memory) < CAPACITY:
                self.memory.append((state, action, float(reward), following, terminated))
            else:
                oldest = (step - 1) % CAPACITY
                self.memory[oldest] = (state, action, float(reward), following, terminated)
            state, total = following, total + float(reward)
            if terminated or truncated:
                self.ends["terminated" if terminated else "truncated"] += 1
                self.returns[step], total, episode = total, 0.0, episode + 1
                state = self.start(episode)
            if step > self.config.learning_starts and step % self.config.train_freq == 0:
                losses = [self.learn() for _ in range(self.config.updates)]
                self.losses[step] = float(np.mean(losses))

    def learn(self) -> float:
        if self.updates % self.config.target_interval == 0:
            self.target.load_state_dict(self.policy.state_dict())
        self.updates += 1
        numbers = self.batches.uniform(1, self.config.batch_size)[0, 0]
        slots = [int(np.float32(n) * np.float64(len(self.memory))) for n in numbers.tolist()]
        columns = zip(*(self.memory[slot] for slot in slots), strict=True)
        states, actions, rewards, following, terminated = (np.array(each) for each in columns)
        with torch.no_grad():
            best = self.target(torch.from_numpy(following)).max(dim=1).values
        goals = torch.tensor(rewards, dtype=torch.float32)
        goals[~terminated] += self.config.discount * best[~terminated]
        values = self.policy(torch.from_numpy(states))[range(len(slots)), actions]
        loss = functional.huber_loss(values, goals)
        self.optimizer.step(loss)
        return loss.item()


SETTINGS = {
    "cartpole": (),
    "mountaincar": (*MOUNTAINCAR, "method.q_learning.train_freq=7"),  # is truncated at 200 steps
    "late": ("method.q_learning.learning_starts=100", "method.q_learning.gradient_clip=0.1"),
}


@pytest.fixture(
    scope="module",
    params=[("cartpole", "uniform"), ("mountaincar", "softmax"), ("late", "softmax")],
    ids="-".join,
)
def both(
    request: pytest.FixtureRequest, make: Make, environments: dict[str, Environment]
) -> tuple[OnlineQLearning, list[PlainDQN], dict[str, np.ndarray], np.ndarray]:
    """Both seeds after all their steps; one plain agent for each; metrics; states acted in."""
    name, kind = request.param
    online = make(*SETTINGS[name], kind=kind)
    environment = environments["mountaincar" if name == "mountaincar" else "cartpole"]
    plain = [PlainDQN(online, kind, environment, index) for index in range(len(SEEDS))]
    epsilon = falling(TOTAL)
    actions = []
    step = online._environments.step

    def recording(chosen: np.ndarray) -> Any:
        actions.append(chosen.copy())
        return step(chosen)

    online._environments.step = recording  # type: ignore[method-assign]
    metrics = online.advance(TOTAL, epsilon)
    for index, agent in enumerate(plain):
        agent.run(epsilon[:, index])
    return online, plain, metrics, np.array(actions)


def test_actions_are_those_of_a_plain_agent_per_seed(both: Any) -> None:
    _, plain, _, actions = both
    assert actions.T.tolist() == [agent.actions for agent in plain]


def test_parameters_are_those_of_a_plain_agent_per_seed(both: Any) -> None:
    online, plain, _, _ = both
    expected = torch.stack([flat_of(agent.policy) for agent in plain])
    torch.testing.assert_close(online.policy.flat, expected, rtol=1e-3, atol=1e-4)


def test_the_memory_is_that_of_a_plain_agent_per_seed(both: Any) -> None:
    online, plain, _, _ = both
    stored = online.learner.replay.everything()
    for index, agent in enumerate(plain):
        for field, values in zip(stored, zip(*agent.memory, strict=True), strict=True):
            np.testing.assert_array_equal(field[index].numpy(), np.array(values, np.float32))


def test_the_loss_is_the_mean_over_the_steps_with_updates(both: Any) -> None:
    _, plain, metrics, _ = both
    expected = [np.mean(list(agent.losses.values())) for agent in plain]
    np.testing.assert_allclose(metrics["td_loss"], expected, rtol=1e-3)


def test_the_return_is_that_of_the_last_episode_that_ended(both: Any) -> None:
    _, plain, metrics, _ = both
    expected = [agent.returns[max(agent.returns)] for agent in plain]
    np.testing.assert_allclose(metrics["training_return"], expected)


def test_episodes_end_in_the_way_that_their_environment_ends_them(both: Any) -> None:
    online, plain, _, _ = both
    ways = {way for agent in plain for way, count in agent.ends.items() if count}
    assert ways == ({"truncated"} if online.policy.architecture.outputs == 3 else {"terminated"})


def test_a_truncated_episode_is_not_terminal_in_memory(make: Make) -> None:
    online = make(*MOUNTAINCAR, "method.q_learning.replay.capacity=250")
    online.advance(250, falling(250))
    stored = online.learner.replay.everything()
    assert not stored.terminated.any()
    # What follows its last state is its own final one, and not the next one's first.
    following, after = stored.next_observations[:, 199], stored.observations[:, 200]
    assert (following != after).any(dim=1).all()
    assert torch.equal(stored.next_observations[:, 198], stored.observations[:, 199])


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """The number of updates and the β of each call."""
    asked: list[tuple[int, float]] = []

    def train_on(self: QLearning, uniform: torch.Tensor, beta: float = 1.0) -> torch.Tensor:
        asked.append((len(uniform), beta))
        return torch.zeros(len(SEEDS))

    monkeypatch.setattr(QLearning, "train_on", train_on)
    return asked


@pytest.mark.parametrize(
    ("train_freq", "learning_starts", "learns_after"),
    [
        (4, 10, [12, 16, 20]),
        (4, 12, [16, 20]),  # after learning_starts steps, and not with the last of them
        (1, 18, [19, 20, 21, 22]),
        (5, 0, [5, 10, 15, 20]),
        (30, 0, []),
    ],
)
def test_it_learns_every_so_many_steps_once_it_has_started(
    make: Make, calls: list[Any], train_freq: int, learning_starts: int, learns_after: list[int]
) -> None:
    online = make(
        f"method.q_learning.train_freq={train_freq}",
        f"method.q_learning.learning_starts={learning_starts}",
        "method.q_learning.updates=3",
    )
    found = []
    for step in range(1, 23):
        before = len(calls)
        online.advance(step, falling(1))
        found += [step] * (len(calls) - before)
    assert found == learns_after
    assert all(updates == 3 for updates, _ in calls)


PRIORITIZED = ("method.q_learning.replay.alpha=0.6",)


def test_beta_rises_along_a_line_to_one_at_the_last_step(make: Make, calls: list[Any]) -> None:
    settings = "method.q_learning.train_freq=10", "method.q_learning.learning_starts=0"
    online = make(*PRIORITIZED, *settings, "method.q_learning.replay.beta=0.4", total_steps=40)
    online.advance(50, falling(50))
    found = [beta for _, beta in calls]
    assert found == pytest.approx([0.55, 0.7, 0.85, 1.0, 1.0])


def test_what_is_remembered_gets_a_priority(make: Make) -> None:
    online = make(*PRIORITIZED, "method.q_learning.learning_starts=1000")
    online.advance(30, falling(30))
    assert online.learner.priorities is not None
    weights = online.learner.priorities.weights
    assert (weights[:, :30] == 1).all()
    assert not weights[:, 30:].any()


def test_learning_gives_what_was_drawn_other_priorities(make: Make) -> None:
    online = make(*PRIORITIZED)
    online.advance(40, falling(40))
    assert online.learner.priorities is not None
    weights = online.learner.priorities.weights[:, :40]
    assert (weights > 0).all()
    assert all(len(row.unique()) > 10 for row in weights)


def test_there_are_no_priorities_without_alpha(make: Make) -> None:
    assert make().learner.priorities is None


def test_without_updates_the_loss_is_nan(make: Make) -> None:
    online = make("method.q_learning.learning_starts=100")
    assert np.isnan(online.advance(100, falling(100))["td_loss"]).all()
    assert np.isfinite(online.advance(104, falling(4))["td_loss"]).all()
    assert np.isnan(online.advance(107, falling(3))["td_loss"]).all()


def test_until_an_episode_has_ended_the_return_is_nan(make: Make) -> None:
    online = make(*MOUNTAINCAR)
    assert np.isnan(online.advance(199, falling(199))["training_return"]).all()
    assert online.advance(200, falling(1))["training_return"].tolist() == [-200.0, -200.0]
    assert online.advance(250, falling(50))["training_return"].tolist() == [-200.0, -200.0]


def test_epsilon_is_that_of_the_last_step(make: Make) -> None:
    epsilon = falling(20)
    assert make().advance(20, epsilon)["epsilon"].tolist() == epsilon[-1].tolist()


@pytest.mark.parametrize("kind", ["uniform", "softmax"])
def test_without_epsilon_actions_are_greedy(make: Make, kind: str) -> None:
    online = make("method.q_learning.learning_starts=1000", kind=kind)
    online.advance(40, np.zeros((40, 2)))
    stored = online.learner.replay.everything()
    greedy = online.policy(stored.observations).argmax(dim=-1)
    assert torch.equal(stored.actions[:, :40], greedy[:, :40])


OPTIONS = {
    "plain": (),
    "prioritized": (*PRIORITIZED, "method.q_learning.double=true"),
    "mountaincar": (*MOUNTAINCAR, *PRIORITIZED),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("kind", ["uniform", "softmax"])
def test_steps_in_two_parts_are_those_in_one(make: Make, options: Any, kind: str) -> None:
    once, twice = make(*options, kind=kind), make(*options, kind=kind)
    epsilon = falling(230)
    once.advance(230, epsilon)
    twice.advance(91, epsilon[:91])
    twice.advance(230, epsilon[91:])
    assert torch.equal(twice.policy.flat, once.policy.flat)
    assert_equal_states(twice.state_dict(), once.state_dict())


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
def test_a_state_saved_in_mid_episode_resumes_bit_identically(
    make: Make, options: Any, compiled: bool
) -> None:
    online, resumed = (make(*options, compiled=compiled) for _ in range(2))
    epsilon = falling(230)
    online.advance(110, epsilon[:110])
    resumed.advance(31, epsilon[:31])  # what was done before leaves no trace
    state = copied(online.state_dict())
    assert all(state["_environments"]["actions"])  # so that both seeds are in mid-episode
    resumed.load_state_dict(state)
    resumed.policy.flat.copy_(online.policy.flat)
    found, expected = (each.advance(230, epsilon[110:]) for each in (resumed, online))
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    assert torch.equal(resumed.policy.flat, online.policy.flat)
    assert_equal_states(resumed.state_dict(), online.state_dict())


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("kind", ["uniform", "softmax"])
def test_a_seeds_steps_do_not_depend_on_other_seeds(make: Make, options: Any, kind: str) -> None:
    sizes = ("method.q_learning.batch_size=32",)
    among = make(*options, *sizes, kind=kind, seeds=(3, 5, 9))
    alone = make(*options, *sizes, kind=kind, seeds=(5,))
    epsilon = falling(150, seeds=3)
    found, expected = among.advance(150, epsilon), alone.advance(150, epsilon[:, 1:2])
    assert torch.equal(among.policy.flat[1], alone.policy.flat[0])
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name][1], values[0], err_msg=name)


def test_a_memory_of_no_size_is_refused(make: Make) -> None:
    with pytest.raises(UserError, match=r"capacity=null: must be a number"):
        make("method.q_learning.replay.capacity=null")


@pytest.mark.parametrize("total_steps", [60, 103])
def test_whether_compiling_pays_does_not_depend_on_the_number_of_seeds(
    make: Make, monkeypatch: pytest.MonkeyPatch, total_steps: int
) -> None:
    asked = []

    def asking(wanted: Any, updates: int) -> bool:
        asked.append(updates)
        return False

    monkeypatch.setattr("ril.learners.online_q_learning.worth_compiling", asking)
    config = make(total_steps=total_steps).config
    make(total_steps=total_steps, seeds=(3,))
    assert asked == [config.updates * (total_steps // config.train_freq)] * 2
