from __future__ import annotations

import dataclasses
import hashlib
import json
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
from helpers.runs import composed
from omegaconf import MISSING, OmegaConf

from ril.cli.configuration import from_hydra
from ril.config.schema import Config
from ril.demonstrations.files import demonstrations_path, load_demonstrations
from ril.io.errors import UserError
from ril.run.identity import run_id

NAMES = ("cartpole", "acrobot", "mountaincar", "lunarlander")
GYM = ("env=gym", "env.id=MountainCar-v0")
REFERENCE = Path(__file__).parents[2] / "outputs" / "reference"


@pytest.mark.parametrize("env", [(f"env={name}",) for name in NAMES] + [GYM])
@pytest.mark.parametrize("fidelity", ["works", "paper"])
def test_every_environment_composes(compose: Any, env: tuple[str, ...], fidelity: str) -> None:
    config = compose(*env, f"fidelity={fidelity}")
    assert all(size > 0 for size in config.method.network.hidden)


@pytest.mark.parametrize("env", [(f"env={name}",) for name in NAMES] + [GYM])
@pytest.mark.parametrize("method", METHOD_CONFIGS)
def test_every_method_composes_in_every_environment(
    compose: Any, env: tuple[str, ...], method: str
) -> None:
    for fidelity in ("works", "paper"):
        config = compose(*env, f"method={method}", f"fidelity={fidelity}")
        assert config.method.name == method
        assert type(config.method) is METHOD_CONFIGS[method]
        assert not [key for key, value in leaves(config.method) if value == MISSING]


# Where IUPE is not RIL's imitation half: docs/iupe.md.
IUPES_OWN = {
    "name": "iupe",
    "episodes": 10,
    "inverse_dynamics.labels": "sample",
    "exploration.epsilon": 1.0,
    "exploration.kind": "softmax",
    "goal_sampler.upper_limit": False,
}


@pytest.mark.parametrize("fidelity", ["works", "paper"])
@pytest.mark.parametrize("env", NAMES)
@pytest.mark.parametrize(("method", "own"), [("bc", {"name": "bc"}), ("iupe", IUPES_OWN)])
def test_what_a_method_shares_with_ril_is_set_as_rils(
    compose: Any, env: str, method: str, own: dict[str, Any], fidelity: str
) -> None:
    usual = compose(f"env={env}", f"fidelity={fidelity}")
    config = compose(f"env={env}", f"method={method}", f"fidelity={fidelity}")
    ril, found = dict(leaves(usual.method)), dict(leaves(config.method))
    looks = usual.evaluation
    if env == "lunarlander":  # there RIL clones less, so as to learn by rewards: D4, D8, D15
        own = own | {"cloning.updates": 1000}
        if fidelity == "works":
            own["cloning.learning_rate"] = 5e-4
        looks = dataclasses.replace(looks, every=5, selection_episodes=20)
    assert found == {key: ril[key] for key in found} | own
    assert config.evaluation == looks


@pytest.mark.parametrize(
    ("key", "published"),
    [
        ("total_timesteps", 2_000_000),
        ("discriminator.hidden", [100, 100]),  # Ho & Ermon, §6
        ("ppo.hidden", [100, 100]),
    ],
)
def test_what_is_stated_of_gail_is_its_default(compose: Any, key: str, published: Any) -> None:
    for env in NAMES:
        assert at(compose(f"env={env}", "method=gail").method, key) == published


@pytest.mark.parametrize(
    ("key", "published"),
    [
        ("latent_policy.encoder", [128, 256]),
        ("latent_policy.generator", 128),
        ("latent_policy.negative_slope", 0.2),
        ("latent_policy.learning_rate", 2e-4),
        ("latent_policy.beta1", 0.5),
        ("latent_policy.batch_size", 32),
        ("remapping.hidden", [64, 32]),
        ("remapping.learning_rate", 2e-3),
        ("remapping.batch_size", 32),
        ("remapping.steps", 1000),
        ("remapping.epsilon", 0.2),
    ],
)
def test_what_ilpos_authors_set_is_its_default(compose: Any, key: str, published: Any) -> None:
    for env in NAMES:
        assert at(compose(f"env={env}", "method=ilpo").method, key) == published


def test_an_environment_of_ones_own_is_named_after_its_id(compose: Any) -> None:
    assert compose(*GYM).env.name == "MountainCar-v0"


def test_an_environment_of_ones_own_can_be_named(compose: Any) -> None:
    assert compose(*GYM, "env.name=hill").env.name == "hill"


def at(config: Any, key: str) -> Any:
    """The value of a dotted key."""
    return reduce(getattr, key.split("."), config)


BUDGETS = ("epochs", "total_timesteps")


@pytest.mark.parametrize("env", [(f"env={name}",) for name in NAMES] + [GYM])
@pytest.mark.parametrize("method", METHOD_CONFIGS)
def test_a_quick_look_is_smaller_whatever_the_method(
    compose: Any, env: tuple[str, ...], method: str
) -> None:
    usual = compose(*env, f"method={method}")
    quick = compose(*env, f"method={method}", "experiment=quick")
    assert len(quick.seeds) < len(usual.seeds)
    for key in ("episodes", "selection_episodes"):
        assert getattr(quick.evaluation, key) <= getattr(usual.evaluation, key) / 2
    for key in BUDGETS:
        if hasattr(usual.method, key):
            assert getattr(quick.method, key) <= getattr(usual.method, key) / 5, key


@pytest.mark.parametrize("method", METHOD_CONFIGS)
def test_a_quick_look_changes_no_more_than_that(compose: Any, method: str) -> None:
    usual = compose("env=cartpole", f"method={method}")
    quick = compose("env=cartpole", f"method={method}", "experiment=quick")
    found = {
        key
        for (key, value), (_, other) in zip(leaves(quick), leaves(usual), strict=True)
        if value != other
    }
    budgets = {f"method.{key}" for key in BUDGETS if hasattr(usual.method, key)}
    assert found == {"seeds", "evaluation.episodes", "evaluation.selection_episodes"} | budgets


def test_a_quick_look_can_be_larger(compose: Any) -> None:
    config = compose("method=dqn", "experiment=quick", "method.total_timesteps=77", "seeds=[4]")
    assert (config.method.total_timesteps, config.seeds) == (77, [4])


@pytest.mark.parametrize("env", NAMES)
def test_consistent_ril_is_set_as_ril_but_for_its_corrections(compose: Any, env: str) -> None:
    ril, found = (
        {
            key: value
            for key, value in leaves(compose(f"env={env}", f"method={method}").method)
            if not key.startswith("q_learning.")
        }
        for method in ("ril", "ril_consistent")
    )
    own = {
        "name": "ril_consistent",
        "exploration.epsilon": 1,
        "exploration.kind": "softmax",
        "inverse_dynamics.standardise": True,
        "inverse_dynamics.learning_rate": 1e-3,
        "inverse_dynamics.updates": 100,
        "cloning.updates": 200 if env == "acrobot" else 100,
    }
    if env == "lunarlander":
        own["cloning.learning_rate"] = 5e-4
    assert found == ril | own


# What the paper says of RIL* (§6.2), and what it has of its own: docs/ril.md.
SEQUENTIALS_OWN = {
    "name": "ril_sequential",
    "epochs": 100,
    "total_timesteps": 2_000_000,
    "q_learning.updates": 1,
    "q_learning.train_freq": 4,
    "q_learning.learning_starts": 100,
    "q_learning.double": False,
    "q_learning.replay.capacity": None,
    "q_learning.replay.alpha": 0.0,
    "q_learning.replay.beta": 0.4,
}


@pytest.mark.parametrize("fidelity", ["works", "paper"])
@pytest.mark.parametrize("env", NAMES)
def test_rils_halves_in_turn_are_set_as_rils(compose: Any, env: str, fidelity: str) -> None:
    ril = dict(leaves(compose(f"env={env}", f"fidelity={fidelity}").method))
    options = (f"env={env}", "method=ril_sequential", f"fidelity={fidelity}")
    found = dict(leaves(compose(*options).method))
    assert found == {key: ril[key] for key in found.keys() & ril.keys()} | SEQUENTIALS_OWN


@pytest.mark.parametrize("env", NAMES)
@pytest.mark.parametrize(
    ("method", "options"),
    [("dqn", (False, False, 0.0)), ("dqn_prioritized", (True, True, 0.6))],
)
def test_dqns_options_are_those_of_its_kind(
    compose: Any, env: str, method: str, options: tuple[Any, ...]
) -> None:
    dqn = compose(f"env={env}", f"method={method}").method
    assert (dqn.dueling, dqn.q_learning.double, dqn.q_learning.replay.alpha) == options
    assert dqn.total_timesteps == 2_000_000  # §5.3


# §4.1: neurons of the two layers, learning rates of M_θ, of π_φ by imitation, and by Q-learning.
TOPOLOGIES = {
    "cartpole": ([8, 8], 5e-4, 5e-4, 5e-4),
    "acrobot": ([32, 32], 5e-5, 5e-5, 5e-4),
    "mountaincar": ([32, 32], 5e-3, 5e-4, 5e-4),
    "lunarlander": ([128, 128], 5e-4, 5e-7, 5e-6),
}


def topology(config: Config) -> tuple[list[int], float, float, float]:
    method: Any = config.method
    rates = (method.inverse_dynamics, method.cloning, method.q_learning)
    return method.network.hidden, *(part.learning_rate for part in rates)


@pytest.mark.parametrize("name", NAMES)
def test_topology_and_learning_rates_are_the_papers(compose: Any, name: str) -> None:
    assert topology(compose(f"env={name}", "fidelity=paper")) == TOPOLOGIES[name]


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "mountaincar"])
def test_what_works_is_the_papers_where_that_works(compose: Any, name: str) -> None:
    assert topology(compose(f"env={name}")) == TOPOLOGIES[name]


def test_where_it_does_not_both_halves_are_a_hundred_times_as_fast(compose: Any) -> None:
    hidden, inverse_dynamics, *policy = TOPOLOGIES["lunarlander"]
    found = topology(compose("env=lunarlander"))
    assert found == (hidden, inverse_dynamics, *(pytest.approx(100 * rate) for rate in policy))


# What the paper says of all environments, and where.
STATED = {
    "method.epochs": 150,  # §4
    "ablation.k": 2,  # §4
    "ablation.n": 150,  # §6.4.1
    "ablation.trajectories": 1,  # §5.2.1
    "ablation.expert_return": None,
    "method.inverse_dynamics.gradient_clip": 1.0,  # §4
    "method.cloning.gradient_clip": 1.0,  # §4
    "method.q_learning.gradient_clip": 0.5,  # §4
    "method.q_learning.replay_trajectories": 10,  # §3.4
    "method.network.attention": True,  # §4.1
    "method.network.layer_norm": True,  # §3.4
    "method.exploration.epsilon": None,  # §3.4: the policy's own exploration ratio
    "method.imitation": True,
    "method.reinforcement": True,
    "evaluation.episodes": 100,  # §4
    "seeds": list(range(10)),  # §5.2.1
}


@pytest.mark.parametrize("fidelity", ["works", "paper"])
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", STATED)
def test_what_the_paper_states_is_the_default(
    compose: Any, key: str, name: str, fidelity: str
) -> None:
    assert at(compose(f"env={name}", f"fidelity={fidelity}"), key) == STATED[key]


@pytest.mark.parametrize(
    ("name", "gym_id", "solved"),
    [
        ("cartpole", "CartPole-v1", 195),
        ("mountaincar", "MountainCar-v0", -110),
        ("lunarlander", "LunarLander-v3", 200),
    ],
)
def test_environments_are_solved_where_the_paper_says(
    compose: Any, name: str, gym_id: str, solved: float
) -> None:
    env = compose(f"env={name}").env
    assert (env.id, env.solved_return) == (gym_id, solved)


@pytest.mark.parametrize(
    ("given", "seeds"), [("1", [0]), ("3", [0, 1, 2]), ("[7]", [7]), ("[5,2]", [5, 2])]
)
def test_seeds_are_a_count_or_a_list(compose: Any, given: str, seeds: list[int]) -> None:
    assert compose(f"seeds={given}").seeds == seeds


def checked(key: str, value: Any, method: str = "ril") -> Config:
    """The usual configuration of a method with one value changed."""
    changed = composed(f"method={method}").copy()
    OmegaConf.update(changed, key, value)
    return from_hydra(changed)


@pytest.mark.parametrize(
    "given", [0, -3, [], [1, 1], [-1], "abc", 1.5, True, [1.0], ["a"], None, [[1]], {"a": 1}]
)
def test_other_seeds_are_refused(given: Any) -> None:
    with pytest.raises(UserError, match=r"^seeds=.*: must be a count of 1 or more, or a list"):
        checked("seeds", given)


POSITIVE = (
    "method.epochs",
    "method.episodes",
    "method.inverse_dynamics.learning_rate",
    "method.inverse_dynamics.updates",
    "method.inverse_dynamics.batch_size",
    "method.inverse_dynamics.gradient_clip",
    "method.cloning.learning_rate",
    "method.cloning.updates",
    "method.cloning.batch_size",
    "method.cloning.gradient_clip",
    "method.q_learning.learning_rate",
    "method.q_learning.updates",
    "method.q_learning.batch_size",
    "method.q_learning.gradient_clip",
    "method.q_learning.replay_trajectories",
    "method.goal_sampler.pre_steps_per_action",
    "method.stopping.patience",
    "ablation.k",
    "ablation.trajectories",
    "evaluation.episodes",
    "evaluation.every",
    "evaluation.selection_episodes",
    "processes",
)


POSITIVE_OF_DQN = (
    "method.total_timesteps",
    "method.exploration.steps",
    "method.q_learning.learning_rate",
    "method.q_learning.updates",
    "method.q_learning.train_freq",
    "method.q_learning.batch_size",
    "method.q_learning.gradient_clip",
    "method.q_learning.replay.capacity",
)


@pytest.mark.parametrize("value", [0, -1])
@pytest.mark.parametrize(
    ("method", "key"),
    [("ril", key) for key in POSITIVE] + [("dqn", key) for key in POSITIVE_OF_DQN],
)
def test_what_must_be_positive_is(method: str, key: str, value: int) -> None:
    with pytest.raises(UserError, match=rf"^{key}={value}(\.0)?: must be .*above 0"):
        checked(key, value, method)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("method.q_learning.discount", 2, "within 0..1"),
        ("method.q_learning.discount", -0.1, "within 0..1"),
        ("method.q_learning.discount", float("nan"), "within 0..1"),
        ("method.exploration.epsilon", 1.5, "within 0..1"),
        ("method.exploration.epsilon", -1, "within 0..1"),
        ("method.q_learning.target_interval", -1, "0 or more"),
        ("method.stopping.loss_tolerance", -0.1, "0 or more"),
        ("method.network.negative_slope", -0.1, "0 or more"),
        ("method.network.hidden", [32, 0], "above 0"),
        ("ablation.n", 0, "1 or more"),
        ("ablation.n", 0.5, "1 or more"),
        ("ablation.n", float("nan"), "1 or more"),
        ("ablation.k", float("nan"), "finite"),
        ("ablation.k", float("inf"), "finite"),
        ("method.q_learning.learning_rate", float("nan"), "finite"),
        ("method.q_learning.replay_trajectories", float("inf"), "finite"),
        ("method.exploration.kind", "foo", "one of softmax, uniform"),
        ("method.inverse_dynamics.inputs", "foo", "one of states, change"),
        ("method.inverse_dynamics.standardise", "states", "one of change, true, false"),
        ("method.inverse_dynamics.standardise", 1, "one of change, true, false"),
        ("method.q_learning.loss", "foo", "one of huber, mse"),
        ("method.goal_sampler.memory", "foo", "one of run, epoch"),
        ("env.name", "../up", "below output_dir"),
        ("env.name", "/up", "below output_dir"),
        ("method.inverse_dynamics.labels", "foo", "one of argmax, sample"),
        ("evaluation.every", "often", "a share of them like 1%"),
        ("evaluation.every", "0%", "a share of them like 1%"),
        ("evaluation.every", "101%", "a share of them like 1%"),
        ("evaluation.every", 2.5, "a share of them like 1%"),
        ("compile", "fast", "must be auto, true or false"),
        ("compile", None, "must be auto, true or false"),
        ("compile", 1, "must be auto, true or false"),
        ("compile", 0, "must be auto, true or false"),
        ("compile", "true ", "must be auto, true or false"),
    ],
)
def test_a_value_out_of_bounds_is_refused_by_name(key: str, value: Any, says: str) -> None:
    with pytest.raises(UserError) as refused:
        checked(key, value)
    assert str(refused.value).startswith(f"{key}=")
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("method.q_learning.discount", 0),
        ("method.q_learning.discount", 1),
        ("method.exploration.epsilon", 0),
        ("method.exploration.epsilon", 1),
        ("method.q_learning.target_interval", 0),
        ("method.q_learning.gradient_clip", None),
        ("method.stopping.patience", None),
        ("method.stopping.loss_tolerance", 0),
        ("method.network.hidden", []),
        ("ablation.n", 1),
        ("ablation.k", 0.5),
    ],
)
def test_a_value_at_its_bounds_is_taken(key: str, value: Any) -> None:
    assert at(checked(key, value), key) == value


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("method.q_learning.learning_starts", -1, "0 or more"),
        ("method.q_learning.target_interval", -1, "0 or more"),
        ("method.q_learning.replay.alpha", -0.1, "0 or more"),
        ("method.q_learning.replay.beta", -0.1, "within 0..1"),
        ("method.q_learning.replay.beta", 1.1, "within 0..1"),
        ("method.exploration.initial_epsilon", -0.1, "within 0..1"),
        ("method.exploration.initial_epsilon", 1.1, "within 0..1"),
        ("method.exploration.final_epsilon", -0.1, "within 0..1"),
        ("method.exploration.final_epsilon", 1.1, "within 0..1"),
        ("method.q_learning.discount", 1.1, "within 0..1"),
        ("method.q_learning.loss", "l1", "one of huber, mse"),
        ("method.network.hidden", [64, 0], "above 0"),
    ],
)
@pytest.mark.parametrize("method", ["dqn", "dqn_prioritized"])
def test_a_value_of_dqn_out_of_bounds_is_refused_by_name(
    method: str, key: str, value: Any, says: str
) -> None:
    with pytest.raises(UserError) as refused:
        checked(key, value, method)
    assert str(refused.value).startswith(f"{key}=")
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("method.q_learning.learning_starts", 0),
        ("method.q_learning.target_interval", 0),
        ("method.q_learning.replay.alpha", 0),
        ("method.q_learning.replay.alpha", 1.5),
        ("method.q_learning.replay.beta", 0),
        ("method.q_learning.replay.beta", 1),
        ("method.exploration.initial_epsilon", 0),
        ("method.exploration.final_epsilon", 1),
        ("compile", True),
        ("compile", False),
        ("compile", "auto"),
    ],
)
def test_a_value_of_dqn_at_its_bounds_is_taken(key: str, value: Any) -> None:
    assert at(checked(key, value, "dqn"), key) == value


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("tau", 2, "within 1e-06..1"),
        ("tau", 0, "within 1e-06..1"),
        ("tau", float("nan"), "within 1e-06..1"),
        ("imitation_weight", -0.1, "0 or more"),
        ("min_confidence", 1.1, "within 0..1"),
        ("min_confidence", -0.1, "within 0..1"),
        ("temperature", 0, "above 0"),
        ("gap", 0, "above 0"),
        ("replay_recent", 0, "above 0"),
        ("n_steps", 0, "above 0"),
        ("value_hidden", [64, 0], "above 0"),
        ("replay_trajectories", 0, "above 0"),
        ("discount", 1.1, "within 0..1"),
        ("loss", "l1", "one of huber, mse"),
    ],
)
def test_a_value_of_consistent_ril_out_of_bounds_is_refused_by_name(
    key: str, value: Any, says: str
) -> None:
    with pytest.raises(UserError) as refused:
        checked(f"method.q_learning.{key}", value, "ril_consistent")
    assert str(refused.value).startswith(f"method.q_learning.{key}=")
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [("tau", 1), ("imitation_weight", 0), ("value_hidden", []), ("discount", 1), ("n_steps", 1)],
)
def test_a_value_of_consistent_ril_at_its_bounds_is_taken(key: str, value: Any) -> None:
    key = f"method.q_learning.{key}"
    assert at(checked(key, value, "ril_consistent"), key) == value


def identifier(compose: Any, *overrides: str, sha256: str = "0") -> str:
    return run_id(compose(*overrides), sha256)


def test_run_id_is_ten_hexadecimal_digits(compose: Any) -> None:
    found = identifier(compose)
    assert len(found) == 10
    int(found, 16)


@pytest.mark.parametrize(
    "override",
    [
        *("output_dir=elsewhere", "resume=false", "demonstrations=copy.npz", "processes=3"),
        *("logging=tensorboard", "env.vectorized=false"),
    ],
)
def test_run_id_does_not_depend_on_what_changes_no_number(compose: Any, override: str) -> None:
    assert identifier(compose, override) == identifier(compose)


@pytest.mark.parametrize(
    ("one", "same"),
    [
        ("seeds=3", "seeds=[0,1,2]"),
        ("ablation.k=2", "ablation.k=2.0"),
        ("method.q_learning.learning_rate=5e-4", "method.q_learning.learning_rate=0.0005"),
    ],
)
def test_run_id_is_one_for_one_meaning(compose: Any, one: str, same: str) -> None:
    assert identifier(compose, one) == identifier(compose, same)


def leaves(node: Any, key: str = "") -> list[tuple[str, Any]]:
    """All values of a configuration, with their keys."""
    if dataclasses.is_dataclass(node):
        node = {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    if isinstance(node, dict):
        return [leaf for name in node for leaf in leaves(node[name], f"{key}.{name}".strip("."))]
    return [(key, node)]


@pytest.mark.parametrize("method", ["ril", "ril_consistent"])
def test_run_id_depends_on_every_other_key(compose: Any, method: str) -> None:
    plain = identifier(compose, f"method={method}")
    for key, value in leaves(compose(f"method={method}")):
        free = ("compile", "output_dir", "resume", "demonstrations", "processes", "logging")
        if key in (*free, "env.vectorized"):
            continue
        config = compose(f"method={method}")
        parent, _, name = key.rpartition(".")
        node = at(config, parent) if parent else config
        setattr(node, name, [9] if isinstance(value, list) else f"other than {value}")
        assert run_id(config, "0") != plain, key


@pytest.mark.parametrize("override", ["ablation.k=3", "ablation.n=75"])
@pytest.mark.parametrize("method", METHOD_CONFIGS)
def test_run_id_depends_on_equation_2_where_it_is_used(
    compose: Any, method: str, override: str
) -> None:
    plain, changed = (identifier(compose, f"method={method}", *o) for o in ((), (override,)))
    assert (changed != plain) is (method in ("ril", "ril_consistent", "ril_sequential"))


def test_run_id_is_as_if_there_were_no_compilation_where_none_is_asked_for(compose: Any) -> None:
    config = compose("method=dqn", "compile=auto")
    found = run_id(config, "0")
    content = dataclasses.asdict(config) | {"demonstrations": "0"}
    for key in ("output_dir", "resume", "compile", "processes", "logging"):
        del content[key]
    del content["env"]["vectorized"]
    content["ablation"] = {"expert_return": None}
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    assert found == digest[:10]


def test_run_id_depends_on_compilation_where_it_is_asked_for(compose: Any) -> None:
    found = {identifier(compose, "method=dqn", f"compile={c}") for c in ("auto", "true", "false")}
    assert len(found) == 3


def test_run_id_depends_on_the_demonstrations_content(compose: Any) -> None:
    assert identifier(compose, sha256="1") != identifier(compose, sha256="0")


@pytest.mark.parametrize(
    ("every", "epochs", "between"),
    [
        (5, 1000, 5),
        ("1%", 1000, 10),
        ("1%", 150, 1),
        ("1%", 199, 1),
        ("1%", 20, 1),
        ("1%", 7813, 78),
        ("0.5%", 1000, 5),
        ("100%", 30, 30),
    ],
)
def test_looks_are_every_so_many_epochs_or_a_share_of_them(
    every: Any, epochs: int, between: int
) -> None:
    assert epochs_between_looks(every, epochs) == between


@pytest.mark.skipif(not REFERENCE.exists(), reason="rows come with a clone, not with an sdist")
@pytest.mark.parametrize("method", ["bc", "ril", "ril_consistent"])
@pytest.mark.parametrize("env", NAMES)
def test_the_rows_that_are_kept_are_of_the_method_as_it_comes(
    compose: Any, environments: Any, env: str, method: str
) -> None:
    config = compose(f"env={env}", f"method={method}")
    demonstrations = load_demonstrations(demonstrations_path(config), environments[env])
    identifier = run_id(config, demonstrations.sha256)
    assert (REFERENCE / env / method / identifier / "results.csv").exists()


def test_run_id_does_not_depend_on_how_a_value_was_chosen(compose: Any) -> None:
    assert identifier(compose, "env=cartpole", "fidelity=paper") == identifier(
        compose, "env=cartpole", "fidelity=works"
    )


def test_run_id_does_not_depend_on_compilation_where_nothing_is_compiled(compose: Any) -> None:
    for method in ("ppo", "acktr"):
        usual = identifier(compose, f"method={method}")
        assert identifier(compose, f"method={method}", "compile=true") == usual


@pytest.mark.parametrize("method", ["ril", "ril_consistent", "iupe", "bc"])
def test_run_id_of_imitation_depends_on_compilation_that_is_asked_for(
    compose: Any, method: str
) -> None:
    found = {identifier(compose, f"method={method}", f"compile={c}") for c in ("auto", True, False)}
    assert len(found) == 3
