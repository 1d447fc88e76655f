from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv
from helpers.references import random_network
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from scipy.special import softmax
from scipy.stats import entropy

from ril.environments.environment import Environment
from ril.io.errors import UserError
from ril.policy import load_policy, save_policies
from ril.report.figures.mountaincar import (
    COLORS,
    action_distributions,
    action_maps,
    probability_meshes,
    representative_seed,
)
from ril.report.figures.style import SMALL, as_svg
from ril.report.mountaincar import (
    STARTS,
    DiscretePolicy,
    Measures,
    agreement,
    cells,
    divergence,
    divergences,
    greedy_divergence,
    measures,
    optimal_policy,
    optimal_reward,
    play,
    step,
)
from ril.vectorized.architectures import MLP

ALL_STATES = cells().reshape(-1, 2)
RANDOM = np.random.default_rng(0)
LEFT, NONE, RIGHT = range(3)


class Scripted:
    """A policy whose outputs are a function of the observations."""

    def __init__(self, outputs: Callable[[np.ndarray], np.ndarray]) -> None:
        self.values = outputs

    def probabilities(self, observations: np.ndarray) -> np.ndarray:
        return softmax(self.values(observations), axis=-1)

    def predict(self, observations: np.ndarray) -> np.ndarray:
        return self.values(observations).argmax(axis=-1)


def always(action: int, certainty: float = 1.0) -> Scripted:
    return Scripted(lambda states: np.tile(certainty * np.eye(3)[action], (len(states), 1)))


def push(states: np.ndarray) -> np.ndarray:
    """Along the motion; to the right at rest."""
    return np.eye(3)[np.where(states[:, 1] < 0, LEFT, RIGHT)]


PUSH = Scripted(push)
RANDOM_WEIGHTS = RANDOM.normal(size=(2, 3))
LINEAR = Scripted(lambda states: states @ RANDOM_WEIGHTS)


def outcomes_in_the_environment(
    states: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    environment = MountainCarEnv()
    following, ended = [], []
    for state, action in zip(states, actions, strict=True):
        environment.state = tuple(state)
        ended.append(environment.step(int(action))[2])
        following.append(environment.state)
    return np.array(following), np.array(ended)


@pytest.fixture(scope="module")
def transitions() -> tuple[np.ndarray, np.ndarray]:
    """From everywhere, and as many from beside the wall and the goal, where special cases are."""
    low, high = [-1.2, -0.07], [0.6, 0.07]
    anywhere = RANDOM.uniform(low, high, size=(2000, 2))
    at_the_wall = RANDOM.uniform([-1.2, -0.07], [-1.1, 0], size=(1000, 2))
    at_the_goal = RANDOM.uniform([0.4, 0], [0.55, 0.07], size=(1000, 2))
    states = np.concatenate([anywhere, at_the_wall, at_the_goal])
    return states, RANDOM.integers(3, size=len(states))


def test_a_step_is_the_environments(transitions: tuple[np.ndarray, np.ndarray]) -> None:
    found, _ = step(*transitions)
    expected, _ = outcomes_in_the_environment(*transitions)
    assert ((expected[:, 0] == -1.2) & (expected[:, 1] == 0)).sum() > 100  # the wall was met
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_a_step_ends_where_the_environment_does(
    transitions: tuple[np.ndarray, np.ndarray],
) -> None:
    _, found = step(*transitions)
    _, expected = outcomes_in_the_environment(*transitions)
    assert 0.1 < expected.mean() < 0.9
    assert (found == expected).all()


@pytest.mark.parametrize("policy", [PUSH, always(LEFT)])
def test_an_episode_is_the_environments(policy: Scripted) -> None:
    environment = gym.make("MountainCar-v0")
    observation, _ = environment.reset(options={"low": -0.45, "high": -0.45})
    seen, total, over = [], 0.0, False
    while not over:
        seen.append(observation)
        action = int(policy.predict(observation[None])[0])
        observation, reward, terminated, truncated, _ = environment.step(action)
        total += float(reward)
        over = terminated or truncated
    returns, visited = play(policy, np.array([-0.45]))
    assert returns.tolist() == [total]
    np.testing.assert_allclose(visited, seen, rtol=0, atol=1e-7)


def test_each_step_of_each_episode_is_a_visited_state() -> None:
    returns, visited = play(PUSH, np.linspace(-0.6, -0.4, 7))
    assert len(visited) == -returns.sum()


def test_an_episode_does_not_depend_on_the_others() -> None:
    together, _ = play(PUSH, np.linspace(-0.6, -0.4, 7))
    alone = [play(PUSH, np.array([start]))[0][0] for start in np.linspace(-0.6, -0.4, 7)]
    assert together.tolist() == alone


def test_optimal_values_are_a_fixed_point() -> None:
    optimal = optimal_policy()
    axes = np.linspace(-1.2, 0.6, 541), np.linspace(-0.07, 0.07, 421)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    improved = optimal.values(nodes).max(axis=-1)
    np.testing.assert_allclose(improved, optimal.node_values, rtol=0, atol=1e-5)


def best_of_two_switches(starts: np.ndarray) -> np.ndarray:
    """Returns of the best of all plans that push one way, the other, and the first way again."""
    times = np.array([(first, then) for first in range(60) for then in range(first, 110)])
    best = np.full(len(starts), -200.0)
    for begin in (LEFT, RIGHT):
        states = np.zeros((len(starts), len(times), 2))
        states[..., 0] = starts[:, None]
        steps = np.full(states.shape[:2], 200)
        for time in range(120):
            away = (times[:, 0] <= time) & (time < times[:, 1])
            states, terminated = step(states, np.where(away, 2 - begin, begin))
            steps = np.where(terminated, np.minimum(steps, time + 1), steps)
        best = np.maximum(best, -steps.min(axis=1))
    return best


def test_optimal_returns_are_those_of_the_best_plan() -> None:
    starts = np.linspace(-0.59, -0.41, 6)
    returns, _ = play(optimal_policy(), starts)
    lost = best_of_two_switches(starts) - returns
    assert lost.mean() < 0.5
    assert lost.max() <= 2


@pytest.mark.parametrize("other", [PUSH, LINEAR, always(LEFT), always(NONE), always(RIGHT)])
def test_no_policy_returns_more_than_the_optimal_one(other: Scripted) -> None:
    returns, _ = play(optimal_policy(), STARTS)
    others, _ = play(other, STARTS)
    assert (returns >= others - 2).all()  # a start or two is a step off on the grid
    assert returns.mean() > others.mean() + 10


def test_an_optimal_value_is_minus_the_steps_to_the_goal() -> None:
    starts = np.linspace(-0.6, -0.4, 20)
    at_rest = np.stack([starts, np.zeros(20)], axis=-1).astype(np.float32)
    returns, _ = play(optimal_policy(), starts)
    values = optimal_policy().values(at_rest).max(axis=-1)
    assert abs((values - returns).mean()) < 0.5


def test_optimal_probabilities_are_the_softmax_of_the_values() -> None:
    values = optimal_policy().values(ALL_STATES)
    expected = torch.from_numpy(values).softmax(dim=-1).numpy()
    np.testing.assert_allclose(optimal_policy().probabilities(ALL_STATES), expected, rtol=1e-9)


def test_a_step_before_the_goal_no_action_is_more_likely() -> None:
    found = optimal_policy().probabilities(np.array([[0.49, 0.06]], dtype=np.float32))
    np.testing.assert_allclose(found, 1 / 3)


@pytest.mark.parametrize(("velocity", "action"), [(0.06, RIGHT), (-0.07, LEFT)])
def test_of_equally_good_actions_the_one_along_the_motion_is_chosen(
    velocity: float, action: int
) -> None:
    position = 0.48 if velocity > 0 else -1.19  # the goal, or the wall, whatever is done
    state = np.array([[position, velocity]], dtype=np.float32)
    assert optimal_policy().predict(state).tolist() == [action]


def test_a_policy_does_not_diverge_from_itself() -> None:
    assert divergence(optimal_policy(), ALL_STATES).max() == 0
    assert greedy_divergence(optimal_policy(), ALL_STATES).max() == 0


def test_a_divergence_is_of_the_optimal_policy_from_the_other() -> None:
    expected = entropy(
        optimal_policy().probabilities(ALL_STATES), LINEAR.probabilities(ALL_STATES), axis=-1
    )
    np.testing.assert_allclose(divergence(LINEAR, ALL_STATES), expected, rtol=1e-6, atol=1e-9)


def test_a_divergence_is_finite_where_probabilities_round_to_0() -> None:
    found = divergence(always(NONE, 1e4), ALL_STATES)
    assert np.isfinite(found).all()
    assert found.max() > 5000


def test_a_greedy_divergence_counts_other_actions() -> None:
    other = ~agreement(PUSH, ALL_STATES)
    found = greedy_divergence(PUSH, ALL_STATES)
    assert 0 < other.sum() < len(other)
    np.testing.assert_allclose(found, found.max() * other)


@pytest.mark.parametrize(("others", "papers"), [(15, 1.7345), (7, 0.8094)])
def test_so_many_other_actions_in_86_are_the_papers_numbers(others: int, papers: float) -> None:
    per_action = greedy_divergence(PUSH, ALL_STATES).max()
    assert round(others * per_action / 86, 4) == papers


def test_measures_of_the_optimal_policy() -> None:
    assert measures(optimal_policy()) == Measures(optimal_reward(), 0, 0, 1, 1)


def test_divergences_weigh_the_states_of_optimal_episodes() -> None:
    _, visited = play(optimal_policy(), STARTS)
    found = measures(PUSH)
    assert found.divergence == pytest.approx(divergence(PUSH, visited).mean())
    assert found.agreement == agreement(PUSH, visited).mean()


@pytest.fixture
def rows(tmp_path: Path, mountaincar: Environment) -> pd.DataFrame:
    """Of a run with two seeds, in an order of their own."""
    architecture = MLP(inputs=2, hidden=(6,), outputs=3)
    network = random_network(architecture, 2)
    best, last = -network.flat, network.flat
    save_policies(tmp_path / "policy.pt", mountaincar, architecture, (3, 8), best=best, last=last)
    return pd.DataFrame({"seed": [8, 3], "folder": [tmp_path, tmp_path]}, index=[5, 2])


@pytest.mark.parametrize("which", ["best", "last"])
def test_each_row_has_its_own_policys_measures(rows: pd.DataFrame, which: str) -> None:
    found = divergences(rows, which)
    for index, row in rows.iterrows():
        expected = measures(load_policy(row["folder"] / "policy.pt", row["seed"], which))
        assert found.loc[index].to_dict() == expected._asdict()


def test_no_rows_have_no_divergences(rows: pd.DataFrame) -> None:
    assert divergences(rows[:0]).empty


def test_a_run_without_policies_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"policy\.pt"):
        divergences(pd.DataFrame({"seed": [0], "folder": [tmp_path]}))


def test_cells_are_within_what_a_policy_sees() -> None:
    assert cells().shape == (20, 20, 2)
    np.testing.assert_allclose(ALL_STATES.min(axis=0), [-1.2 + 0.0425, -0.0665], atol=1e-6)
    np.testing.assert_allclose(ALL_STATES.max(axis=0), [0.5 - 0.0425, 0.0665], atol=1e-6)


@pytest.mark.parametrize(
    ("scores", "seed"), [([-99.0, -120.0, -105.0], 2), ([-99.0, -120.0, -105.0, -101.0], 2)]
)
def test_the_representative_seed_has_the_median_aer(scores: list[float], seed: int) -> None:
    rows = pd.DataFrame({"seed": range(len(scores)), "aer": scores}).sample(frac=1, random_state=0)
    assert representative_seed(rows) == seed


FIGURES = [probability_meshes, action_maps, action_distributions]


def policies() -> dict[str, DiscretePolicy | None]:
    return {"π*": optimal_policy(), "RL": PUSH, "IL": LINEAR, "RIL": None}


@cache
def drawn(make: Callable[..., Figure]) -> Figure:
    return make(policies(), {"RIL": "ril-run method=ril"})


def panels(make: Callable[..., Figure]) -> dict[str, Any]:
    """The panels of a figure by the first word of their titles."""
    return {ax.get_title().split(":")[0]: ax for ax in drawn(make).axes}


@pytest.mark.parametrize("make", FIGURES)
def test_a_figure_has_a_panel_for_each_policy(make: Callable[..., Figure]) -> None:
    assert list(panels(make)) == list(policies())


@pytest.mark.parametrize("make", FIGURES)
def test_a_policy_that_is_not_run_has_its_command_instead(make: Callable[..., Figure]) -> None:
    said = {title: [text.get_text() for text in ax.texts] for title, ax in panels(make).items()}
    assert said == {"π*": [], "RL": [], "IL": [], "RIL": ["not run\nril-run method=ril"]}
    assert not panels(make)["RIL"].collections


@pytest.mark.parametrize("make", FIGURES)
def test_a_figure_is_a_small_drawing(make: Callable[..., Figure]) -> None:
    assert len(as_svg(drawn(make), "figure")) < 1_000_000


@pytest.mark.parametrize("make", FIGURES)
def test_no_text_is_too_small(make: Callable[..., Figure]) -> None:
    figure = drawn(make)
    texts = figure.findobj(lambda artist: hasattr(artist, "get_fontsize"))
    assert min(text.get_fontsize() for text in texts if text.get_text()) >= SMALL


@pytest.mark.parametrize("title", ["π*", "RL", "IL"])
def test_meshes_are_as_high_as_the_most_likely_actions_probability(title: str) -> None:
    policy = policies()[title]
    assert policy is not None
    most_likely = policy.probabilities(cells(30).reshape(-1, 2)).max(axis=-1)
    found = panels(probability_meshes)[title].zz_dataLim.intervalx
    np.testing.assert_allclose(found, [most_likely.min(), most_likely.max()])


def test_meshes_have_one_scale() -> None:
    assert {ax.get_zlim() for ax in panels(probability_meshes).values()} == {(1 / 3, 1)}


def test_maps_are_colored_by_action_where_it_is_the_optimal_one() -> None:
    mesh, *_ = panels(action_maps)["RL"].collections
    same = agreement(PUSH, ALL_STATES)
    mesh.update_scalarmappable()
    expected = np.array([to_rgba(color) for color in COLORS])[PUSH.predict(ALL_STATES)]
    expected[~same] = 0
    np.testing.assert_allclose(mesh.get_facecolors(), expected, atol=1e-6)


def test_maps_mark_the_other_actions() -> None:
    _, *marks = panels(action_maps)["RL"].collections
    other = ~agreement(PUSH, ALL_STATES)
    counts = np.bincount(PUSH.predict(ALL_STATES)[other], minlength=3)
    assert [len(mark.get_offsets()) for mark in marks] == counts.tolist()


def test_maps_name_the_share_that_agrees() -> None:
    share = agreement(PUSH, ALL_STATES).mean()
    assert panels(action_maps)["RL"].get_title() == f"RL: {share:.0%} agree"


def test_distributions_are_of_the_states_of_an_optimal_episode() -> None:
    _, path = play(optimal_policy(), np.array([-0.5]))
    left, *_ = panels(action_distributions)["IL"].collections
    [outline] = left.get_paths()
    x, y = outline.vertices.T
    for at, probability in enumerate(LINEAR.probabilities(path)[:, LEFT]):
        assert y[x == at].max() == pytest.approx(probability, abs=1e-6)
