"""What holds of all methods alike."""

from __future__ import annotations

import gc
import types
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from helpers.runs import Silence
from helpers.states import assert_equal_states, copied
from torch import Tensor

from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.environments.environment import Environment
from ril.experts.collection import Episode, save
from ril.methods.base import Method, Progress
from ril.methods.registry import names, spec
from ril.policy import load_policy
from ril.run.experiment import run
from ril.run.identity import run_id
from ril.vectorized.streams import Streams

EVERY = tuple(name for name in names() if spec(name).build is not None)
SEES_ACTIONS, SEES_STATES_ONLY, SEES_NOTHING = (
    tuple(name for name in EVERY if spec(name).expert == given)
    for given in ("states and actions", "states", "nothing")
)

Make = Callable[..., Method]


def test_all_but_the_references_are_trained() -> None:
    assert set(names()) - set(EVERY) == {"random", "expert"}


def test_methods_from_observation_are_shown_states_only() -> None:
    assert SEES_STATES_ONLY == ("ilpo", "iupe", "ril", "ril_consistent", "ril_sequential")


def test_methods_from_rewards_alone_are_shown_nothing() -> None:
    assert SEES_NOTHING == ("acktr", "dqn", "dqn_prioritized", "ppo")


@pytest.fixture(scope="module")
def make(make_method: Make) -> Make:
    return make_method


def trained(method: Method) -> list[Progress]:
    return list(method.train())


def assert_same_progress(found: list[Progress], expected: list[Progress], seed: Any = ...) -> None:
    """Compare bit by bit; `seed` picks a seed of `found`, where `expected` has a single one."""
    for one, other in zip(found, expected, strict=True):
        assert (one.epoch, one.pre_samples, one.can_act) == (
            other.epoch,
            other.pre_samples,
            other.can_act,
        )
        assert one.metrics.keys() == other.metrics.keys()
        pairs = [(one.metrics[name], values) for name, values in other.metrics.items()]
        for field in ("env_samples", "expert_samples", "stopped"):
            pairs.append((getattr(one, field), getattr(other, field)))
        assert (one.pseudo_labels is None) == (other.pseudo_labels is None)
        if one.pseudo_labels is not None:
            pairs.append((one.pseudo_labels, other.pseudo_labels))
        for values, reference in pairs:
            np.testing.assert_array_equal(
                values[seed], reference[0] if seed is not ... else reference
            )


# Sizes as in conf/, since which kernel multiplies depends on them.
CLONING = ("method.cloning.batch_size=32",)
IMITATION = (*CLONING, "method.inverse_dynamics.batch_size=128")
SIZES = {
    "acktr": ("method.n_envs=16", "method.n_steps=20", "method.total_timesteps=1280"),
    "bc": CLONING,
    "dqn": ("method.q_learning.batch_size=128",),  # CartPole has 64
    "dqn_prioritized": ("method.q_learning.batch_size=128",),
    "gail": ("method.discriminator.batch_size=256",),
    "ilpo": ("method.latent_policy.batch_size=32", "method.remapping.batch_size=32"),
    "iupe": IMITATION,
    "ppo": ("method.ppo.batch_size=64",),
    "ril": (*IMITATION, "method.q_learning.batch_size=32"),
    "ril_consistent": (
        *IMITATION,
        "method.q_learning.batch_size=64",
        "method.q_learning.value_hidden=[64,64]",
    ),
    "ril_sequential": (*IMITATION, "method.q_learning.batch_size=32"),
}
MOUNTAINCAR = ("env=mountaincar", "env.goal.minimum_return=null")
LUNARLANDER = (
    "env=lunarlander",
    "env.goal.minimum_return=null",
    f"demonstrations={shipped_path('lunarlander')}",
)
ENVIRONMENTS = {"cartpole": (), "mountaincar": MOUNTAINCAR, "lunarlander": LUNARLANDER}


@pytest.fixture(scope="module", params=EVERY)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module", params=ENVIRONMENTS)
def alone_and_among(request: pytest.FixtureRequest, name: str, make: Make) -> Any:
    """Seed 5 alone, and between seeds 3 and 9, with their progress."""
    runs = []
    for seeds in ("[5]", "[3,5,9]"):
        method = make(name, *ENVIRONMENTS[request.param], *SIZES.get(name, ()), f"seeds={seeds}")
        runs.append((method, trained(method)))
    return runs


def test_a_seeds_policy_does_not_depend_on_other_seeds(alone_and_among: Any) -> None:
    (alone, _), (among, _) = alone_and_among
    assert torch.equal(among.policy.flat[1], alone.policy.flat[0])


def test_a_seeds_progress_does_not_depend_on_other_seeds(alone_and_among: Any) -> None:
    (_, alone), (_, among) = alone_and_among
    assert_same_progress(among, alone, seed=1)


def test_seeds_differ(alone_and_among: Any) -> None:
    _, (among, _) = alone_and_among
    first, second, third = among.policy.flat
    assert not torch.equal(first, second)
    assert not torch.equal(second, third)


def test_training_twice_gives_the_same(name: str, make: Make, once: Any) -> None:
    _, first, expected = once
    second = make(name)
    assert_same_progress(trained(second), expected)
    assert_equal_states(second.state_dict(), first.state_dict())


@pytest.fixture(scope="module")
def once(name: str, make: Make) -> tuple[Tensor, Method, list[Progress]]:
    """The policy before training, and a method that was trained once, with its progress."""
    method = make(name)
    before = method.policy.flat.clone()
    return before, method, trained(method)


def test_training_changes_every_seeds_policy(once: Any) -> None:
    before, method, _ = once
    assert (method.policy.flat != before).any(dim=1).all()


def test_training_ends_after_its_epochs(once: Any) -> None:
    _, method, progress = once
    assert [each.epoch for each in progress] == list(range(1, method.epochs + 1))


def test_samples_never_fall(once: Any) -> None:
    for before, after in pairwise(once[2]):
        assert (after.env_samples >= before.env_samples).all()
        assert (after.expert_samples >= before.expert_samples).all()


# Where in its training a method is stopped: in each of its phases and between them.
PHASES = {
    "dqn": (5, 33),  # before the first update and after
    "dqn_prioritized": (5, 33),
    "ilpo": (1, 2, 3),
    "ril_sequential": (2, 3, 30),
}
STOPS = [(name, after, "cartpole") for name in EVERY for after in PHASES.get(name, (2,))]
#: Where episodes are truncated: one method for each way in which they are played.
STOPS += [(name, 2, "mountaincar") for name in ("acktr", "dqn", "gail", "ilpo", "ppo", "ril")]


@pytest.mark.parametrize(
    ("name", "after", "env"),
    [
        pytest.param(*stop, marks=[pytest.mark.quick] if stop[0] in ("dqn", "ril") else [])
        for stop in STOPS
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    make: Make, name: str, after: int, env: str
) -> None:
    uninterrupted, stopped, resumed = (make(name, *ENVIRONMENTS[env]) for _ in range(3))
    expected = trained(uninterrupted)
    epochs = stopped.train()
    for _ in range(after):
        next(epochs)
    resumed.load_state_dict(copied(stopped.state_dict()))
    assert_equal_states(copied(resumed.state_dict()), copied(stopped.state_dict()))
    assert torch.equal(resumed.policy.flat, stopped.policy.flat)
    rest = trained(resumed)
    assert len(rest) == len(expected) - after > 0
    assert_same_progress(rest, expected[after:])
    assert torch.equal(resumed.policy.flat, uninterrupted.policy.flat)
    assert_equal_states(resumed.state_dict(), uninterrupted.state_dict())


def test_a_finished_state_has_nothing_left_to_train(name: str, make: Make, once: Any) -> None:
    resumed = make(name)
    resumed.load_state_dict(copied(once[1].state_dict()))
    assert trained(resumed) == []


@pytest.fixture(scope="module")
def folder(name: str, quick: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a finished run left its files."""
    config = quick(f"method={name}", "evaluation.every=1")
    config.output_dir = str(tmp_path_factory.mktemp("outputs"))
    return run(config, Silence())


def mean_return(path: Path, seed: int, which: str) -> float:
    """Of a saved policy on the episodes of a result, by a plain Gymnasium loop."""
    policy, copy = load_policy(path, seed, which), gym.make("CartPole-v1")
    [starts] = Streams([seed], "evaluation of the result").integers(2**31, 3)
    total = 0.0
    for start in starts:
        observation, _ = copy.reset(seed=int(start))
        over = False
        while not over:
            action = int(policy.predict(observation))
            observation, reward, terminated, truncated, _ = copy.step(action)
            total, over = total + float(reward), terminated or truncated
    return total / 3


@pytest.mark.quick
@pytest.mark.parametrize(("column", "which"), [("aer", "best"), ("aer_last", "last")])
def test_the_saved_policy_acts_as_scored(folder: Path, column: str, which: str) -> None:
    for row in pd.read_csv(folder / "results.csv").to_dict("records"):
        assert mean_return(folder / "policy.pt", row["seed"], which) == pytest.approx(row[column])


def test_the_saved_policy_is_the_trained_one(
    once: Any, folder: Path, cartpole: Environment
) -> None:
    method = once[1]
    low, high = cartpole.low, cartpole.high
    raw = np.random.default_rng(0).uniform(low, high, size=(60, 4)).astype(np.float32)
    expected = method.policy.infer(np.concatenate([cartpole.scale(raw)] * 2)).numpy()
    for index, seed in enumerate((0, 1)):
        values = load_policy(folder / "policy.pt", seed, "last").values(raw)
        np.testing.assert_allclose(values, expected[index], rtol=1e-4, atol=1e-5)


def test_a_policy_is_scored_only_once_it_can_act(folder: Path, once: Any) -> None:
    can_act = [progress.epoch for progress in once[2] if progress.can_act]
    curve = pd.read_csv(folder / "curve.csv")
    assert sorted(set(curve["epoch"])) == can_act


@pytest.mark.quick
def test_rows_have_the_trajectories_that_were_used(name: str, folder: Path) -> None:
    trajectories = pd.read_csv(folder / "results.csv")["trajectories"]
    assert trajectories.isna().tolist() == [name in SEES_NOTHING] * 2


def test_rows_have_the_budget_where_it_is_of_steps(name: str, folder: Path, quick: Any) -> None:
    budget = getattr(quick(f"method={name}").method, "total_timesteps", None)
    found = pd.read_csv(folder / "results.csv")["total_timesteps"]
    assert found.dropna().tolist() == ([] if budget is None else [budget] * 2)


def test_run_id_depends_on_the_trajectories_where_they_are_seen(name: str, quick: Any) -> None:
    one, other = (
        run_id(quick(f"method={name}", f"ablation.trajectories={count}"), "0") for count in (1, 2)
    )
    assert (one == other) is (name in SEES_NOTHING)


def episodes_with(
    numbers: np.random.Generator | None, file: Path, environment: Any
) -> list[Episode]:
    """The trajectories of a file, with their actions or with others that are valid."""
    kept = load_demonstrations(file, environment)
    episodes, start = [], 0
    for index, length in enumerate(kept.lengths.tolist()):
        states = kept.observations[start + index : start + index + length + 1]
        actions = kept.actions[start : start + length]
        if numbers is not None:
            actions = numbers.integers(environment.action_count, size=length)
        start += length
        rewards = np.ones(length, dtype=np.float32)
        episodes.append(Episode(index, states, actions, rewards, True))
    return episodes


@pytest.fixture(scope="module")
def scrambled(
    demonstration_files: dict[str, Path],
    cartpole: Environment,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Path]:
    """Two files of the same states: one with the expert's actions, and one with random ones."""
    files = []
    for numbers in (None, np.random.default_rng(0)):
        files.append(tmp_path_factory.mktemp("scrambled") / "cartpole.npz")
        save(files[-1], episodes_with(numbers, demonstration_files["cartpole"], cartpole))
    one, other = (load_demonstrations(file, cartpole) for file in files)
    np.testing.assert_array_equal(one.observations, other.observations)
    assert (one.actions != other.actions).mean() > 0.3
    return files[0], files[1]


def policies_of(make: Make, name: str, files: tuple[Path, Path]) -> list[Tensor]:
    found = []
    for file in files:
        method = make(name, "ablation.trajectories=2", f"demonstrations={file}")
        trained(method)
        found.append(method.policy.flat)
    return found


@pytest.mark.parametrize("name", SEES_STATES_ONLY)
def test_other_actions_of_the_expert_change_nothing(make: Make, name: str, scrambled: Any) -> None:
    one, other = policies_of(make, name, scrambled)
    assert torch.equal(one, other)


@pytest.mark.parametrize("name", SEES_ACTIONS)
def test_other_actions_of_the_expert_are_noticed(make: Make, name: str, scrambled: Any) -> None:
    one, other = policies_of(make, name, scrambled)
    assert not torch.equal(one, other)


#: What a method does not own: from a class or a module, all of Python can be reached.
SHARED = (type, types.ModuleType, types.BuiltinFunctionType, types.CodeType, types.FrameType)


def references(thing: Any) -> list[Any]:
    """What an object holds, the owners of its memory too."""
    if isinstance(thing, np.ndarray):
        return [thing.base, *(thing.ravel().tolist() if thing.dtype.hasobject else ())]
    if isinstance(thing, memoryview):
        return [thing.obj]
    if isinstance(thing, Tensor):
        return [thing.grad if thing.is_leaf else None, thing._base, *gc.get_referents(thing)]
    if isinstance(thing, types.FunctionType):  # but not the globals of its module
        return [thing.__closure__, thing.__defaults__, thing.__kwdefaults__, thing.__dict__]
    return gc.get_referents(thing)


def reachable_arrays(start: Any) -> Iterator[np.ndarray]:
    """Every array and tensor that can be reached from an object, and all of a tensor's storage."""
    seen: dict[int, Any] = {}  # kept alive, so that no number is given twice
    left = [start]
    while left:
        thing = left.pop()
        if thing is None or id(thing) in seen or isinstance(thing, SHARED):
            continue
        seen[id(thing)] = thing
        if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
            yield thing
        elif isinstance(thing, Tensor):
            yield thing.detach().numpy()
            yield torch.empty(0, dtype=thing.dtype).set_(thing.untyped_storage()).numpy()
        elif isinstance(thing, bytes | bytearray):
            yield np.frombuffer(thing, dtype=np.uint8)
        elif isinstance(thing, list | tuple) and thing and all(type(v) is int for v in thing):
            yield np.array(thing, dtype=object)
        left += references(thing)


def columns(array: np.ndarray, length: int) -> Iterator[np.ndarray]:
    """(length,) columns along any axis that is as long as asked."""
    for axis, size in enumerate(array.shape):
        if size == length:
            yield from np.moveaxis(array, axis, 0).reshape(length, -1).T


def tells(array: np.ndarray, actions: np.ndarray) -> bool:
    """Whether an array has the actions in it: as they are, one-hot, or amid other numbers."""
    for column in columns(array, len(actions)):
        if any((column == wanted).all() for wanted in (actions, actions == 1, actions == 0)):
            return True
    if array.dtype == object:
        return False
    flat = array.ravel()
    for kind in (flat.dtype, np.dtype(np.int64), np.dtype(np.int32), np.dtype(np.uint8)):
        if actions.astype(kind).tobytes() in flat.tobytes():
            return True
    return False


@pytest.fixture(scope="module")
def holds_actions(make: Make, scrambled: tuple[Path, Path], cartpole: Environment) -> Any:
    """Whether a method, before or after training, has the actions that it was not to see."""
    file = scrambled[1]
    # The actions are random, so that no trained policy or label equals them by learning.
    actions = load_demonstrations(file, cartpole).first(1).actions
    assert len(actions) > 25

    def held(name: str, *, train: bool) -> bool:
        method = make(name, f"demonstrations={file}")
        if train:
            epochs = method.train()
            next(epochs), next(epochs)
        arrays = list(reachable_arrays(method))
        states = load_demonstrations(file, cartpole).first(1).states(cartpole).observations
        assert any(states[:, 0].tobytes() in array.T.tobytes() for array in arrays)
        return any(tells(array, actions) for array in arrays)

    return held


@pytest.mark.parametrize("train", [False, True], ids=["new", "trained"])
@pytest.mark.parametrize("name", SEES_STATES_ONLY)
def test_no_array_with_the_experts_actions_can_be_reached(
    holds_actions: Any, name: str, train: bool
) -> None:
    assert not holds_actions(name, train=train)


@pytest.mark.parametrize("train", [False, True], ids=["new", "trained"])
@pytest.mark.parametrize("name", ["bc", "gail"])  # others may keep them in another form
def test_where_they_are_shown_they_are_found(holds_actions: Any, name: str, train: bool) -> None:
    assert holds_actions(name, train=train)


def remembers(array: np.ndarray, states: np.ndarray) -> bool:
    """Whether an array has any of the states in it, each as it is or with its entries apart."""
    for kind in (np.float32, np.float64):
        kept = array.astype(kind, copy=False) if array.dtype.kind in "fiu" else array
        rows, columns = (np.ascontiguousarray(x).tobytes() for x in (kept, kept.T))
        if any(state.astype(kind).tobytes() in rows for state in states):
            return True
        if any(column.astype(kind).tobytes() in columns for column in states.T):
            return True
    return False


@pytest.fixture(scope="module")
def holds_states(
    make: Make, demonstration_files: dict[str, Path], cartpole: Environment
) -> Callable[[str], bool]:
    """Whether a method has a state of the expert's after some of its training, or all of it."""
    given = load_demonstrations(demonstration_files["cartpole"], cartpole).first(1)
    scaled = given.states(cartpole).observations
    assert len(scaled) > 25

    def held(name: str) -> bool:
        found = False
        method = make(name)
        for progress in method.train():
            if progress.epoch in (1, method.epochs):
                arrays = list(reachable_arrays(method))
                found |= any(
                    remembers(array, states)
                    for array in arrays
                    for states in (scaled, given.observations[: len(scaled)])
                )
        return found

    return held


@pytest.mark.parametrize("name", SEES_NOTHING)
def test_no_state_of_the_experts_can_be_reached(holds_states: Any, name: str) -> None:
    assert not holds_states(name)


@pytest.mark.parametrize("name", ["bc", "ril"])
def test_where_states_are_shown_they_are_found(holds_states: Any, name: str) -> None:
    assert holds_states(name)


@pytest.mark.parametrize("name", SEES_NOTHING)
def test_another_expert_changes_nothing(make: Make, name: str, tmp_path: Path) -> None:
    other = tmp_path / "other.npz"
    states = np.random.default_rng(0).uniform(-0.1, 0.1, size=(31, 4)).astype(np.float32)
    actions, rewards = np.arange(30) % 2, np.ones(30, dtype=np.float32)
    save(other, [Episode(0, states, actions, rewards, True)])
    found, expected = make(name, f"demonstrations={other}"), make(name)
    assert_same_progress(trained(found), trained(expected))
    assert torch.equal(found.policy.flat, expected.policy.flat)


class Hidden:
    """An object that holds an array in one of the ways in which a method might hold it."""

    def __init__(self, array: np.ndarray, way: str) -> None:
        self.kept: Any = {
            "view": array[:1],  # whose base is all of it
            "closure": lambda: array,
            "tensor": torch.from_numpy(array)[2:4],
            "list": {"deep": [(1, array.tolist())]},
            "one-hot": torch.eye(2)[torch.from_numpy(array)],
            "float": array.astype(np.float32)[None].repeat(3, axis=0),
            "longer": np.concatenate((np.arange(7), array, np.arange(7))),
        }[way]


WAYS = ["view", "closure", "tensor", "list", "one-hot", "float", "longer"]


@pytest.mark.parametrize("way", WAYS)
def test_the_search_finds_actions_however_they_are_kept(way: str) -> None:
    actions = np.random.default_rng(0).integers(2, size=40)
    hidden = Hidden(actions.copy(), way)
    assert any(tells(array, actions) for array in reachable_arrays(hidden))
    assert not any(tells(array, 1 - actions[::-1]) for array in reachable_arrays(hidden))
