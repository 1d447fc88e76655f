from __future__ import annotations

import pytest
import torch
from helpers.references import SelfAttention
from torch import nn

from ril.vectorized.layers import layer_norm, self_attention

pytestmark = pytest.mark.quick

S, B = 3, 7


def inputs(size: int, *, rows: int = B) -> torch.Tensor:
    return torch.randn(S, rows, size, generator=torch.Generator().manual_seed(1))


def test_layer_norm_is_layer_norm_of_each_seed() -> None:
    x, weight, bias = inputs(4), inputs(4, rows=1), inputs(4, rows=1) + 1
    expected = []
    for seed in range(S):
        module = nn.LayerNorm(4)
        module.weight.data.copy_(weight[seed, 0])
        module.bias.data.copy_(bias[seed, 0])
        expected.append(module(x[seed]))
    torch.testing.assert_close(layer_norm(x, weight, bias), torch.stack(expected))


def full_attention_beside_ours(tokens: int) -> tuple[SelfAttention, torch.Tensor, torch.Tensor]:
    """Query/key/value attention over T tokens, its output, and ours with the same value weights."""
    torch.manual_seed(2)
    reference = SelfAttention(4)
    reference.gamma.data.fill_(0.7)
    x = torch.randn(B, tokens, 4)
    weight, bias = reference.value.weight.T[None], reference.value.bias[None, None]
    ours = self_attention(x.reshape(1, -1, 4), weight, bias, reference.gamma[None, None])
    return reference, reference(x), ours.reshape(x.shape)


def test_self_attention_over_one_token_needs_neither_query_nor_key() -> None:
    _, full, ours = full_attention_beside_ours(tokens=1)
    torch.testing.assert_close(ours, full)


def test_self_attention_over_two_tokens_would_need_them() -> None:
    _, full, ours = full_attention_beside_ours(tokens=2)
    assert not torch.allclose(ours, full)


@pytest.mark.parametrize(("tokens", "some"), [(1, False), (2, True)])
def test_query_and_key_get_a_gradient_only_beside_a_second_token(tokens: int, some: bool) -> None:
    reference, full, _ = full_attention_beside_ours(tokens)
    full.square().sum().backward()
    for projection in (reference.query, reference.key):
        assert bool(projection.weight.grad.any()) is some


def test_value_gradient_is_that_of_full_attention() -> None:
    reference, full, ours = full_attention_beside_ours(tokens=1)
    parameters = [reference.value.weight, reference.value.bias, reference.gamma]
    expected = torch.autograd.grad(full.square().sum(), parameters)
    torch.testing.assert_close(torch.autograd.grad(ours.square().sum(), parameters), expected)
