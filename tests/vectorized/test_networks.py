from __future__ import annotations

import pytest
import torch
from helpers.references import gradients_of, random_network

from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network, by_name, parameter_count

pytestmark = pytest.mark.quick

CPU = torch.device("cpu")
FULL = MLP(inputs=3, hidden=(8, 5), outputs=2)
S, B = 3, 7


def inputs(size: int, *, rows: int = B) -> torch.Tensor:
    return torch.randn(S, rows, size, generator=torch.Generator().manual_seed(1))


def test_parameters_by_name_lie_side_by_side() -> None:
    flat = torch.arange(2.0 * parameter_count(FULL)).view(2, -1)
    found = by_name(FULL, flat)
    assert {name: view.shape[1:] for name, view in found.items()} == FULL.shapes()
    assert torch.equal(torch.cat([view.reshape(2, -1) for view in found.values()], dim=1), flat)


def test_parameters_by_name_are_views() -> None:
    flat = torch.zeros(2, parameter_count(FULL))
    by_name(FULL, flat)["output.bias"][1] += 1
    assert flat.sum().item() == FULL.outputs


def test_no_seed_reaches_another() -> None:
    network, x = random_network(FULL, S), inputs(3)
    before = network(x)
    with torch.no_grad():
        network.flat[1] += 1.0
        x[1] += 1.0
    after = network(x)
    assert torch.equal(before[[0, 2]], after[[0, 2]])
    assert not torch.equal(before[1], after[1])


# One of a size is where torch multiplies by a vector, whose rounding differs from that of a matrix.
@pytest.mark.parametrize("rows", [1, 2, 7, 32, 256])
@pytest.mark.parametrize("size", [1, 2, 8, 100])
@pytest.mark.parametrize("outputs", [1, 2, 4, 100])
def test_a_seeds_numbers_do_not_depend_on_other_seeds(rows: int, size: int, outputs: int) -> None:
    among = random_network(MLP(size, (), outputs), S)
    alone, x = Network(among.architecture, among.flat[1:2].clone()), inputs(size, rows=rows)
    values = [network(part) for network, part in ((among, x), (alone, x[1:2]))]
    assert torch.equal(values[0][1], values[1][0])
    gradients = [
        gradients_of(network, found.square().sum(dim=(1, 2)))
        for network, found in zip((among, alone), values, strict=True)
    ]
    assert torch.equal(gradients[0][1], gradients[1][0])


def test_parameters_are_views_of_the_flat_buffer() -> None:
    network, x = random_network(FULL, S), inputs(3)
    network.flat.zero_()
    assert not network(x).any()


def test_a_copy_answers_alike() -> None:
    network, x = random_network(FULL, S), inputs(3)
    assert torch.equal(network.copy()(x), network(x))


def test_a_copy_has_a_buffer_of_its_own() -> None:
    network, x = random_network(FULL, S), inputs(3)
    before = network(x)
    network.copy().flat.zero_()
    assert torch.equal(network(x), before)


def initialized(*seeds: int, purpose: str = "policy") -> Network:
    return Network.initialize(FULL, seeds, purpose, CPU)


def test_initial_parameters_do_not_depend_on_other_seeds() -> None:
    assert torch.equal(initialized(5).flat[0], initialized(3, 5, 9).flat[1])


def test_seeds_differ_in_initial_parameters() -> None:
    first, second = initialized(0, 1).flat
    assert not torch.equal(first, second)


def test_purposes_differ_in_initial_parameters() -> None:
    assert not torch.equal(initialized(0).flat, initialized(0, purpose="other").flat)


@pytest.mark.parametrize("name", ["linear0", "value0", "linear1", "value1", "output"])
@pytest.mark.parametrize("kind", ["weight", "bias"])
def test_initial_linear_layers_fill_the_range_of_torch(name: str, kind: str) -> None:
    network = initialized(*range(200))
    fan_in = network.parameters[f"{name}.weight"].shape[1]
    sizes = network.parameters[f"{name}.{kind}"].abs()
    # torch.nn.Linear draws weight and bias uniformly within ±1/√fan_in.
    assert sizes.max() <= fan_in**-0.5
    assert sizes.max() > 0.98 * fan_in**-0.5
    assert sizes.mean().item() == pytest.approx(0.5 * fan_in**-0.5, rel=0.1)


def test_attention_begins_as_the_identity() -> None:
    assert not initialized(0, 1).parameters["value0.gamma"].any()


def test_layer_norm_begins_with_scale_one_and_no_shift() -> None:
    parameters = initialized(0, 1).parameters
    assert (parameters["norm1.weight"] == 1).all()
    assert (parameters["norm1.bias"] == 0).all()
