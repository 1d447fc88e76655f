"""Losses of S networks, one number per sample."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional


def cross_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """Compute the cross-entropy of each sample.

    Args:
        logits: (S, B, |A|).
        labels: (S, B) actions.

    Returns:
        (S, B).
    """
    losses = functional.cross_entropy(logits.flatten(0, 1), labels.flatten(), reduction="none")
    return losses.view(labels.shape)
