from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied
from torch import Tensor

from ril.io.errors import UserError
from ril.learners.cloning import Cloning
from ril.learners.exploration import epsilon_greedy, exploration_ratio, sample_softmax
from ril.learners.goal_sampler import select
from ril.learners.inverse_dynamics import InverseDynamics
from ril.learners.q_learning import QLearning
from ril.methods.base import Progress
from ril.methods.ril import Algorithm1
from ril.vectorized.architectures import MLP
from ril.vectorized.evaluation import Evaluation
from ril.vectorized.networks import Network, greedy
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Environments, Episodes
from ril.vectorized.streams import Streams

CPU = torch.device("cpu")


@pytest.fixture
def make(make_method: Callable[..., Any]) -> Callable[..., Any]:
    """RIL on the small run's configuration, with overrides."""
    return lambda *overrides: make_method("ril", *overrides)


def trained(method: Algorithm1) -> list[Progress]:
    return list(method.train())


def test_training_changes_everything_that_learns(make: Any) -> None:
    method = make()
    before = copied(method.state_dict())
    trained(method)
    after = method.state_dict()
    assert not torch.equal(after["policy"]["flat"], before["policy"]["flat"])
    of_cloning, of_rewards = after["cloner"], after["correction"]["q_learning"]
    for part in (after["imitation"]["inverse_dynamics"], of_cloning, of_rewards):
        assert part["_optimizer"]["steps"] > 0


LONG = ("method.epochs=6", "ablation.n=5", "method.stopping.patience=5")


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("method.goal_sampler.memory=epoch", "method.q_learning.target_interval=7"),
        ("method.goal_sampler.keep_pre=true",),
        ("method.imitation=false",),
        ("method.reinforcement=false",),
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one(make: Any, overrides: Any) -> None:
    uninterrupted, stopped = make(*LONG, *overrides), make(*LONG, *overrides)
    expected = trained(uninterrupted)
    epochs = stopped.train()
    for _ in range(3):
        next(epochs)
    resumed = make(*LONG, *overrides)
    resumed.load_state_dict(copied(stopped.state_dict()))
    rest = trained(resumed)
    assert [progress.epoch for progress in rest] == [4, 5, 6]
    for found, progress in zip(rest, expected[3:], strict=True):
        np.testing.assert_array_equal(found.env_samples, progress.env_samples)
        for name, values in progress.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], values, err_msg=name)
    assert_equal_states(resumed.state_dict(), uninterrupted.state_dict())


def networks(method: Algorithm1, purpose: str, inputs: int) -> Network:
    """Fresh networks as RIL begins with."""
    shape, task = method.config.network, method.task
    architecture = MLP(
        inputs, tuple(shape.hidden), task.environment.action_count, negative_slope=0.01
    )
    return Network.initialize(architecture, task.seeds, purpose, CPU)


class Player:
    """Plays one ε-greedy episode per seed, with RIL's streams of random numbers."""

    def __init__(self, method: Algorithm1, policy: Network) -> None:
        self.policy, self.task = policy, method.task
        self.kind = method.config.exploration.kind
        self.environments = Environments(self.task.environment, len(self.task.seeds))
        self.exploration = Streams(self.task.seeds, "exploration")
        self.resets = Streams(self.task.seeds, "resets")

    def play(self, epsilon: np.ndarray) -> Episodes:
        uniform = torch.from_numpy(
            self.exploration.uniform(self.task.environment.max_episode_steps, 2)
        )

        def act(observations: np.ndarray, step: int) -> np.ndarray:
            with torch.no_grad():
                values = self.policy(torch.from_numpy(observations)[:, None])
            numbers = uniform[:, step].T[..., None]  # (2, S, 1)
            return epsilon_greedy(values, torch.from_numpy(epsilon), numbers, self.kind)[
                :, 0
            ].numpy()

        return self.environments.play(act, self.resets.integers(2**31))


def q_learning_alone(method: Algorithm1, epochs: int, epsilon: float) -> Network:
    """DQN from the same parts: play an episode, remember it, learn from the memory."""
    config, task = method.config.q_learning, method.task
    size, seeds = task.environment.observation_size, task.seeds
    policy = networks(method, "policy", size)
    capacity = round(10 * len(task.expert.observations) / task.expert.trajectories)
    memory = Replay(len(seeds), capacity, size, CPU)
    q_learning = QLearning(policy, memory, config, Streams(seeds, "replay batches"))
    player = Player(method, policy)
    for _ in range(epochs):
        memory.append(player.play(np.full(len(seeds), epsilon)))
        q_learning.train(config.updates)
    return policy


@pytest.mark.quick
@pytest.mark.parametrize("kind", ["softmax", "uniform"])
def test_without_imitation_it_is_q_learning_alone(make: Any, kind: str) -> None:
    method = make(
        "method.imitation=false",
        "method.epochs=8",
        "method.exploration.epsilon=0.3",
        f"method.exploration.kind={kind}",
        "method.q_learning.target_interval=5",
    )
    trained(method)
    expected = q_learning_alone(method, epochs=8, epsilon=0.3)
    assert torch.equal(method.policy.flat, expected.flat)


def test_without_imitation_nothing_is_imitated(make: Any) -> None:
    method = make("method.imitation=false")
    before = copied(method.state_dict())["imitation"]
    trained(method)
    after = method.state_dict()["imitation"]
    for name in ("inverse_dynamics", "pre", "pos", "stopping"):
        assert_equal_states(after[name], before[name], name)
    assert method.cloner is None


def test_without_imitation_no_expert_sample_is_used(make: Any) -> None:
    assert trained(make("method.imitation=false"))[-1].expert_samples.tolist() == [0, 0]


def random_transitions(method: Algorithm1, policy: Network) -> Replay:
    """I^pre: transitions of the untrained policy, ten episodes per seed side by side."""
    environment, seeds = method.task.environment, method.task.seeds
    count = len(seeds)
    capacity = method.config.goal_sampler.pre_steps_per_action * environment.action_count
    pre = Replay(count, capacity, environment.observation_size, CPU)
    streams, copies = Streams(seeds, "pre"), Environments(environment, 10 * count)
    while (pre.sizes < capacity).any():
        uniform = torch.from_numpy(streams.uniform(environment.max_episode_steps, 10))

        def act(observations: np.ndarray, step: int, uniform: Tensor = uniform) -> np.ndarray:
            with torch.no_grad():
                values = policy(torch.from_numpy(observations.reshape(count, 10, -1)))
            return sample_softmax(values, uniform[:, step]).flatten().numpy()

        episodes = copies.play(act, streams.integers(2**31, 10).ravel())
        pre.append(episodes, keep=(pre.sizes < capacity).repeat(10))
    return pre


def imitation_alone(
    method: Algorithm1, epochs: int, n: float, goal: float
) -> tuple[Network, Network]:
    """Iterated imitation from observation, from the same parts; π_φ and M_θ."""
    config, task = method.config, method.task
    size, seeds = task.environment.observation_size, task.seeds
    policy = networks(method, "policy", size)
    dynamics = InverseDynamics(
        networks(method, "inverse dynamics", 2 * size),
        config.inverse_dynamics,
        Streams(seeds, "inverse dynamics batches"),
    )
    cloning = Cloning(policy, config.cloning, Streams(seeds, "cloning batches"))
    sampler, ratio = Streams(seeds, "goal sampler"), Streams(seeds, "exploration ratio")
    player = Player(method, policy)

    states = torch.from_numpy(task.expert.observations)
    every_states = states.expand(len(seeds), -1, -1)
    every_next = torch.from_numpy(task.expert.next_observations).expand(len(seeds), -1, -1)
    pre = random_transitions(method, policy)
    dynamics.standardize(pre.everything())
    pos = Replay(len(seeds), pre.capacity, size, CPU)
    goals = np.zeros(len(seeds))
    for epoch in range(epochs):
        limit = 0.0 if epoch == 0 else 1.0 if epoch >= n else 1 - 1 / (1 + (n / epoch - 1) ** -2)
        uniform = sampler.uniform(2 * pre.capacity)
        share = np.minimum(limit, goals)
        actions = task.environment.action_count
        dynamics.train(
            select(pre, pos, share, actions, uniform, keep_pre=config.goal_sampler.keep_pre)
        )
        cloning.train(states, dynamics.label(every_states, every_next))
        with torch.no_grad():
            epsilon = exploration_ratio(policy(every_states), ratio.uniform(len(states)))
        episodes = player.play(epsilon)
        goals = (episodes.returns >= goal).astype(float)
        pos.append(episodes, keep=episodes.returns >= goal)
    return policy, dynamics.network


@pytest.mark.quick
@pytest.mark.parametrize("keep_pre", ["true", "false"])
def test_without_reinforcement_it_is_imitation_alone(make: Any, keep_pre: str) -> None:
    keep = f"method.goal_sampler.keep_pre={keep_pre}"
    method = make("method.reinforcement=false", "method.epochs=8", keep)
    goals = [progress.metrics["goals"] for progress in trained(method)]
    assert 0 < np.mean(goals[:-1]) < 1  # so that the goal sampler mixes I^pre and I^pos
    policy, dynamics = imitation_alone(method, epochs=8, n=4, goal=11)
    assert torch.equal(method.policy.flat, policy.flat)
    assert torch.equal(method.imitation.inverse_dynamics.network.flat, dynamics.flat)


def test_without_reinforcement_nothing_corrects_the_policy(make: Any) -> None:
    assert make("method.reinforcement=false").correction is None


def test_without_both_halves_it_is_refused(make: Any) -> None:
    halves = "method.imitation=false method.reinforcement=false"
    with pytest.raises(UserError, match=f"^{halves}: at least one must be true"):
        make(*halves.split())


def test_the_memory_holds_ten_mean_expert_trajectories(make: Any) -> None:
    method = make("ablation.trajectories=3")
    lengths = len(method.task.expert.observations) / 3
    assert method.correction.q_learning.replay.capacity == round(10 * lengths)


def test_the_random_transitions_are_as_many_as_asked(make: Any) -> None:
    method = make("method.epochs=1")
    [progress] = trained(method)
    assert method.imitation.pre.sizes.tolist() == [2 * 60, 2 * 60]  # |A| · pre_steps_per_action
    assert progress.pre_samples == 2 * 60


def test_without_imitation_there_are_no_random_transitions(make: Any) -> None:
    assert trained(make("method.imitation=false"))[-1].pre_samples == 0


def test_environment_samples_are_the_steps_of_the_own_episodes(make: Any) -> None:
    method = make("method.episodes=2", "method.q_learning.replay_trajectories=100")
    progress = trained(method)
    assert progress[-1].env_samples.tolist() == method.correction.q_learning.replay.sizes.tolist()


def test_training_returns_are_means_of_the_own_episodes(make: Any) -> None:
    progress = trained(make("method.episodes=2"))
    samples = np.array([np.zeros(2), *(each.env_samples for each in progress)])
    for epoch, each in enumerate(progress):  # CartPole pays 1 for each step
        mean_length = (samples[epoch + 1] - samples[epoch]) / 2
        np.testing.assert_allclose(each.metrics["training_return"], mean_length)


def test_expert_samples_count_the_expert_once_per_epoch(make: Any) -> None:
    method = make()
    expected = [[epoch * len(method.task.expert.observations)] * 2 for epoch in (1, 2, 3)]
    assert [progress.expert_samples.tolist() for progress in trained(method)] == expected


def test_successes_are_kept(make: Any) -> None:
    method = make("env.goal.minimum_return=1")
    progress = trained(method)
    assert method.imitation.pos.sizes.tolist() == np.minimum(progress[-1].env_samples, 120).tolist()


def test_failures_are_not(make: Any) -> None:
    method = make("env.goal.minimum_return=501")
    trained(method)
    assert method.imitation.pos.sizes.tolist() == [0, 0]


def test_goals_are_the_share_of_successes(make: Any) -> None:
    for goal, share in ((1, 1.0), (501, 0.0)):
        progress = trained(make(f"env.goal.minimum_return={goal}", "method.episodes=2"))
        assert progress[-1].metrics["goals"].tolist() == [share, share]


def test_an_epochs_memory_forgets_earlier_successes(make: Any) -> None:
    method = make(
        "method.goal_sampler.memory=epoch",
        "env.goal.minimum_return=1",
        "method.goal_sampler.pre_steps_per_action=500",
    )
    *_, before_last, last = trained(method)
    assert (
        method.imitation.pos.sizes.tolist() == (last.env_samples - before_last.env_samples).tolist()
    )


def test_training_ends_once_all_seeds_have_stopped(make: Any) -> None:
    # No loss falls by 99 % in an epoch, so every seed stops after the second.
    method = make("method.stopping.patience=1", "method.stopping.loss_tolerance=0.99")
    progress = trained(method)
    assert [each.stopped.tolist() for each in progress] == [[False, False], [True, True]]


def test_a_fixed_epsilon_is_kept(make: Any) -> None:
    progress = trained(make("method.exploration.epsilon=0.25"))
    assert all(each.metrics["epsilon"].tolist() == [0.25, 0.25] for each in progress)


def test_epsilon_is_the_policys_own_by_default(make: Any) -> None:
    found = np.array([each.metrics["epsilon"] for each in trained(make())])
    assert ((found > 0) & (found < 1)).all()
    assert len(np.unique(found)) > 1


def test_the_policy_acts_greedily_for_each_seed(make: Any) -> None:
    method = make()
    observations = np.random.default_rng(0).normal(size=(2 * 5, 4)).astype(np.float32)
    values = method.policy(torch.from_numpy(observations).view(2, 5, 4))
    expected = values.argmax(dim=-1).flatten().tolist()
    assert greedy(method.policy.infer(observations)).tolist() == expected
    assert len(set(expected)) > 1


def test_it_learns_to_balance_the_pole(make: Any) -> None:
    method = make(
        "env.goal.minimum_return=195",
        "method.epochs=15",
        "method.goal_sampler.pre_steps_per_action=500",
        "method.inverse_dynamics.updates=50",
        "method.inverse_dynamics.learning_rate=0.005",
        "method.cloning.updates=50",
        "method.cloning.learning_rate=0.005",
        "method.q_learning.updates=10",
    )
    evaluation = Evaluation(method.task.environment, method.task.seeds)
    assert evaluation.returns(method.policy, 10, "before").mean() < 50
    trained(method)
    assert evaluation.returns(method.policy, 10, "after").mean(axis=1).min() > 100
