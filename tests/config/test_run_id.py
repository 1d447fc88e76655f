"""`run_id`: one for all that can change a run's numbers, whatever the rest."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.configurations import of_file, put
from helpers.runs import leaves
from hypothesis import given, settings
from hypothesis import strategies as st

from ril.demonstrations.files import demonstrations_path, load_demonstrations
from ril.methods.registry import names
from ril.run.identity import run_id

REFERENCE = Path(__file__).parents[2] / "outputs" / "reference"
needs_rows = pytest.mark.skipif(
    not REFERENCE.exists(), reason="outputs/reference comes with a clone only"
)
#: Keys that change no number; demonstrations are hashed by content, not by path.
NEVER = {"output_dir", "resume", "demonstrations", "logging", "env.vectorized"}
EQUATION_2 = ("ril", "ril_consistent", "ril_sequential")
SEE_NO_EXPERT = ("acktr", "dqn", "dqn_prioritized", "expert", "ppo", "random")
COMPILED = ("bc", "dqn", "dqn_prioritized", "gail", "iupe", "ppo", *EQUATION_2)


def idle(method: str) -> set[str]:
    """Keys that cannot change a method's numbers."""
    equation_2 = set() if method in EQUATION_2 else {"ablation.k", "ablation.n"}
    expert = {"ablation.trajectories"} if method in SEE_NO_EXPERT else set()
    compiling = set() if method in COMPILED else {"compile"}
    return NEVER | equation_2 | expert | compiling


def another(value: Any) -> Any:
    """A value of the same kind that differs."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, list):
        return [*value, 9]
    if isinstance(value, dict):
        return {**value, "more": 9}
    return value + 1 if isinstance(value, int | float) else f"{value} more"


def identifier(compose: Any, *overrides: str, sha256: str = "0") -> str:
    return run_id(compose(*overrides), sha256)


@pytest.mark.quick
@pytest.mark.parametrize("method", names())
def test_it_depends_on_every_key_that_can_change_a_number_and_on_no_other(
    compose: Any, method: str
) -> None:
    config = compose(f"method={method}")
    usual, found = run_id(config, "0"), set()
    for key, value in leaves(config).items():
        if key == "method.name":  # which decides what the other keys are
            continue
        changed = True if key == "compile" else another(value)
        put(config, key, changed)
        if run_id(config, "0") == usual:
            found.add(key)
        put(config, key, value)
    assert found == idle(method)
    assert run_id(config, "0") == usual


def test_it_differs_between_methods(compose: Any) -> None:
    assert len({identifier(compose, f"method={method}") for method in names()}) == len(names())


def test_it_is_ten_hexadecimal_digits(compose: Any) -> None:
    found = identifier(compose)
    assert len(found) == 10
    int(found, 16)


def test_it_depends_on_the_content_of_the_demonstrations(compose: Any) -> None:
    assert identifier(compose, sha256="1") != identifier(compose, sha256="0")


@pytest.mark.parametrize("method", COMPILED)
def test_it_depends_on_compilation_only_where_that_is_asked_for(compose: Any, method: str) -> None:
    config = compose(f"method={method}")
    assert config.compile == "auto"
    found = []
    for value in ("auto", True, False):
        config.compile = value
        found.append(run_id(config, "0"))
    assert len(set(found)) == 3


@pytest.mark.quick
@pytest.mark.parametrize(
    ("one", "same"),
    [
        ("seeds=3", "seeds=[0,1,2]"),
        ("ablation.k=2", "ablation.k=2.0"),
        ("ablation.n=75", "ablation.n=7.5e1"),
        ("method.q_learning.learning_rate=5e-4", "method.q_learning.learning_rate=0.0005"),
        ("fidelity=works", "fidelity=paper"),  # which changes nothing on MountainCar
    ],
)
def test_it_does_not_depend_on_how_a_value_is_spelled(compose: Any, one: str, same: str) -> None:
    assert identifier(compose, one) == identifier(compose, same)


@settings(max_examples=10)
@given(order=st.permutations(["gravity", "render_mode", "continuous", "wind"]))
def test_it_does_not_depend_on_the_order_of_keys(compose: Any, order: list[str]) -> None:
    config = compose()
    config.env.kwargs = {key: len(key) for key in sorted(order)}
    before = run_id(config, "0")
    config.env.kwargs = {key: len(key) for key in order}
    assert run_id(config, "0") == before


def test_it_leaves_the_configuration_as_it_was(compose: Any) -> None:
    config = compose()
    before = copy.deepcopy(config)
    run_id(config, "0")
    assert config == before


@needs_rows
def test_every_kept_run_has_the_id_of_its_configuration() -> None:
    kept = sorted(REFERENCE.glob("*/*/*/config.yaml"))
    assert len(kept) == len(list(REFERENCE.rglob("results.csv"))) > 100
    for path in kept:
        provenance = json.loads(path.with_name("provenance.json").read_text("utf-8"))
        config = of_file(yaml.load(path.read_text("utf-8"), yaml.CSafeLoader))
        identifier = run_id(config, provenance["demonstrations"]["sha256"])
        assert identifier == provenance["run_id"] == path.parent.name, path


@needs_rows
@pytest.mark.parametrize("method", ["bc", "ril", "ril_consistent"])
@pytest.mark.parametrize("env", ["cartpole", "acrobot", "mountaincar", "lunarlander"])
def test_the_kept_rows_are_of_the_default_configuration(
    compose: Any, environments: Any, env: str, method: str
) -> None:
    # They were made before digits could be the same on every machine.
    config = compose(f"env={env}", f"method={method}", "exact=false")
    demonstrations = load_demonstrations(demonstrations_path(config), environments[env])
    identifier = run_id(config, demonstrations.sha256)
    assert (REFERENCE / env / method / identifier / "results.csv").exists()
