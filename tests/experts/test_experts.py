"""`ril-expert`, and the demonstrations that it made for the package."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.strange import ID, Strange, registered
from hypothesis import assume, given
from hypothesis import strategies as st

from ril.cli.expert import main
from ril.config.schema import EnvironmentConfig
from ril.demonstrations.files import SHIPPED, demonstrations_path, load_demonstrations, shipped_path
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.environments.goal import reaches_goal
from ril.experts.collection import Episode, pack, play, put_first
from ril.experts.make import make_expert
from ril.experts.training import ExpertConfig
from ril.io.errors import UserError

QUICK = ("env=cartpole", "check_every=256", "episodes=20")
REACHED = (*QUICK, "target_return=60", "tolerance=0.7", "first_length=60", "total_timesteps=5000")
NAMES = ("cartpole", "acrobot", "mountaincar", "lunarlander")
Command = Callable[..., None]


@pytest.fixture
def ril_expert(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """The console command, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # set by the command; undone after the test

    def run(*overrides: str) -> None:
        monkeypatch.setattr(sys, "argv", ["ril-expert", *overrides])
        main()

    return run


def files(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


# --- the command -------------------------------------------------------------------------------


def test_an_expert_of_the_wanted_return_is_written_with_its_record(
    ril_expert: Command, tmp_path: Path, cartpole: Environment
) -> None:
    ril_expert(*REACHED)
    assert files(tmp_path) == {"demonstrations/cartpole.npz", "demonstrations/cartpole.json"}
    demonstrations = load_demonstrations(tmp_path / "demonstrations/cartpole.npz", cartpole)
    record = json.loads((tmp_path / "demonstrations/cartpole.json").read_text())
    assert record["command"] == " ".join(["ril-expert", *REACHED])
    assert record["sha256"] == demonstrations.sha256
    assert record["episodes"] == len(demonstrations.lengths) == 20
    assert record["returns"]["mean"] == pytest.approx(demonstrations.returns.mean())
    assert abs(record["returns"]["mean"] - 60) <= 42
    assert abs(record["evaluation_mean_return"] - 60) <= 42
    assert record["first"]["length"] == demonstrations.lengths[0]


def test_the_same_command_writes_the_same_bytes(ril_expert: Command, tmp_path: Path) -> None:
    for name in ("a", "b"):
        ril_expert(*REACHED, f"output={name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_dqn_trains_too(ril_expert: Command, tmp_path: Path) -> None:
    ril_expert(*REACHED, "algorithm=dqn", "target_return=10", "tolerance=1", "output=q.npz")
    assert files(tmp_path) == {"q.npz", "q.json"}


def test_any_gymnasium_environment_can_be_named(ril_expert: Command, tmp_path: Path) -> None:
    ril_expert(
        "env=gym", "env.id=MountainCar-v0", "target_return=-200", "ppo.n_steps=32",
        "check_every=256", "episodes=2",
    )  # fmt: skip
    assert files(tmp_path) == {
        "demonstrations/MountainCar-v0.npz",
        "demonstrations/MountainCar-v0.json",
    }


def test_a_target_out_of_reach_leaves_everything_as_it_was(
    ril_expert: Command, tmp_path: Path
) -> None:
    (tmp_path / "old.npz").write_bytes(b"precious")
    with pytest.raises(
        SystemExit, match=r"^ril-expert: target_return=900: not reached .*"
    ) as exit_:
        ril_expert(*QUICK, "target_return=900", "total_timesteps=300", "output=old.npz")
    assert "\n" not in str(exit_.value)
    assert files(tmp_path) == {"old.npz"}
    assert (tmp_path / "old.npz").read_bytes() == b"precious"


@given(
    wrong=st.one_of(
        st.tuples(st.just("algorithm"), st.text(max_size=5)),
        st.tuples(st.just("target_return"), st.sampled_from([math.nan, math.inf, -math.inf])),
        st.tuples(st.just("tolerance"), st.floats(max_value=0) | st.just(math.inf)),
        st.tuples(st.just("check_every"), st.integers(max_value=0) | st.integers(5001)),
        st.tuples(st.just("seed"), st.integers(max_value=-1) | st.integers(2**32)),
        st.tuples(
            st.sampled_from(["total_timesteps", "episodes", "first_length"]),
            st.integers(max_value=0),
        ),
    )
)
def test_a_value_out_of_bounds_is_refused_by_its_key(wrong: tuple[str, Any]) -> None:
    allowed = {
        "env": EnvironmentConfig("cartpole", "CartPole-v1"),
        "algorithm": "ppo",
        "target_return": 60.0,
        "tolerance": 0.7,
        "total_timesteps": 5000,
        "check_every": 256,
        "episodes": 20,
        "seed": 0,
        "output": "expert.npz",
        "device": "cpu",
    }
    key, value = wrong
    assume((key, value) not in [("algorithm", "ppo"), ("algorithm", "dqn")])
    with pytest.raises(UserError) as refused:
        make_expert(ExpertConfig(**allowed | {key: value}), "", lambda *_: None)
    assert str(refused.value).startswith(f"{key}={value}: must be ")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("env=chess", "env=chess: unknown; choose one of acrobot, cartpole"),
        ("target=3", "target: no such key; is it target_return"),
        ("total_timesteps=soon", "total_timesteps: "),
        ("output=expert.csv", "output=expert.csv: must be a file named"),
        ("output=file/expert.npz", "output=file/expert.npz: must be in a writable folder"),
        ("device=abacus", "device=abacus: torch cannot use it"),
        ("ppo.gamma=high", "ppo.gamma=high: must be a number"),
        ("ppo.learning_rate=lin_x", "ppo.learning_rate=lin_x: must be a number"),
        ("ppo.normalize=2", "ppo.normalize=2: must be true or false"),
        ("ppo.n_envs=0", "ppo.n_envs=0: must be a whole number"),
        ("+ppo.magic=1", "ppo.magic=1: no such key of PPO"),
        ("ppo.n_steps=1.5", "ppo: PPO refuses a value: "),
        ("env.id=Nope-v0", "env.id=Nope-v0: "),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_mistake_is_one_line_and_writes_nothing(
    ril_expert: Command, tmp_path: Path, override: str, said: str
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as exit_:
        ril_expert(*QUICK, override)
    message = str(exit_.value)
    assert message.startswith(f"ril-expert: {said}")
    assert "\n" not in message
    assert files(tmp_path) == {"file"}


@pytest.mark.parametrize(
    ("how", "after", "said"),
    [
        ("raises", 0, "step: RuntimeError: the simulator is gone"),
        ("raises", 900, "step: RuntimeError: the simulator is gone"),
        ("a vector reward", 0, "step returned the reward an array of shape (2,)"),
        ("one only", 0, "the port is in use"),
    ],
)
def test_an_environments_fault_is_one_line_and_closes_it(
    ril_expert: Command, tmp_path: Path, how: str, after: int, said: str
) -> None:
    changes = f"+env.kwargs.how='{how}'", f"+env.kwargs.after={after}", "target_return=-9"
    with registered():
        with pytest.raises(SystemExit) as exit_:
            ril_expert("env=gym", f"env.id={ID}", *changes, *QUICK[1:], "total_timesteps=2000")
        assert set(Strange.made) == set(Strange.closed)
    assert str(exit_.value).startswith(f"ril-expert: env.id={ID}: {said}")
    assert files(tmp_path) == set()


# --- episodes ----------------------------------------------------------------------------------


def episode(length: int, total_reward: float) -> Episode:
    rewards = np.zeros(length, dtype=np.float32)
    rewards[-1] = total_reward
    states = np.zeros((length + 1, 2), dtype=np.float32)
    return Episode(0, states, np.zeros(length, dtype=np.int64), rewards, True)


def test_the_nearest_in_length_comes_first_and_the_others_keep_their_order() -> None:
    episodes = [episode(90, -90), episode(120, -120), episode(105, -105), episode(95, -95)]
    ordered = put_first(episodes, first_length=106, target_return=-106, margin=50)
    assert [e.length for e in ordered] == [105, 90, 120, 95]


def test_the_first_is_typical_and_the_best_of_equally_near_ones() -> None:
    episodes = [episode(106, -130), episode(104, -100), episode(108, -90), episode(104, -95)]
    assert put_first(episodes, 106, target_return=-106, margin=20)[0] is episodes[2]


def test_the_best_episode_of_a_sub_optimal_expert_does_not_come_first() -> None:
    episodes = [episode(length, -length) for length in (106, 135, 140, 145, 165)]
    assert put_first(episodes, 106, target_return=-140, margin=4)[0] is episodes[1]


def test_without_a_typical_episode_the_nearest_comes_first() -> None:
    episodes = [episode(50, -130), episode(106, -140)]
    assert put_first(episodes, 106, target_return=-100, margin=3)[0] is episodes[1]


def test_without_a_first_length_the_order_stays() -> None:
    episodes = [episode(9, 0), episode(3, 5)]
    assert put_first(episodes, None, target_return=5, margin=1) == episodes


def test_playing_together_equals_playing_one_after_another(mountaincar: Environment) -> None:
    def pump(observations: np.ndarray) -> np.ndarray:
        return np.where(observations[:, 1] >= 0, 2, 0)

    together = pack(play(mountaincar, pump, [5, 6, 7]))
    alone = [pack(play(mountaincar, pump, [seed])) for seed in (5, 6, 7)]
    np.testing.assert_array_equal(
        together["observations"], np.concatenate([a["observations"] for a in alone])
    )
    assert together["lengths"].tolist() == [a["lengths"][0] for a in alone]
    assert together["terminated"].all()


# --- the shipped files -------------------------------------------------------------------------


@pytest.fixture(params=NAMES)
def shipped(
    request: pytest.FixtureRequest, environments: dict[str, Environment]
) -> tuple[str, Environment, Demonstrations, dict]:
    environment = environments[request.param]
    demonstrations = load_demonstrations(shipped_path(request.param), environment)
    record = json.loads((SHIPPED / f"{request.param}.json").read_text())
    return request.param, environment, demonstrations, record


def test_shipped_demonstrations_are_100_with_the_papers_return(
    shipped: tuple[str, Environment, Demonstrations, dict],
) -> None:
    name, _, demonstrations, _ = shipped
    paper = {"cartpole": 500, "acrobot": -85, "mountaincar": -106, "lunarlander": 235.96}[name]
    assert len(demonstrations.lengths) == 100
    assert demonstrations.returns.mean() == pytest.approx(paper, rel=0.03)


def test_shipped_demonstrations_are_what_their_record_says(
    shipped: tuple[str, Environment, Demonstrations, dict],
) -> None:
    name, _, demonstrations, record = shipped
    assert record["sha256"] == hashlib.sha256(shipped_path(name).read_bytes()).hexdigest()
    assert record["transitions"] == len(demonstrations.actions)
    assert record["returns"]["mean"] == pytest.approx(demonstrations.returns.mean(), abs=1e-3)
    assert record["first"]["length"] == demonstrations.lengths[0]
    assert record["first"]["return"] == pytest.approx(demonstrations.returns[0], abs=1e-3)


# Table 9: the levels of its sub-optimal experts.
LEVELS = {
    "cartpole": (400, 300, 200, 100),
    "acrobot": (-100, -150, -200, -250),
    "mountaincar": (-140, -150),
}


@pytest.mark.parametrize(("name", "level"), [(n, level) for n in LEVELS for level in LEVELS[n]])
def test_sub_optimal_experts_have_the_papers_returns(
    compose: Any, environments: dict[str, Environment], name: str, level: int
) -> None:
    path = demonstrations_path(compose(f"env={name}", f"ablation.expert_return={level}"))
    demonstrations = load_demonstrations(path, environments[name])
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["config"]["target_return"] == level
    assert record["sha256"] == demonstrations.sha256
    assert len(demonstrations.lengths) >= 10
    assert demonstrations.returns.mean() == pytest.approx(level, rel=0.05)


def test_the_first_shipped_trajectory_reaches_the_goal(
    shipped: tuple[str, Environment, Demonstrations, dict],
) -> None:
    name, environment, demonstrations, _ = shipped
    with np.load(shipped_path(name)) as archive:
        arrays = dict(archive)
    assert reaches_goal(
        environment.config.goal,
        returns=demonstrations.returns[:1],
        final_rewards=arrays["rewards"][demonstrations.lengths[:1] - 1],
        terminated=arrays["terminated"][:1],
    ).all()


def test_shipped_trajectories_begin_where_their_reset_seeds_do(
    shipped: tuple[str, Environment, Demonstrations, dict],
) -> None:
    _, environment, demonstrations, record = shipped
    copy = environment.make()
    starts = np.cumsum(demonstrations.lengths + 1) - (demonstrations.lengths + 1)
    for start, seed in list(zip(starts, record["reset_seeds"], strict=True))[:10]:
        np.testing.assert_allclose(
            demonstrations.observations[start], copy.reset(seed=seed)[0], atol=1e-5
        )


def test_shipped_mountaincar_replays_step_by_step(mountaincar: Environment) -> None:
    demonstrations = load_demonstrations(shipped_path("mountaincar"), mountaincar)
    copy = mountaincar.make()
    state = iter(demonstrations.observations)
    action = iter(demonstrations.actions)
    for length in demonstrations.lengths[:10]:
        copy.reset(seed=0)
        copy.unwrapped.state = np.array(next(state), dtype=np.float64)
        for _ in range(length):
            observation, _, terminated, _, _ = copy.step(next(action))
            np.testing.assert_allclose(observation, next(state), atol=1e-4)
        assert terminated


def test_shipped_demonstrations_are_small() -> None:
    assert sum(file.stat().st_size for file in SHIPPED.iterdir()) < 5_000_000
