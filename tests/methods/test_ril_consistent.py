from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from helpers.runs import Silence
from helpers.states import assert_equal_states, copied
from torch import Tensor

from ril.io.errors import UserError
from ril.learners.consistency import ConsistentLearning
from ril.learners.exploration import Explorer
from ril.learners.imitation import SelfSupervisedImitation
from ril.learners.td import n_step
from ril.methods.base import Progress
from ril.methods.ril import Algorithm1
from ril.methods.ril_consistent import RILConsistentConfig
from ril.run.experiment import run
from ril.vectorized.architectures import MLP, Consistent
from ril.vectorized.evaluation import Evaluation
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Episodes

CPU = torch.device("cpu")
Make = Callable[..., Any]


@pytest.fixture
def make(make_method: Make) -> Make:
    """Consistent RIL on the small run's configuration, with overrides."""
    return lambda *overrides: make_method("ril_consistent", *overrides)


def learning_of(method: Algorithm1) -> ConsistentLearning:
    """What corrects the policy by rewards and labels."""
    correction: Any = method.correction
    assert isinstance(correction.learning, ConsistentLearning)
    return correction.learning


def trained(method: Algorithm1) -> list[Progress]:
    return list(method.train())


def test_without_reinforcement_it_imitates_as_ril_does(make: Make, make_method: Make) -> None:
    settings = (
        "method.reinforcement=false",
        "method.epochs=8",
        "method.exploration.epsilon=1",
        "method.exploration.kind=softmax",
        "method.inverse_dynamics.standardize=true",
        "method.inverse_dynamics.learning_rate=0.001",
    )
    method, ril = make(*settings), make_method("ril", *settings)
    assert method.policy.architecture == ril.policy.architecture
    ril.policy.flat.copy_(method.policy.flat)
    for found, expected in zip(trained(method), trained(ril), strict=True):
        assert found.metrics.keys() == expected.metrics.keys()
        for name, values in expected.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], values, err_msg=name)
        assert found.pseudo_labels is not None
        np.testing.assert_array_equal(found.pseudo_labels, expected.pseudo_labels)
        np.testing.assert_array_equal(found.env_samples, expected.env_samples)
    assert torch.equal(method.policy.flat, ril.policy.flat)
    states = [each.state_dict()["imitation"] for each in (method, ril)]
    assert_equal_states(*states)
    assert method.correction is None


def rewards_alone(method: Algorithm1, epochs: int, epsilon: float) -> Network:
    """The same learner, given an episode of each seed after the other, and no label."""
    config, task = cast(RILConsistentConfig, method.config), method.task
    settings, size = config.q_learning, task.environment.observation_size
    shape = learning_of(method).network.architecture
    length = len(task.expert.observations) / task.expert.trajectories
    learning = ConsistentLearning(
        Network.initialize(shape, task.seeds, "policy", CPU),
        Replay(len(task.seeds), round(500 * length), size, CPU),
        settings,
        task.seeds,
        recent=round(10 * length),
    )
    explorer = Explorer(config.exploration, task, learning.policy)
    nothing = torch.zeros(1, size)
    for epoch in range(epochs):
        rate = settings.learning_rate * (1 - epoch / epochs)
        learning.remember(explorer.play(np.full(len(task.seeds), epsilon)))
        learning.train(settings.updates, nothing, None, None, rate)
    return learning.policy


def test_without_imitation_it_learns_from_rewards_alone(make: Make) -> None:
    method = make("method.imitation=false", "method.epochs=8", "method.exploration.epsilon=0.3")
    before = method.policy.flat.clone()
    trained(method)
    assert torch.equal(method.policy.flat, rewards_alone(method, 8, 0.3).flat)
    assert (method.policy.flat != before).any(dim=1).all()


def test_without_imitation_nothing_is_imitated(make: Make) -> None:
    method = make("method.imitation=false")
    before = copied(method.state_dict())["imitation"]
    progress = trained(method)
    assert_equal_states(method.state_dict()["imitation"], before)
    assert method.cloner is None
    for each in progress:
        assert each.expert_samples.tolist() == [0, 0]
        assert each.pre_samples == 0
        assert each.pseudo_labels is None
        assert "cloning_loss" not in each.metrics
        assert "td_loss" in each.metrics


def test_without_both_halves_it_is_refused(make: Make) -> None:
    halves = "method.imitation=false method.reinforcement=false"
    with pytest.raises(UserError, match=f"^{halves}: at least one must be true"):
        make(*halves.split())


def stored(replay: Replay, seed: int) -> list[Tensor]:
    return [each[seed, : replay.sizes[seed]] for each in replay.everything()]


def test_it_remembers_its_own_episodes(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    method = make()
    own: list[Episodes] = []
    play = Explorer.play

    def recorded(explorer: Explorer, epsilon: Any) -> Episodes:
        own.append(play(explorer, epsilon))
        return own[-1]

    monkeypatch.setattr(Explorer, "play", recorded)
    progress = trained(method)
    assert len(own) == len(progress) == 3

    learning, config = learning_of(method), method.config.q_learning
    expected = Replay(2, learning.replay.capacity, 4, CPU)
    for episodes in own:
        expected.append(
            n_step(episodes, config.n_steps, config.discount, learning.reward_scale.numpy())
        )
    assert learning.replay.sizes.tolist() == expected.sizes.tolist()
    for seed in range(2):
        assert all(map(torch.equal, stored(learning.replay, seed), stored(expected, seed)))


def test_rewards_are_in_units_of_those_of_the_first_episodes(make: Make) -> None:
    assert learning_of(make()).reward_scale.tolist() == [0.0, 0.0]  # not known yet
    method = make()
    trained(method)
    assert learning_of(method).reward_scale.tolist() == [1.0, 1.0]  # CartPole pays 1 for each step


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What the learner's training is given, and what it answers; it then trains as usual."""
    recorded: list[dict[str, Any]] = []
    train = ConsistentLearning.train

    def called(
        self: ConsistentLearning,
        updates: int,
        states: Tensor,
        labels: Tensor | None,
        weights: Tensor | None,
        learning_rate: float,
    ) -> tuple[Tensor, Tensor]:
        losses = train(self, updates, states, labels, weights, learning_rate)
        given = {"updates": updates, "states": states, "labels": labels, "weights": weights}
        recorded.append(given | {"rate": learning_rate, "losses": losses})
        return losses

    monkeypatch.setattr(ConsistentLearning, "train", called)
    return recorded


def weights_of(calls: list[dict[str, Any]]) -> list[float]:
    """Of each call the one weight that all labels have."""
    for call in calls:
        assert call["weights"].shape == call["labels"].shape
        assert call["weights"].unique().numel() == 1
    return [call["weights"][0, 0].item() for call in calls]


ALL_LABELS = "method.q_learning.min_confidence=0"
WEIGHT_OF_2 = "method.q_learning.imitation_weight=2"


@pytest.mark.parametrize("upper_limit", [True, False])
def test_the_weight_of_imitation_falls_with_equation_2(
    make: Make, calls: list[dict[str, Any]], upper_limit: bool
) -> None:
    trained(
        make(
            "method.epochs=6",
            "ablation.n=4",
            "ablation.k=2",
            f"method.goal_sampler.upper_limit={str(upper_limit).lower()}",
            WEIGHT_OF_2,
            ALL_LABELS,
        )
    )
    # 1 / (1 + (4/e − 1)^(−2)) at e = 0, 1, …
    expected = [1, 1 / (1 + 3**-2), 1 / (1 + 1), 1 / (1 + 3**2), 0, 0]
    assert weights_of(calls) == pytest.approx([2 * each for each in expected])


def test_the_weight_of_imitation_falls_as_steeply_as_k_says(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    weight = "method.q_learning.imitation_weight=1"
    trained(make("method.epochs=3", "ablation.n=4", "ablation.k=1", weight, ALL_LABELS))
    expected = [1, 1 / (1 + 3**-1), 1 / (1 + 1)]
    assert weights_of(calls) == pytest.approx(expected)


def test_the_weight_of_imitation_stays_where_it_is_not_to_fade(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    trained(make("method.epochs=6", "method.q_learning.fade=false", WEIGHT_OF_2, ALL_LABELS))
    assert weights_of(calls) == [2] * 6


@pytest.mark.parametrize(("kind", "least"), [("argmax", 0.6), ("sample", 0.5)])
def test_labels_that_inverse_dynamics_is_unsure_of_have_no_weight(
    make: Make,
    calls: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    least: float,
) -> None:
    confidence = []
    infer = SelfSupervisedImitation.infer_actions

    def inferred(self: SelfSupervisedImitation) -> Tensor:
        labels = infer(self)
        expert: Any = self.task.expert
        pairs = (torch.from_numpy(x) for x in (expert.observations, expert.next_observations))
        with torch.no_grad():
            logits = self.inverse_dynamics(*(x.expand(2, -1, -1) for x in pairs))
        confidence.append(logits.softmax(dim=-1).gather(-1, labels[..., None])[..., 0])
        return labels

    monkeypatch.setattr(SelfSupervisedImitation, "infer_actions", inferred)
    labels = f"method.inverse_dynamics.labels={kind}"
    unsure = f"method.q_learning.min_confidence={least}"
    trained(make("method.q_learning.fade=false", WEIGHT_OF_2, labels, unsure))
    sure = torch.stack(confidence) >= least
    assert 0 < sure.float().mean() < 1
    weights = torch.stack([call["weights"] for call in calls])
    assert torch.equal(weights, 2.0 * sure)


def test_the_learning_rate_falls_linearly_over_the_epochs(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    settings = ("method.epochs=4", "method.episodes=2", "method.q_learning.learning_rate=0.004")
    trained(make(*settings))
    expected = np.repeat([0.004, 0.003, 0.002, 0.001], 2)
    assert [call["rate"] for call in calls] == pytest.approx(expected.tolist())


def test_the_learning_rate_stays_where_it_is_not_to_fall(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    trained(make("method.q_learning.anneal=false", "method.q_learning.learning_rate=0.004"))
    assert [call["rate"] for call in calls] == [0.004] * 3


def test_each_episode_is_followed_by_updates_on_the_labels_of_its_epoch(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    method = make("method.episodes=2", "method.q_learning.updates=3")
    progress = trained(method)
    assert [call["updates"] for call in calls] == [3] * 6
    for index, call in enumerate(calls):
        labels = progress[index // 2].pseudo_labels
        assert labels is not None
        np.testing.assert_array_equal(call["labels"].numpy(), labels)
        expert = torch.from_numpy(method.task.expert.observations)
        assert torch.equal(call["states"], expert)


def test_losses_are_means_over_the_episodes_of_an_epoch(
    make: Make, calls: list[dict[str, Any]]
) -> None:
    for epoch, each in enumerate(trained(make("method.episodes=2"))):
        both = zip(*(call["losses"] for call in calls[2 * epoch : 2 * epoch + 2]), strict=True)
        for name, losses in zip(("td_loss", "cloning_loss"), both, strict=True):
            expected = torch.stack(losses).double().mean(dim=0)
            np.testing.assert_allclose(each.metrics[name], expected)
            assert (each.metrics[name] > 0).all()


@pytest.mark.parametrize("weight", [0, 2])
def test_labels_change_the_policy_by_their_weight_alone(make: Make, weight: float) -> None:
    policies = []
    for labels in ("argmax", "sample"):
        method = make(
            f"method.q_learning.imitation_weight={weight}",
            ALL_LABELS,
            "method.exploration.epsilon=0.3",
            f"method.inverse_dynamics.labels={labels}",
        )
        trained(method)
        policies.append(method.policy.flat)
    assert torch.equal(*policies) == (weight == 0)


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("method.episodes=2",),
        ("method.imitation=false",),
        ("method.reinforcement=false",),
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one(make: Make, overrides: tuple[str, ...]) -> None:
    uninterrupted, stopped, resumed = (make("method.epochs=6", *overrides) for _ in range(3))
    expected = trained(uninterrupted)
    epochs = stopped.train()
    for _ in range(3):
        next(epochs)
    resumed.load_state_dict(copied(stopped.state_dict()))
    rest = trained(resumed)
    assert [progress.epoch for progress in rest] == [4, 5, 6]
    for found, progress in zip(rest, expected[3:], strict=True):
        np.testing.assert_array_equal(found.env_samples, progress.env_samples)
        for name, values in progress.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], values, err_msg=name)
    assert_equal_states(copied(resumed.state_dict()), copied(uninterrupted.state_dict()))


def test_the_memory_holds_as_many_mean_expert_trajectories_as_asked(make: Make) -> None:
    method = make("ablation.trajectories=3", "method.q_learning.replay_trajectories=20")
    lengths = len(method.task.expert.observations) / 3
    assert learning_of(method).replay.capacity == round(20 * lengths)


def test_the_newest_are_as_many_mean_expert_trajectories_as_asked(make: Make) -> None:
    method = make("ablation.trajectories=3", "method.q_learning.replay_recent=0.5")
    assert learning_of(method).recent == round(0.5 * len(method.task.expert.observations) / 3)
    assert learning_of(make("method.q_learning.replay_recent=null")).recent is None


def test_values_have_a_topology_of_their_own_and_the_policy_the_papers(make: Make) -> None:
    method = make("method.q_learning.value_hidden=[7,5]", "method.q_learning.temperature=0.2")
    architecture = learning_of(method).network.architecture
    assert isinstance(architecture, Consistent)
    of_policy = MLP(4, (8, 8), 2)  # §4.1
    assert architecture.policy == method.policy.architecture == of_policy
    assert architecture.value == replace(of_policy, hidden=(7, 5), outputs=1, attention=False)
    assert architecture.temperature == 0.2
    assert architecture.value_scale == method.config.q_learning.value_scale


def test_as_many_steps_as_an_episode_has_are_taken(make: Make) -> None:
    trained(make("method.q_learning.n_steps=500"))


def test_more_steps_than_an_episode_has_are_refused(make: Make) -> None:
    with pytest.raises(UserError, match=r"^method\.q_learning\.n_steps=501: .*within 1\.\.500"):
        make("method.q_learning.n_steps=501")


def test_the_policy_that_is_saved_has_the_papers_topology(
    quick: Any, tmp_path: Path, silence: Silence
) -> None:
    config = quick("method=ril_consistent", f"output_dir={tmp_path}")
    content = torch.load(run(config, silence) / "policy.pt", weights_only=True)
    description = content["architecture"]
    assert description.pop("kind") == "MLP"
    architecture = MLP(**description)
    assert architecture == MLP(4, (8, 8), 2)
    of_one = sum(rows * columns for rows, columns in architecture.shapes().values())
    for which in ("best", "last"):
        assert content[which].shape == (2, of_one)
        # The file lacks the values' parameters, although they share one tensor with the policy's.
        assert content[which].untyped_storage().nbytes() == 2 * of_one * 4


@pytest.mark.parametrize("imitation", ["true", "false"])
def test_it_learns_to_balance_the_pole(make: Make, imitation: str) -> None:
    method = make(
        f"method.imitation={imitation}",
        "seeds=4",
        "env.goal.minimum_return=195",
        "ablation.n=20",
        "method.epochs=20",
        "method.goal_sampler.pre_steps_per_action=500",
        "method.inverse_dynamics.updates=50",
        "method.inverse_dynamics.learning_rate=0.005",
        "method.q_learning.updates=100",
        "method.q_learning.batch_size=32",
        "method.q_learning.learning_rate=0.003",
        "method.q_learning.tau=0.02",
        "method.q_learning.value_hidden=[32,32]",
    )
    evaluation = Evaluation(method.task.environment, method.task.seeds)
    assert evaluation.returns(method.policy, 10, "before").mean() < 50
    trained(method)
    assert evaluation.returns(method.policy, 10, "after").mean() > 150
