"""The defaults: what the paper states, what others published, and what methods share."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import pytest
from helpers.configurations import GYM, PAPERS_ENVIRONMENTS, at
from helpers.runs import composed, leaves
from omegaconf import MISSING

from ril.cli.configuration import from_hydra
from ril.config.schema import Config
from ril.methods.registry import names, spec

ALL = PAPERS_ENVIRONMENTS
ENVIRONMENTS = [*((f"env={name}",) for name in ALL), GYM]


@cache
def default(*overrides: str, fidelity: str = "works") -> Config:
    """The configuration of a command line, not to be changed."""
    given = composed(*overrides).copy()
    given.fidelity = fidelity
    return from_hydra(given)


@pytest.mark.quick
@pytest.mark.parametrize("env", ENVIRONMENTS, ids=[*ALL, "gym"])
def test_every_method_composes_in_every_environment(env: tuple[str, ...]) -> None:
    for method in names():
        for fidelity in ("works", "paper"):
            config = default(*env, f"method={method}", fidelity=fidelity)
            assert type(config.method) is spec(method).config
            assert MISSING not in [each for each in leaves(config).values() if each is not None]


#: (method, key, value by environment or for all of them, where the paper has it).
STATED: list[tuple[str, str, Any, str]] = [
    ("ril", "method.epochs", 150, "§4"),
    ("ril", "ablation.k", 2, "§4"),
    ("ril", "ablation.n", 150, "§6.4.1"),
    ("ril", "ablation.trajectories", 1, "§5.2.1"),
    ("ril", "ablation.expert_return", None, "§5.2.1"),
    ("ril", "method.network.hidden", [[8, 8], [32, 32], [32, 32], [128, 128]], "§4.1"),
    ("ril", "method.network.attention", True, "§4.1"),
    ("ril", "method.network.layer_norm", True, "§3.4"),
    ("ril", "method.inverse_dynamics.learning_rate", (5e-4, 5e-5, 5e-3, 5e-4), "§4.1"),
    ("ril", "method.inverse_dynamics.gradient_clip", 1.0, "§4"),
    ("ril", "method.inverse_dynamics.labels", "argmax", "Alg. 1, line 8"),
    ("ril", "method.cloning.learning_rate", (5e-4, 5e-5, 5e-4, 5e-7), "§4.1"),
    ("ril", "method.cloning.gradient_clip", 1.0, "§4"),
    ("ril", "method.q_learning.learning_rate", (5e-4, 5e-4, 5e-4, 5e-6), "§4.1"),
    ("ril", "method.q_learning.gradient_clip", 0.5, "§4"),
    ("ril", "method.q_learning.replay_trajectories", 10, "§3.4"),
    ("ril", "method.exploration.epsilon", None, "§3.4"),
    ("ril", "method.goal_sampler.upper_limit", True, "eq. 2"),
    ("ril", "method.imitation", True, "Alg. 1"),
    ("ril", "method.reinforcement", True, "Alg. 1, line 13"),
    ("ril", "evaluation.episodes", 100, "§4"),
    ("ril", "seeds", list(range(10)), "§5.2.1"),
    ("ril", "env.id", ("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "LunarLander-v3"), "§4.1"),
    ("ril", "env.solved_return", (195, -100, -110, 200), "§4.1"),
    ("ril_sequential", "method.epochs", 100, "§6.2"),
    ("ril_sequential", "method.total_timesteps", 2_000_000, "§6.2"),
    ("dqn", "method.total_timesteps", 2_000_000, "§5.3"),
    ("dqn", "method.dueling", False, "§5.3"),
    ("dqn", "method.q_learning.double", False, "§5.3"),
    ("dqn", "method.q_learning.replay.alpha", 0, "§5.3"),
    ("dqn_prioritized", "method.total_timesteps", 2_000_000, "§5.3"),
    ("dqn_prioritized", "method.dueling", True, "§5.3"),
    ("dqn_prioritized", "method.q_learning.double", True, "§5.3"),
    ("dqn_prioritized", "method.q_learning.replay.alpha", 0.6, "§5.3"),
    ("ppo", "method.total_timesteps", 2_000_000, "§5.3"),
    ("acktr", "method.total_timesteps", 2_000_000, "§5.3"),
    # The paper of RIL states nothing of GAIL and ILPO, but their own authors do.
    ("gail", "method.discriminator.hidden", [100, 100], "Ho & Ermon, §6"),
    ("gail", "method.ppo.hidden", [100, 100], "Ho & Ermon, §6"),
    ("gail", "method.total_timesteps", 2_000_000, "as RL methods' (§5.3)"),
    ("ilpo", "method.latent_policy.encoder", [128, 256], "Edwards et al., code"),
    ("ilpo", "method.latent_policy.generator", 128, "Edwards et al., code"),
    ("ilpo", "method.latent_policy.negative_slope", 0.2, "Edwards et al., code"),
    ("ilpo", "method.latent_policy.learning_rate", 2e-4, "Edwards et al., code"),
    ("ilpo", "method.latent_policy.beta1", 0.5, "Edwards et al., code"),
    ("ilpo", "method.latent_policy.batch_size", 32, "Edwards et al., code"),
    ("ilpo", "method.remapping.hidden", [64, 32], "Edwards et al., code"),
    ("ilpo", "method.remapping.learning_rate", 2e-3, "Edwards et al., code"),
    ("ilpo", "method.remapping.batch_size", 32, "Edwards et al., code"),
    ("ilpo", "method.remapping.steps", 1000, "Edwards et al., code"),
    ("ilpo", "method.remapping.epsilon", 0.2, "Edwards et al., code"),
    ("acktr", "method.hidden", [64, 64], "Stable-Baselines 2"),
    ("acktr", "method.gamma", 0.99, "Stable-Baselines 2"),
    ("acktr", "method.n_envs", (8, 16, 16, 8), "RL Baselines Zoo"),
    ("acktr", "method.n_steps", (20, 20, 20, 128), "RL Baselines Zoo"),
    ("acktr", "method.ent_coef", (0.0, 0.01, 0.01, 0.01), "K4"),
    ("acktr", "method.actor.learning_rate", 0.25, "Stable-Baselines 2"),
    ("acktr", "method.actor.kl_clip", 0.001, "Stable-Baselines 2"),
    ("acktr", "method.actor.momentum", 0.9, "Stable-Baselines 2"),
    ("acktr", "method.actor.damping", 0.01, "Stable-Baselines 2"),
    ("acktr", "method.actor.stats_decay", 0.99, "Stable-Baselines 2"),
]


def of_environment(value: Any, env: str) -> Any:
    """A value, or that of an environment among one for each."""
    by_environment = isinstance(value, tuple) or (
        isinstance(value, list) and len(value) == len(ALL)
    )
    return value[ALL.index(env)] if by_environment else value


@pytest.mark.quick
@pytest.mark.parametrize("env", ALL)
def test_what_is_published_is_the_default(env: str) -> None:
    printed, found = {}, {}
    for method, key, value, where in STATED:
        config = default(f"env={env}", f"method={method}", fidelity="paper")
        printed[method, key, where] = of_environment(value, env)
        found[method, key, where] = at(config, key)
    assert found == printed


@pytest.mark.parametrize("method", names())
def test_fidelity_changes_only_the_rates_that_cannot_work_on_lunarlander(method: str) -> None:
    for env in ALL:
        works, paper = (
            leaves(default(f"env={env}", f"method={method}", fidelity=each))
            for each in ("works", "paper")
        )
        changed = {key: works[key] / paper[key] for key in works if works[key] != paper[key]}
        rates = {"method.cloning.learning_rate", "method.q_learning.learning_rate"}
        assert changed.keys() <= (rates if env == "lunarlander" else set())
        if method in ("ril", "ril_sequential") and env == "lunarlander":
            assert changed == dict.fromkeys(rates, pytest.approx(100))  # (D4)


#: What each method has of its own where it shares a key with RIL (docs/methods/).
NOT_AS_RIL: dict[str, dict[str, Any]] = {
    "bc": {},
    "iupe": {
        "episodes": 10,
        "inverse_dynamics.labels": "sample",
        "exploration.epsilon": 1.0,
        "exploration.kind": "softmax",
        "goal_sampler.upper_limit": False,
    },
    "ril_sequential": {
        "epochs": 100,
        "q_learning.updates": 1,
    },
    "ril_consistent": {
        "exploration.epsilon": 1,
        "exploration.kind": "softmax",
        "inverse_dynamics.standardize": True,
        "inverse_dynamics.learning_rate": 1e-3,
        "inverse_dynamics.updates": 100,
        "cloning.updates": (100, 200, 100, 100),
    },
}
#: On LunarLander, where RIL clones less and the others do not (D4, D8).
CLONES_MORE = {"cloning.updates": 1000, "cloning.learning_rate": 5e-4}


@pytest.mark.parametrize("env", ALL)
@pytest.mark.parametrize("method", NOT_AS_RIL)
def test_what_a_method_shares_with_ril_is_set_as_rils(method: str, env: str) -> None:
    ril = leaves(default(f"env={env}", "method=ril").method)
    found = leaves(default(f"env={env}", f"method={method}").method)
    own = {key: of_environment(value, env) for key, value in NOT_AS_RIL[method].items()}
    if env == "lunarlander" and method in ("bc", "iupe"):
        own |= CLONES_MORE
    if env == "lunarlander" and method == "ril_consistent":
        own["cloning.learning_rate"] = 5e-4
    learners = ("q_learning.",) if method == "ril_consistent" else ()  # another kind of learner
    shared = [key for key in found.keys() & ril.keys() if not key.startswith(learners)]
    assert {key: found[key] for key in shared} == {key: ril[key] for key in shared} | own | {
        "name": method
    }


@pytest.mark.parametrize("env", ALL)
def test_cloning_alone_is_evaluated_as_ril_is(env: str) -> None:
    ril, *others = (default(f"env={env}", f"method={method}") for method in ("ril", "bc", "iupe"))
    expected = ril.evaluation
    if env == "lunarlander":  # (D15)
        expected = dataclasses.replace(expected, every=5, selection_episodes=20)
    assert [each.evaluation for each in others] == [expected, expected]


@pytest.mark.parametrize("env", [("env=lunarlander",), GYM], ids=["lunarlander", "gym"])
def test_a_quick_run_has_smaller_budgets_and_nothing_else(env: tuple[str, ...]) -> None:
    for method in names():
        usual = leaves(default(*env, f"method={method}"))
        quick = leaves(default(*env, f"method={method}", "experiment=quick"))
        budgets = {"method.epochs": 20, "method.total_timesteps": 30_000}
        changed = {key for key in usual if quick[key] != usual[key]}
        assert changed == {
            "seeds",
            "evaluation.episodes",
            "evaluation.selection_episodes",
        } | (budgets.keys() & usual.keys())
        assert {key: quick[key] for key in budgets if key in quick} == {
            key: value for key, value in budgets.items() if key in quick
        }
        assert quick["seeds"] == [0, 1, 2]
        for key in ("evaluation.episodes", "evaluation.selection_episodes"):
            assert quick[key] <= usual[key] / 2


def test_a_quick_run_can_be_made_larger() -> None:
    config = default("method=dqn", "experiment=quick", "method.total_timesteps=77", "seeds=[4]")
    assert (at(config, "method.total_timesteps"), config.seeds) == (77, [4])


def test_an_environment_of_ones_own_is_named_after_its_id_or_as_asked() -> None:
    assert default(*GYM).env.name == "MountainCar-v0"
    assert default(*GYM, "env.name=hill").env.name == "hill"


@pytest.mark.parametrize(
    ("first", "second"), [("env=acrobot", "method=bc"), ("method=dqn", "experiment=quick")]
)
def test_the_order_of_choices_does_not_matter(first: str, second: str) -> None:
    assert composed(first, second) == composed(second, first)
