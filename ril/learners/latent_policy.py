"""ILPO's losses: learning a policy over latent actions from states alone (Edwards et al., 2019)."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import at_least, one_of, within
from ril.vectorized.latent_networks import Predictions


@dataclass
class LatentPolicyConfig:
    """Settings of ILPO's first step: a policy over latent actions, and the effects of these."""

    encoder: list[int] = MISSING
    generator: int = MISSING
    latents: int | None = MISSING
    changes: str = one_of("raw", "scaled", "standardized")
    negative_slope: float = at_least(0)
    learning_rate: float = MISSING
    beta1: float = within(0, 0.9999)
    updates: int = MISSING
    batch_size: int = MISSING


def latent_loss(predictions: Predictions, changes: Tensor) -> Tensor:
    """Compute ILPO's loss of the latent dynamics.

    mean min_z ‖Δ − g(s, z)‖² + mean ‖Δ − Σ_z π(z | s) g(s, z)‖²: the best latent action must
    predict the change, and so must their mean under the latent policy. The second term trains the
    latent policy and the encoder only; g receives no gradient from it.

    Args:
        predictions: for B states per seed.
        changes: Δ, (S, B, obs) true s' − s.

    Returns:
        (S,).
    """
    errors = (changes[:, :, None] - predictions.changes).square().sum(dim=-1)
    probabilities = predictions.logits.softmax(dim=-1)
    expected = (probabilities[..., None] * predictions.changes.detach()).sum(dim=2)
    expectation_error = (changes - expected).square().sum(dim=-1)
    return errors.amin(dim=-1).mean(dim=1) + expectation_error.mean(dim=1)


def nearest_latents(predictions: Predictions, changes: Tensor) -> Tensor:
    """Choose the latent actions whose predicted change is nearest to the true one.

    Args:
        predictions: for B states per seed.
        changes: Δ, (S, B, obs) true s' − s.

    Returns:
        (S, B) argmin_z ‖Δ − g(s, z)‖.
    """
    errors = (changes[:, :, None] - predictions.changes).square().sum(dim=-1)
    return errors.argmin(dim=-1)
