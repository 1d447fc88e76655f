"""Ours beside Stable-Baselines3's `learn`, which is given our actions and our minibatches."""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from ril.config.schema import AblationConfig, Config
from ril.demonstrations.trajectories import StateTransitions
from ril.environments.environment import Environment, load_environment
from ril.io.errors import UserError
from ril.learners.normalization import Standardization
from ril.learners.ppo import PPOConfig, PPOLearner
from ril.learners.ppo_rollout import Rollout
from ril.task import Task
from ril.vectorized.stepping import SteppedEnvironments

CPU = torch.device("cpu")
SEEDS = (3, 7)
needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "clang++", "c++")), reason="no C++ compiler"
)


def config(**changes: object) -> PPOConfig:
    values = {
        "hidden": [16, 12],
        "n_envs": 2,
        "n_steps": 32,
        "batch_size": 16,
        "n_epochs": 2,
        "learning_rate": 3e-3,
        "gamma": 0.97,
        "gae_lambda": 0.9,
        "clip_range": 0.15,
        "ent_coef": 0.01,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
    }
    return PPOConfig(**(values | changes))


def learner(
    environment: Environment,
    settings: PPOConfig,
    seeds: tuple[int, ...] = SEEDS,
    total: int = 10_000,
    *,
    compiled: bool = False,
    **options: Any,
) -> PPOLearner:
    nothing = StateTransitions.none(environment)
    task = Task(environment, nothing, seeds, AblationConfig(), CPU, compiled)
    return PPOLearner(settings, task, total, **options)


class Plain(VecEnv):
    """The episodes of one seed, as Stable-Baselines3 has them from its own environments."""

    def __init__(self, environment: Environment, seed: int, copies: int) -> None:
        self.stepped = SteppedEnvironments(environment, [seed], copies, "ppo")
        space = gym.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
        super().__init__(copies, space, gym.spaces.Discrete(environment.action_count))

    def reset(self) -> np.ndarray:
        return self.stepped.observations.copy()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        step = self.stepped.step(self.actions)
        infos: list[dict[str, Any]] = []
        for index, final in enumerate(step.next_observations):
            over = bool(step.terminated[index] or step.truncated[index])
            info = {"terminal_observation": final.copy()} if over else {}
            infos.append({"TimeLimit.truncated": bool(step.truncated[index]), **info})
        observations, dones = self.stepped.observations.copy(), step.terminated | step.truncated
        return observations, step.rewards.copy(), dones, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> list[Any]:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def linears(model: PPO) -> list[nn.Linear]:
    """The layers of actor and critic, in the order of ours."""
    policy = model.policy
    modules = (
        *policy.mlp_extractor.policy_net,
        policy.action_net,
        *policy.mlp_extractor.value_net,
        policy.value_net,
    )
    return [module for module in modules if isinstance(module, nn.Linear)]


def parameters(model: PPO) -> Tensor:
    """(P,) as a row of ours."""
    layers = [(m.weight.T, m.bias) for m in linears(model)]
    return torch.cat([p.detach().reshape(-1) for layer in layers for p in layer])


def fill(model: PPO, flat: Tensor) -> None:
    """Give a model the parameters (P,) of one of our seeds."""
    for layer in linears(model):
        for parameter in (layer.weight.T, layer.bias):
            values, flat = flat[: parameter.numel()], flat[parameter.numel() :]
            parameter.data.copy_(values.view(parameter.shape))
    assert not len(flat)


FIELDS = ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns")
MEASURED = {"entropy": "entropy_loss", "value_loss": "value_loss", "approximate_kl": "approx_kl"}


class Recorder(BaseCallback):
    """Keeps what each rollout and its updates gave."""

    def __init__(self) -> None:
        super().__init__()
        self.rollouts: list[dict[str, np.ndarray]] = []
        self.parameters: list[Tensor] = []
        self.measured: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.updated()

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer
        self.rollouts.append({name: getattr(buffer, name).copy() for name in FIELDS})

    def _on_training_end(self) -> None:
        self.updated()

    def updated(self) -> None:
        if self.rollouts:
            self.parameters.append(parameters(self.model))
            logged = self.model.logger.name_to_value
            self.measured.append({name: logged[f"train/{n}"] for name, n in MEASURED.items()})


@dataclass
class Followed:
    """Rollouts of ours, and of one seed trained by Stable-Baselines3 from the same draws."""

    learner: PPOLearner
    model: PPO
    rollouts: list[Rollout]
    samples: list[Tensor]
    parameters: list[Tensor]
    measured: list[dict[str, np.ndarray]]
    theirs: Recorder

    def by_step(self, array: Any, seed: int = 1) -> np.ndarray:
        """The seed's part of (T, S·K, …)."""
        return np.split(array, len(SEEDS), axis=1)[seed]


def follow(
    environment: Environment,
    settings: PPOConfig,
    rollouts: int,
    monkeypatch: pytest.MonkeyPatch,
    *,
    normalize: bool,
    schedule: bool,
) -> Followed:
    """Train two seeds by ours; then the second one by Stable-Baselines3 from the same draws."""
    steps = settings.n_envs * settings.n_steps
    options = {"normalize": normalize, "linear_schedule": schedule}
    ours = learner(environment, settings, SEEDS, rollouts * steps, **options)
    initial, played, samples, after, measured = ours.networks.flat[1].clone(), [], [], [], []
    permutations: deque[np.ndarray] = deque()
    actions: deque[np.ndarray] = deque()
    draw = ours._shuffling.permutations

    def drawn(count: int, size: int) -> np.ndarray:
        found = draw(count, size)
        step, copy = np.divmod(found[1], settings.n_envs)
        # In Stable-Baselines3's buffer, a copy's steps lie side by side.
        permutations.extend(copy * settings.n_steps + step)
        return found

    monkeypatch.setattr(ours._shuffling, "permutations", drawn)
    for _ in range(rollouts):
        ours.collect()
        assert ours._rollout is not None
        played.append(ours._rollout)
        actions.extend(np.split(ours._rollout.actions, len(SEEDS), axis=1)[1])
        samples.append(ours._samples(ours._rollout).unflatten(0, (len(SEEDS), -1))[1])
        measured.append(ours.improve())
        after.append(ours.networks.flat[1].clone())

    environments: VecEnv = Plain(environment, SEEDS[1], settings.n_envs)
    if normalize:
        environments = VecNormalize(environments, gamma=settings.gamma)
    given = vars(settings).copy()
    hidden = given.pop("hidden")
    del given["n_envs"]
    if schedule:
        for name in ("learning_rate", "clip_range"):
            given[name] = lambda remaining, value=given[name]: remaining * value
    model = PPO(
        "MlpPolicy", environments, policy_kwargs={"net_arch": list(hidden)}, device="cpu", **given
    )
    fill(model, initial)
    evaluate = model.policy.evaluate_actions

    def act(observations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        chosen = torch.from_numpy(actions.popleft())
        values, log_prob, _ = evaluate(observations, chosen)
        return chosen, values, log_prob

    monkeypatch.setattr(model.policy, "forward", act)
    recorder = Recorder()
    with monkeypatch.context() as patched:
        patched.setattr(np.random, "permutation", lambda _: permutations.popleft())
        model.learn(rollouts * steps, recorder)
    assert not actions
    assert not permutations
    return Followed(ours, model, played, samples, after, measured, recorder)


#: Rollouts of each setting, and their steps where a test needs fewer than `conf/` has. Episodes
#: are truncated in those of Acrobot and MountainCar.
SETTINGS: dict[tuple[str, ...], tuple[int, dict[str, int]]] = {
    ("env=cartpole", "method=ppo"): (4, {}),
    ("env=acrobot", "method=ppo"): (3, {"n_envs": 4}),
    ("env=mountaincar", "method=ppo"): (14, {}),
    ("env=lunarlander", "method=ppo"): (2, {"n_steps": 128}),
    ("env=gym", "env.id=MountainCar-v0", "method=ppo"): (1, {}),
    ("env=mountaincar", "method=gail"): (2, {}),
    ("env=lunarlander", "method=gail"): (2, {"n_steps": 128}),
}


@pytest.fixture(scope="module", params=SETTINGS, ids=" ".join)
def followed(request: pytest.FixtureRequest, compose: Callable[..., Config]) -> Any:
    found = compose(*request.param)
    rollouts, changes = SETTINGS[request.param]
    method: Any = found.method
    given = vars(method.ppo).copy()
    options = {
        "normalize": given.pop("normalize", False),
        "schedule": given.pop("linear_schedule", False),
    }
    with pytest.MonkeyPatch.context() as patched:
        settings = PPOConfig(**(given | changes))
        yield follow(load_environment(found.env), settings, rollouts, patched, **options)


def test_rollouts_are_what_sb3_collects(followed: Followed) -> None:
    for ours, theirs in zip(followed.rollouts, followed.theirs.rollouts, strict=True):
        seen = followed.by_step(ours.observations)
        np.testing.assert_allclose(seen, theirs["observations"], rtol=1e-4, atol=1e-4)
        rewards = followed.by_step(ours.rewards)
        truncated = followed.by_step(ours.truncated)
        np.testing.assert_allclose(rewards[~truncated], theirs["rewards"][~truncated], rtol=1e-5)


def test_advantages_and_returns_are_those_of_sb3s_buffer(followed: Followed) -> None:
    size, copies = followed.learner._size, followed.learner.config.n_envs
    for ours, theirs in zip(followed.samples, followed.theirs.rollouts, strict=True):
        log_prob, advantage, returns = ours[:, -3:].unflatten(0, (-1, copies)).numpy().T
        for found, name in ((log_prob, "log_probs"), (advantage, "advantages")):
            np.testing.assert_allclose(found.T, theirs[name], rtol=1e-3, atol=1e-3, err_msg=name)
        np.testing.assert_allclose(returns.T, theirs["returns"], rtol=1e-3, atol=1e-3)
        taken = ours[:, size:-3].argmax(dim=1).unflatten(0, (-1, copies))
        np.testing.assert_array_equal(taken, theirs["actions"][..., 0])


def test_updates_are_sb3s_train(followed: Followed) -> None:
    for ours, theirs in zip(followed.parameters, followed.theirs.parameters, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_diagnostics_are_what_sb3_logs(followed: Followed) -> None:
    for ours, theirs in zip(followed.measured, followed.theirs.measured, strict=True):
        signed = {**theirs, "entropy": -theirs["entropy"]}
        for name, values in ours.items():
            assert values[1] == pytest.approx(signed[name], rel=1e-3, abs=1e-5), name


def test_moments_are_sb3s(followed: Followed) -> None:
    theirs, ours = followed.model.get_vec_normalize_env(), followed.learner._normalization
    assert (theirs is None) == (ours is None)
    if theirs is None or ours is None:
        return
    for found, expected in ((ours.seen, theirs.obs_rms), (ours.earned, theirs.ret_rms)):
        np.testing.assert_allclose(found.mean[1], expected.mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found.variance[1], expected.var, rtol=1e-5)
        assert found.count == expected.count
    np.testing.assert_allclose(ours._returns[1], theirs.returns, rtol=1e-5)


def test_the_policy_acts_as_sb3s(followed: Followed) -> None:
    """For observations that are not normalized, far ones too."""
    size = followed.learner._size
    x = np.random.default_rng(0).normal(scale=3, size=(2, 200, size)).astype(np.float32)
    normalizer = followed.model.get_vec_normalize_env()
    seen = x[1] if normalizer is None else normalizer.normalize_obs(x[1])
    with torch.no_grad():
        given = torch.from_numpy(seen)
        expected = followed.model.policy.get_distribution(given).distribution.logits
    found = followed.learner.policy.infer(x.reshape(-1, size))[1].log_softmax(dim=-1)
    torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-2)


def rounds(trained: PPOLearner, count: int) -> PPOLearner:
    for _ in range(count):
        trained.collect()
        trained.improve()
    return trained


def test_a_rate_that_has_fallen_to_0_stays_there(cartpole: Environment) -> None:
    trained = rounds(learner(cartpole, config(), total=100, linear_schedule=True), 1)
    before = trained.networks.flat.clone()
    assert trained.rollouts == 2  # of 64 steps
    rounds(trained, 2)
    assert torch.equal(trained.networks.flat, before)
    assert not torch.equal(before, learner(cartpole, config()).networks.flat)


def test_only_a_truncated_episode_is_worth_more_than_its_rewards(mountaincar: Environment) -> None:
    one = learner(mountaincar, config(n_steps=220, batch_size=20, gae_lambda=0.0, gamma=1.0))
    one.collect()
    assert one._rollout is not None
    assert one._rollout.truncated.any(axis=1).tolist() == [step == 199 for step in range(220)]
    values, following = one._rollout.values, one._rollout.next_values
    assert (following[:199] == values[1:200]).all()
    assert (following[200:-1] == values[201:]).all()
    assert (following[199] != values[200]).all()  # of the next episode's first state
    rollout = one._rollout._replace(rewards=np.zeros_like(one._rollout.rewards))
    returns = one._samples(rollout).unflatten(0, (len(SEEDS), 220, 2))[..., -1]
    np.testing.assert_allclose(returns.transpose(0, 1).flatten(1), following, atol=1e-6)


def test_a_failure_is_worth_its_reward_alone(cartpole: Environment) -> None:
    one = learner(cartpole, config())
    one.collect()
    assert one._rollout is not None
    ended = torch.from_numpy(one._rollout.terminated)
    assert ended.any()
    rollout = one._rollout._replace(rewards=np.full_like(one._rollout.rewards, 7))
    returns = one._samples(rollout).unflatten(0, (len(SEEDS), 32, 2))[..., -1]
    assert (returns.transpose(0, 1).flatten(1)[ended] - 7).abs().max() < 1e-5


def test_rewards_belong_to_the_pairs_of_their_place(cartpole: Environment) -> None:
    """Given rewards, which are the environments' own in another order, replace them."""
    one, other = (learner(cartpole, config()) for _ in range(2))
    observations, actions = one.collect()
    assert (observations.shape, actions.shape) == ((2, 64, 4), (2, 64))
    other.collect()
    assert one._rollout is not None
    assert other._rollout is not None
    given = torch.randn(2, 64, generator=torch.Generator().manual_seed(0))
    by_step = given.view(2, 32, 2).transpose(0, 1).flatten(1).numpy()
    one._rollout.rewards[:] = by_step
    other._rollout.rewards[:] = 1000.0
    one.improve()
    other.improve(given)
    assert torch.equal(one.networks.flat, other.networks.flat)


def test_what_is_collected_begins_where_the_last_rollout_ended(cartpole: Environment) -> None:
    one = learner(cartpole, config())
    stepped = SteppedEnvironments(cartpole, SEEDS, 2, "ppo")
    for _ in range(3):
        observations, actions = one.collect()
        for step in range(32):
            now = slice(2 * step, 2 * step + 2)
            np.testing.assert_array_equal(observations[:, now].flatten(0, 1), stepped.observations)
            stepped.step(actions[:, now].flatten().numpy())
        one.improve()


def test_standardized_observations_are_what_the_agents_and_the_saved_policy_see(
    mountaincar: Environment,
) -> None:
    states = SteppedEnvironments(mountaincar, SEEDS, 2, "other").observations
    standardize = Standardization(states)
    one = learner(mountaincar, config(n_steps=210, batch_size=20), standardize=standardize)
    stepped = SteppedEnvironments(mountaincar, SEEDS, 2, "ppo")
    for _ in range(2):
        observations, actions = one.collect()
        for step in range(210):
            now = slice(2 * step, 2 * step + 2)
            expected = standardize(stepped.observations)
            np.testing.assert_array_equal(observations[:, now].flatten(0, 1), expected)
            stepped.step(actions[:, now].flatten().numpy())
        one.improve()
    x = torch.from_numpy(stepped.observations).view(2, 2, -1)
    seen = torch.from_numpy(standardize(stepped.observations)).view(2, 2, -1)
    actors = one.networks.architecture.forward(one.networks.parameters, seen)
    torch.testing.assert_close(one.policy(x), actors, rtol=1e-4, atol=1e-5)


def test_actions_follow_the_policy(cartpole: Environment) -> None:
    one = learner(cartpole, config(n_steps=2000))
    with torch.no_grad():
        one.networks.parameters["output.actor.bias"][:, 0, 0] = 1.0  # 0.73 for action 0
    _, actions = one.collect()
    assert (actions == 0).double().mean(dim=1).numpy() == pytest.approx([0.731] * 2, abs=0.03)


@pytest.mark.parametrize("options", [{}, {"normalize": True, "linear_schedule": True}], ids=str)
@pytest.mark.parametrize("name", ["cartpole", "mountaincar"])
def test_a_loaded_state_resumes_bit_identically(
    environments: dict[str, Environment], name: str, options: dict[str, bool]
) -> None:
    settings = config(n_steps=120)  # so that it stops in the middle of an episode
    one, resumed = (learner(environments[name], settings, **options) for _ in range(2))
    rounds(one, 2)
    resumed.load_state_dict(copied(one.state_dict()))
    assert torch.equal(resumed.policy.flat, one.policy.flat)
    assert_equal_states(rounds(resumed, 2).state_dict(), rounds(one, 2).state_dict())


#: Sizes as in conf/, since which kernel multiplies depends on them; and the smallest.
SIZES = {
    "cartpole": {"hidden": [64, 64], "n_envs": 8, "n_steps": 32, "batch_size": 256},
    "acrobot": {"hidden": [64, 64], "n_envs": 8, "n_steps": 32, "batch_size": 64},
    "mountaincar": {"hidden": [5], "n_envs": 1, "n_steps": 32, "batch_size": 16},
}


def trained(environment: Environment, seeds: tuple[int, ...], *, compiled: bool) -> PPOLearner:
    name = environment.config.name
    settings = config(**SIZES[name], max_grad_norm=0.3)
    one = learner(environment, settings, seeds, compiled=compiled, normalize=name == "acrobot")
    return rounds(one, 3)


@pytest.fixture(scope="module", params=SIZES)
def among(
    request: pytest.FixtureRequest, environments: dict[str, Environment]
) -> tuple[Environment, PPOLearner]:
    """An environment, and three seeds trained in it by compiled updates."""
    environment = environments[request.param]
    return environment, trained(environment, (3, 5, 9), compiled=True)


@needs_compiler
def test_compiled_training_is_the_eager_one_but_for_rounding(
    among: tuple[Environment, PPOLearner],
) -> None:
    environment, found = among
    expected = trained(environment, (3, 5, 9), compiled=False)
    torch.testing.assert_close(found.networks.flat, expected.networks.flat, rtol=1e-3, atol=1e-4)
    assert not torch.equal(found.networks.flat, expected.networks.flat)  # so it was compiled


@needs_compiler
def test_a_seeds_compiled_training_does_not_depend_on_other_seeds(
    among: tuple[Environment, PPOLearner],
) -> None:
    environment, found = among
    alone = trained(environment, (5,), compiled=True)
    assert torch.equal(alone.networks.flat[0], found.networks.flat[1])
    assert torch.equal(alone.policy.flat[0], found.policy.flat[1])


def test_minibatches_are_permutations_of_each_seeds_samples(cartpole: Environment) -> None:
    one = learner(cartpole, config())
    minibatches = one._minibatches()
    assert minibatches.shape == (8, 2, 16)
    epochs = minibatches.unflatten(0, (2, 4)).transpose(1, 2).flatten(2)  # (epoch, seed, sample)
    for epoch in epochs:
        for seed, rows in enumerate(epoch):
            assert rows.sort().values.tolist() == list(range(64 * seed, 64 * seed + 64))
    assert len({tuple((rows % 64).tolist()) for rows in epochs.flatten(0, 1)}) == 4


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"batch_size": 1}, "batch_size=1: must be above 1"),
        ({"batch_size": 48}, "batch_size=48: must be above 1 and divide a rollout"),
        ({"batch_size": 128}, "batch_size=128: must be above 1 and divide a rollout"),
    ],
)
def test_minibatches_that_do_not_fit_a_rollout_are_refused(
    cartpole: Environment, changes: dict[str, int], says: str
) -> None:
    with pytest.raises(UserError, match=rf"^method\.ppo\.{says}"):
        learner(cartpole, config(**changes))


def test_a_budget_below_one_rollout_is_refused(cartpole: Environment) -> None:
    assert learner(cartpole, config(), total=64).rollouts == 1
    assert learner(cartpole, config(), total=65).rollouts == 2
    with pytest.raises(UserError, match=r"^method\.total_timesteps=63: must be at least .* = 64$"):
        learner(cartpole, config(), total=63)
