"""Every value of every method is checked, against bounds that are stated here once more."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from helpers.configurations import checked, parts, put
from helpers.runs import composed, leaves
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from omegaconf.errors import OmegaConfBaseException

from ril.cli.configuration import from_hydra
from ril.config.fields import check
from ril.config.schema import Config, EvaluationConfig
from ril.io.errors import UserError
from ril.methods.registry import names, spec

pytestmark = pytest.mark.quick
METHODS = names()
#: An example of a method is a value for each of its keys.
each_with_all_keys = settings(max_examples=min(5, settings.default.max_examples))


class Bounds(NamedTuple):
    """What a quantity may be, whatever its dataclass declares."""

    low: float
    high: float
    with_low: bool = True
    with_high: bool = True

    def allows(self, value: float) -> bool:
        above = self.low <= value if self.with_low else self.low < value
        below = value <= self.high if self.with_high else value < self.high
        return above and below and math.isfinite(value)


POSITIVE = Bounds(0, math.inf, with_low=False)
PROBABILITY = Bounds(0, 1)
NOT_NEGATIVE = Bounds(0, math.inf)
ANY = Bounds(-math.inf, math.inf)
#: The share of a running mean that stays: at 1 it would never change.
DECAY = Bounds(0, 1, with_high=False)
#: Bounds by the last part of the key. All other keys are rates, sizes and counts, hence above 0.
BOUNDS = {
    **dict.fromkeys(("discount", "gamma", "gae_lambda"), PROBABILITY),
    **dict.fromkeys(("epsilon", "initial_epsilon", "final_epsilon"), PROBABILITY),
    **dict.fromkeys(("min_confidence", "beta"), PROBABILITY),
    **dict.fromkeys(("momentum", "stats_decay", "beta1"), DECAY),
    "tau": Bounds(0, 1, with_low=False),
    "n": Bounds(1, math.inf),
    **dict.fromkeys(("alpha", "ent_coef", "vf_coef", "imitation_weight"), NOT_NEGATIVE),
    **dict.fromkeys(("loss_tolerance", "negative_slope"), NOT_NEGATIVE),
    **dict.fromkeys(("target_interval", "learning_starts", "standardize_steps"), NOT_NEGATIVE),
    **dict.fromkeys(("minimum_return", "minimum_final_reward", "solved_return"), ANY),
    **dict.fromkeys(("expert_return", "observation_low", "observation_high"), ANY),
}
CHOICES: dict[str, tuple[Any, ...]] = {
    "kind": ("softmax", "uniform"),
    "inputs": ("states", "change"),
    "standardize": ("change", True, False),
    "labels": ("argmax", "sample"),
    "memory": ("run", "epoch", "none"),
    "loss": ("huber", "mse"),
    "reward": ("positive", "negative", "logit"),
    "changes": ("raw", "scaled", "standardized"),
    "compile": ("auto", True, False),
}
#: Keys whose values are checked elsewhere.
ELSEWHERE = {"seeds", "evaluation.every", "logging", "env.kwargs"}


def numbers_of(config: Config) -> dict[str, tuple[Bounds, bool, bool]]:
    """Keys of numbers: their bounds, and whether they are integers and in a list."""
    found = {}
    for prefix, part in parts(config):
        hints = typing.get_type_hints(type(part))
        for field in dataclasses.fields(part):
            key = f"{prefix}.{field.name}" if prefix else field.name
            kind = str(hints[field.name])
            if key not in ELSEWHERE and re.search(r"\b(int|float)\b", kind):
                whole = "float" not in kind
                found[key] = BOUNDS.get(field.name, POSITIVE), whole, "list" in kind
    return found


def inside(bounds: Bounds, *, whole: bool) -> st.SearchStrategy[float]:
    """Numbers that the bounds allow, the bounds themselves among them."""
    low, high = max(bounds.low, -1e9), min(bounds.high, 1e9)
    numbers: st.SearchStrategy[float]
    if whole:
        numbers = st.integers(math.ceil(low), math.floor(high))
    else:
        # Leave out subnormal numbers and numbers next to an open end, which nobody uses.
        step = 1e-4 * (min(high, 1) - max(low, 0))
        numbers = st.floats(
            low if bounds.with_low else low + step, high if bounds.with_high else high - step
        )
    edges = [each for each in (low, high) if bounds.allows(each) and abs(each) < 1e9]
    return st.one_of(numbers.filter(bounds.allows), *(st.just(each) for each in edges))


def outside(bounds: Bounds, *, whole: bool) -> st.SearchStrategy[float]:
    """Numbers that the bounds do not allow, including infinities and NaN."""
    edges = [each for each in (bounds.low, bounds.high) if math.isfinite(each)]
    refused = [st.just(each) for each in edges if not bounds.allows(each)]
    if math.isfinite(bounds.low):
        refused.append(st.integers(max_value=math.ceil(bounds.low) - 1))
    if math.isfinite(bounds.high):
        refused.append(st.integers(min_value=math.floor(bounds.high) + 1))
    if not whole:
        refused += [st.just(math.inf), st.just(-math.inf), st.just(math.nan)]
        if math.isfinite(bounds.low):
            refused.append(st.floats(max_value=bounds.low, exclude_max=bounds.with_low))
    return st.one_of(*refused)


def refusal(work: Callable[[], object]) -> str:
    with pytest.raises(UserError) as refused:
        work()
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.fixture(scope="module")
def default(compose: Any) -> Callable[[str], Config]:
    return lambda method: compose(f"method={method}")


@pytest.mark.parametrize("method", METHODS)
@each_with_all_keys
@given(data=st.data())
def test_numbers_inside_their_bounds_are_accepted(default: Any, method: str, data: Any) -> None:
    config = default(method)
    for key, (bounds, whole, listed) in numbers_of(config).items():
        value = data.draw(inside(bounds, whole=whole), label=key)
        put(config, key, [value, value] if listed else value)
    check(config)


@pytest.mark.parametrize("method", METHODS)
@each_with_all_keys
@given(data=st.data())
def test_a_number_outside_its_bounds_is_refused_by_name(
    default: Any, method: str, data: Any
) -> None:
    config = default(method)
    for key, (bounds, whole, listed) in numbers_of(config).items():
        value = data.draw(outside(bounds, whole=whole), label=key)
        before = put(config, key, [1, value] if listed else value)
        said = refusal(lambda: check(config))
        assert said.startswith(f"{key}={value}: must be "), said
        put(config, key, before)


@pytest.mark.parametrize("method", METHODS)
def test_what_has_choices_accepts_them_and_nothing_else(default: Any, method: str) -> None:
    config = default(method)
    choices = {key: CHOICES.get(key.rpartition(".")[2]) for key in leaves(config)}
    for key, allowed in choices.items():
        if allowed is None:
            continue
        # 1 and 0 equal True and False in Python.
        for value in ("other", f"{allowed[0]} ", None, 1, 0):
            put(config, key, value)
            said = refusal(lambda: check(config))
            written = ", ".join(str(each).lower() for each in allowed)
            assert said == f"{key}={value}: must be one of {written}"
        for value in allowed:
            put(config, key, value)
            check(config)


def test_every_declared_choice_is_stated_here() -> None:
    declared = {
        field.name: set(field.metadata["choices"])
        for method in METHODS
        for _, part in parts(spec(method).config())
        for field in dataclasses.fields(part)
        if "choices" in field.metadata
    }
    assert declared == {key: {*each} for key, each in CHOICES.items() if key != "compile"}


@pytest.mark.parametrize("method", METHODS)
def test_what_a_command_line_gives_is_checked(method: str) -> None:
    """Test that the command applies the bounds of `check` and names the full key."""
    for key in numbers_of(from_hydra(composed(f"method={method}"))):
        if key.startswith("method.") and not key.endswith(("hidden", "encoder")):
            said = refusal(lambda key=key: checked(method, key, -1))
            assert re.match(rf"{re.escape(key)}=-1(\.0)?: must be ", said), said


@pytest.mark.parametrize(
    ("key", "value"),
    [("method.epochs", "many"), ("method.epochs", 1.5), ("ablation.k", "steep"), ("resume", "x")],
)
def test_a_value_of_another_type_is_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises((UserError, OmegaConfBaseException)) as refused:
        checked("ril", key, value)
    assert getattr(refused.value, "full_key", key) == key
    assert key in str(refused.value)


NAMES_OF_PARTS = [
    (method, key, field.name)
    for method in METHODS
    for key, part in parts(spec(method).config(), "method")
    for field in dataclasses.fields(part)
    if len(field.name) > 4
]


@given(which=st.sampled_from(NAMES_OF_PARTS), position=st.integers(0, 99))
def test_an_unknown_key_is_refused_and_the_near_one_suggested(
    which: tuple[str, str, str], position: int
) -> None:
    method, parent, name = which
    position %= len(name)
    misspelled = name[:position] + name[position + 1 :]
    siblings = {each for m, key, each in NAMES_OF_PARTS if (m, key) == (method, parent)}
    assume(misspelled not in siblings)
    said = refusal(lambda: checked(method, f"{parent}.{misspelled}", 1))
    assert said == f"{parent}.{misspelled}: no such key of method={method}; is it {name}?"


def test_an_unknown_key_that_resembles_none_names_them_all() -> None:
    said = refusal(lambda: checked("bc", "method.zzz", 1))
    assert said == ("method.zzz: no such key of method=bc; is it name, epochs, network, cloning?")


@pytest.mark.parametrize("name", ["../up", "/up", "a/../../up"])
def test_an_environments_name_stays_below_the_output_folder(name: str) -> None:
    said = refusal(lambda: checked("ril", "env.name", name))
    assert said == f"env.name={name}: must name a folder below output_dir"


@pytest.mark.parametrize(
    ("given", "seeds"),
    [(1, [0]), (3, [0, 1, 2]), ([7], [7]), ([5, 2], [5, 2]), (10, list(range(10)))],
)
def test_seeds_are_a_count_or_a_list(given: Any, seeds: list[int]) -> None:
    assert checked("ril", "seeds", given).seeds == seeds


@pytest.mark.parametrize(
    "given", [0, -3, [], [1, 1], [-1], "abc", 1.5, True, [1.0], ["a"], None, [[1]], {"a": 1}]
)
def test_other_seeds_are_refused(given: Any) -> None:
    said = refusal(lambda: checked("ril", "seeds", given))
    assert re.match(r"seeds=.*: must be a count of 1 or more, or a list", said)


@given(count=st.integers(1, 10**6), epochs=st.integers(1, 10**6))
def test_evaluations_are_that_many_epochs_apart(count: int, epochs: int) -> None:
    assert EvaluationConfig(1, count, 1).interval(epochs) == count


@given(percent=st.integers(1, 10_000), epochs=st.integers(1, 10**6))
def test_evaluations_are_that_share_of_the_epochs_apart(percent: int, epochs: int) -> None:
    interval = EvaluationConfig(1, f"{percent / 100}%", 1).interval(epochs)
    assert 1 <= interval <= epochs
    assert interval == 1 or abs(interval - epochs * percent / 10_000) < 1 + 1e-6


@pytest.mark.parametrize("every", ["often", "0%", "101%", "-1%", "1 %", 2.5, True, None])
def test_another_distance_of_evaluations_is_refused(every: Any) -> None:
    said = refusal(lambda: checked("ril", "evaluation.every", every))
    assert said.startswith(f"evaluation.every={every}: must be a count of epochs")
    assert "1%" in said


@pytest.mark.parametrize("every", [0, -1, -100])
def test_evaluations_cannot_be_no_epoch_apart(every: int) -> None:
    said = refusal(lambda: checked("ril", "evaluation.every", every))
    assert said.startswith(f"evaluation.every={every}: must be ")
