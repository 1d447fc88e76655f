from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.references import copies_of, flat_of, gradients_of, random_network
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from ril.vectorized.architectures import MLP, ActorCritic, Consistent, Dueling, Standardized
from ril.vectorized.networks import Network, parameter_count

pytestmark = pytest.mark.quick

CPU = torch.device("cpu")
FULL = MLP(inputs=3, hidden=(8, 5), outputs=2)
PLAIN = dataclasses.replace(FULL, attention=False, layer_norm=False)
S, B = 3, 7

architectures = st.builds(
    MLP,
    inputs=st.integers(1, 5),
    hidden=st.lists(st.integers(1, 6), max_size=3).map(tuple),
    outputs=st.integers(1, 4),
    attention=st.booleans(),
    layer_norm=st.booleans(),
    negative_slope=st.sampled_from([0.0, 0.01, 0.3, None]),
)


def inputs(size: int, *, rows: int = B) -> torch.Tensor:
    return torch.randn(S, rows, size, generator=torch.Generator().manual_seed(1))


def assert_like_modules(architecture: MLP) -> None:
    network, x = random_network(architecture, S), inputs(architecture.inputs)
    expected = [module(rows) for module, rows in zip(copies_of(network), x, strict=True)]
    torch.testing.assert_close(network(x), torch.stack(expected))


def test_linear_is_linear_of_each_seed() -> None:
    assert_like_modules(dataclasses.replace(PLAIN, hidden=()))


@pytest.mark.parametrize("slope", [0.0, 0.01, 0.2])
def test_leaky_relu_has_the_slope_of_the_architecture(slope: float) -> None:
    assert_like_modules(dataclasses.replace(PLAIN, negative_slope=slope))


def test_without_a_slope_the_activation_is_tanh() -> None:
    assert_like_modules(dataclasses.replace(PLAIN, negative_slope=None))


@given(architectures)
def test_parameter_count_is_that_of_the_modules(architecture: MLP) -> None:
    reference = copies_of(random_network(architecture, 1))[0]
    assert parameter_count(architecture) == flat_of(reference).numel()


@given(architectures)
def test_network_is_its_modules_of_each_seed(architecture: MLP) -> None:
    assert_like_modules(architecture)


@given(architectures)
def test_gradient_is_that_of_each_seeds_modules(architecture: MLP) -> None:
    network, x = random_network(architecture, S), inputs(architecture.inputs)
    expected = []
    for module, rows in zip(copies_of(network), x, strict=True):
        module(rows).square().mean().backward()
        expected.append(flat_of(module, gradients=True))
    found = gradients_of(network, network(x).square().mean(dim=(1, 2)))
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-3, atol=1e-4)


@st.composite
def dueling(draw: st.DrawFn) -> Dueling:
    """Two streams over the same inputs, each of any shape."""
    value, advantage = draw(architectures), draw(architectures)
    return Dueling(dataclasses.replace(value, inputs=advantage.inputs, outputs=1), advantage)


def streams_of(network: Network, *names: str) -> list[tuple[nn.Sequential, ...]]:
    """Each seed's streams of these names as modules of torch.nn; a parameter names its own."""
    architecture, streams = network.architecture, []
    for name in names:
        named = [p for key, p in network.parameters.items() if f".{name}." in key]
        flat = torch.cat([p.detach().reshape(S, -1) for p in named], dim=1)
        streams.append(copies_of(Network(getattr(architecture, name), flat)))
    return list(zip(*streams, strict=True))


@given(dueling())
def test_dueling_is_state_values_and_advantages_around_their_mean(architecture: Dueling) -> None:
    network, x = random_network(architecture, S), inputs(architecture.value.inputs)
    expected = []
    for (value, advantage), rows in zip(streams_of(network, "value", "advantage"), x, strict=True):
        values, advantages = value(rows), advantage(rows)
        mean = advantages.sum(dim=1, keepdim=True) / architecture.advantage.outputs
        expected.append(values.expand_as(advantages) + (advantages - mean))
    torch.testing.assert_close(network(x), torch.stack(expected), rtol=1e-4, atol=1e-5)


@given(dueling())
def test_dueling_has_the_parameters_of_both_streams(architecture: Dueling) -> None:
    both = parameter_count(architecture.value) + parameter_count(architecture.advantage)
    assert parameter_count(architecture) == both


DUELING = Dueling(dataclasses.replace(PLAIN, outputs=1), PLAIN)


@pytest.mark.parametrize("architecture", [DUELING, Dueling(FULL, FULL)])
def test_dueling_streams_begin_as_two_networks_would(architecture: Dueling) -> None:
    parameters = Network.initialize(architecture, range(200), "policy", CPU).parameters
    for stream in ("value", "advantage"):
        for layer, fan_in in (("linear0", 3), ("linear1", 8), ("output", 5)):
            for kind in ("weight", "bias"):
                sizes = parameters[f"{layer}.{stream}.{kind}"].abs()
                assert 0.95 * fan_in**-0.5 < sizes.max() <= fan_in**-0.5, (layer, kind)
                assert sizes.mean().item() == pytest.approx(0.5 * fan_in**-0.5, rel=0.1)


def test_dueling_attention_and_layer_norm_begin_as_an_mlps() -> None:
    parameters = Network.initialize(Dueling(FULL, FULL), (0, 1), "policy", CPU).parameters
    for stream in ("value", "advantage"):
        assert not parameters[f"value1.{stream}.gamma"].any()
        assert (parameters[f"norm1.{stream}.weight"] == 1).all()
        assert (parameters[f"norm1.{stream}.bias"] == 0).all()


TEMPERATURES = (0.01, 0.1, 1.0, 3.0)


@st.composite
def consistent(draw: st.DrawFn) -> Consistent:
    """Two streams over the same inputs, each of any shape."""
    value, policy = draw(architectures), draw(architectures)
    value = dataclasses.replace(value, inputs=policy.inputs, outputs=1)
    scale = draw(st.sampled_from([0.5, 1.0, 50.0]))
    return Consistent(value, policy, draw(st.sampled_from(TEMPERATURES)), scale)


@given(consistent())
def test_consistent_values_are_a_state_value_and_scaled_log_chances(
    architecture: Consistent,
) -> None:
    network, x = random_network(architecture, S), inputs(architecture.value.inputs)
    expected = []
    for (value, policy), rows in zip(streams_of(network, "value", "policy"), x, strict=True):
        chances = policy(rows).softmax(dim=1).clamp(min=1e-30)
        values = architecture.value_scale * value(rows).expand_as(chances)
        expected.append(values + architecture.temperature * chances.log())
    torch.testing.assert_close(network(x), torch.stack(expected), rtol=1e-3, atol=1e-3)


def consistent_streams(temperature: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values Q (S, B, |A|) of a consistent network, its V (S, B) and its policy's logits."""
    policy = dataclasses.replace(FULL, outputs=4)
    value = dataclasses.replace(PLAIN, hidden=(6,), outputs=1)
    network, x = random_network(Consistent(value, policy, temperature, 2.0), S), inputs(3)
    pairs = zip(streams_of(network, "value", "policy"), x, strict=True)
    both = [(2.0 * v(rows).squeeze(1), p(rows)) for (v, p), rows in pairs]
    values, logits = (torch.stack(each) for each in zip(*both, strict=True))
    return network(x), values, logits


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_the_largest_consistent_value_is_the_likeliest_actions(temperature: float) -> None:
    q, _, logits = consistent_streams(temperature)
    assert torch.equal(q.argmax(dim=-1), logits.argmax(dim=-1))
    assert len(logits.argmax(dim=-1).unique()) > 1


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_the_softmax_of_consistent_values_is_the_policy(temperature: float) -> None:
    q, _, logits = consistent_streams(temperature)
    found = (q / temperature).softmax(dim=-1)
    torch.testing.assert_close(found, logits.softmax(dim=-1), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_the_soft_maximum_of_consistent_values_is_the_state_value(temperature: float) -> None:
    q, values, _ = consistent_streams(temperature)
    found = temperature * (q / temperature).logsumexp(dim=-1)
    torch.testing.assert_close(found, values, rtol=1e-4, atol=1e-5)


@given(consistent())
def test_consistent_has_the_parameters_of_both_streams_the_values_first(
    architecture: Consistent,
) -> None:
    of_value, of_policy = map(parameter_count, (architecture.value, architecture.policy))
    assert parameter_count(architecture) == of_value + of_policy
    network, x = random_network(architecture, S), inputs(architecture.policy.inputs)
    alone = Network(architecture.policy, network.flat[:, of_value:])  # a view
    expected = [
        policy(rows) for (policy,), rows in zip(streams_of(network, "policy"), x, strict=True)
    ]
    torch.testing.assert_close(alone(x), torch.stack(expected))


def test_consistent_streams_begin_as_two_networks_would() -> None:
    value = dataclasses.replace(FULL, hidden=(4, 6), outputs=1)
    parameters = Network.initialize(
        Consistent(value, FULL, 0.1, 50.0), range(200), "policy", CPU
    ).parameters
    for stream, fan_ins in (("value", (3, 4, 6)), ("policy", (3, 8, 5))):
        for layer, fan_in in zip(("linear0", "linear1", "output"), fan_ins, strict=True):
            for kind in ("weight", "bias"):
                sizes = parameters[f"{layer}.{stream}.{kind}"].abs()
                assert 0.95 * fan_in**-0.5 < sizes.max() <= fan_in**-0.5, (layer, kind)
                assert sizes.mean().item() == pytest.approx(0.5 * fan_in**-0.5, rel=0.1)
        assert not parameters[f"value1.{stream}.gamma"].any()
        assert (parameters[f"norm1.{stream}.weight"] == 1).all()
        assert (parameters[f"norm1.{stream}.bias"] == 0).all()


def test_an_actor_and_its_critic_are_two_networks_in_one_buffer() -> None:
    critic = dataclasses.replace(PLAIN, hidden=(5,), outputs=1)
    both, x = random_network(ActorCritic(PLAIN, critic), S), inputs(PLAIN.inputs)
    split = parameter_count(PLAIN)
    actor, value = both.flat[:, :split].clone(), both.flat[:, split:].clone()
    assert torch.equal(both(x), Network(PLAIN, actor)(x))
    values = both.architecture.values(both.parameters, x)
    assert torch.equal(values, Network(critic, value)(x).squeeze(-1))


def test_inputs_are_standardized_and_clipped() -> None:
    network = random_network(Standardized(PLAIN, clip=0.5), S)
    network.parameters["standardize.deviation"].data.abs_()
    x = inputs(PLAIN.inputs)
    moments, inner = network.flat[:, : 2 * PLAIN.inputs], network.flat[:, 2 * PLAIN.inputs :]
    mean, deviation = moments.unsqueeze(1).chunk(2, dim=-1)
    standardized = (x - mean) / deviation
    assert (standardized.abs() > 0.5).any()
    expected = Network(PLAIN, inner.clone())(standardized.clip(-0.5, 0.5))
    torch.testing.assert_close(network(x), expected)
