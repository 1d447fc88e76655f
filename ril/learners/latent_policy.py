"""A policy over latent actions, learnt from states alone (ILPO; Edwards et al., 2019).

Two networks: one that predicts, for each of |Z| latent actions, how the state will change, and
how likely the expert takes that action; and one that says which real action a latent one is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import at_least, one_of, within
from ril.vectorized.networks import Parameters, apply_linear, linear


@dataclass
class LatentPolicyConfig:
    """ILPO's first step: a policy over latent actions, and what each of them does."""

    encoder: list[int] = MISSING
    generator: int = MISSING
    latents: int | None = MISSING
    changes: str = one_of("raw", "scaled", "standardised")
    negative_slope: float = at_least(0)
    learning_rate: float = MISSING
    beta1: float = within(0, 0.9999)
    updates: int = MISSING
    batch_size: int = MISSING


class Predictions(NamedTuple):
    """What the latent dynamics say of B states."""

    logits: Tensor  # (S, B, |Z|) of the latent policy π(z | s)
    changes: Tensor  # (S, B, |Z|, obs) predicted s' − s under each z


@dataclass(frozen=True)
class LatentDynamics:
    """π(z | s) and g(s, z), which share their encoding of the state.

    Attributes:
        observations: entries of one state.
        latents: |Z|.
        encoder: neurons of the two layers that encode a state, (128, 256) in the paper.
        generator: neurons between a state-action embedding and the predicted change, 128.
        negative_slope: of LeakyReLU, 0.2.
    """

    observations: int
    latents: int
    encoder: tuple[int, int]
    generator: int
    negative_slope: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        first, code = self.encoder
        return {
            **linear("encoder0", self.observations, first),
            **linear("encoder1", first, code),
            **linear("latent", code, self.latents),
            **linear("embedding", self.latents, code),
            **linear("joint", 2 * code, code),
            **linear("generator0", code, self.generator),
            **linear("generator1", self.generator, self.observations),
        }

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, obs) states to (S, B, |Z|) logits of the latent policy."""
        return apply_linear(parameters, "latent", self._encode(parameters, x))

    def predict(self, parameters: Parameters, x: Tensor) -> Predictions:
        """(S, B, obs) states to logits and changes."""
        p, code = parameters, self._encode(parameters, x)
        # A one-hot z through a Linear is a row of its weight; and the Linear of a concatenation
        # is a sum, so the state's part of it is computed once for all z.
        embedding = self._activate(p["embedding.weight"] + p["embedding.bias"])  # (S, |Z|, code)
        of_state, of_latent = p["joint.weight"].chunk(2, dim=1)
        joint = torch.baddbmm(p["joint.bias"], code, of_state)[:, :, None]
        joint = self._activate(joint + torch.bmm(embedding, of_latent)[:, None])
        hidden = self._activate(apply_linear(p, "generator0", joint.flatten(1, 2)))
        changes = apply_linear(p, "generator1", hidden)
        shape = (*x.shape[:2], self.latents, self.observations)
        return Predictions(apply_linear(p, "latent", code), changes.view(shape))

    def _encode(self, p: Parameters, x: Tensor) -> Tensor:
        hidden = self._activate(apply_linear(p, "encoder0", x))
        return self._activate(apply_linear(p, "encoder1", hidden))

    def _activate(self, x: Tensor) -> Tensor:
        return functional.leaky_relu(x, self.negative_slope)


@dataclass(frozen=True)
class ActionRemapping:
    """π(a | s, z): which real action a latent one stands for in a state.

    Attributes:
        observations: entries of one state.
        latents: |Z|.
        actions: |A|.
        encoder: neurons of the two layers that encode a state, (128, 256) in the paper.
        hidden: neurons of the layers that join state and latent action, (64, 32).
        negative_slope: of LeakyReLU, 0.2.
    """

    observations: int
    latents: int
    actions: int
    encoder: tuple[int, int]
    hidden: tuple[int, int]
    negative_slope: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        first, code = self.encoder
        return {
            **linear("remap_encoder0", self.observations, first),
            **linear("remap_encoder1", first, code),
            **linear("remap_embedding", self.latents, code),
            **linear("remap_joint0", 2 * code, self.hidden[0]),
            **linear("remap_joint1", self.hidden[0], self.hidden[1]),
            **linear("remap_output", self.hidden[1], self.actions),
        }

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, obs + |Z|) states and one-hot latent actions to (S, B, |A|) logits."""
        p = parameters
        states, latents = x.split_with_sizes([self.observations, self.latents], dim=-1)
        code = self._activate(apply_linear(p, "remap_encoder0", states))
        code = self._activate(apply_linear(p, "remap_encoder1", code))
        embedding = self._activate(apply_linear(p, "remap_embedding", latents))
        joint = torch.cat((code, embedding), dim=-1)
        for layer in ("remap_joint0", "remap_joint1"):
            joint = self._activate(apply_linear(p, layer, joint))
        return apply_linear(p, "remap_output", joint)

    def _activate(self, x: Tensor) -> Tensor:
        return functional.leaky_relu(x, self.negative_slope)


@dataclass(frozen=True)
class LatentPolicy:
    """Both together: the likeliest latent action, and what it is in the environment.

    Attributes:
        dynamics: π(z | s).
        remapping: π(a | s, z).
    """

    dynamics: LatentDynamics
    remapping: ActionRemapping

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        return self.dynamics.shapes() | self.remapping.shapes()

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, obs) states to (S, B, |A|) logits."""
        latents = self.dynamics.forward(parameters, x).argmax(dim=-1)
        chosen = functional.one_hot(latents, self.dynamics.latents).to(x)
        return self.remapping.forward(parameters, torch.cat((x, chosen), dim=-1))


def latent_loss(predictions: Predictions, changes: Tensor) -> Tensor:
    """ILPO's loss: the best latent action must predict the change, and their mean must too.

    mean min_z ‖Δ − g(s, z)‖² + mean ‖Δ − Σ_z π(z | s) g(s, z)‖², where the second term trains the
    latent policy and its encoder only: g is held fixed in it.

    Args:
        predictions: of B states per seed.
        changes: (S, B, obs) true s' − s.

    Returns:
        (S,).
    """
    errors = (changes[:, :, None] - predictions.changes).square().sum(dim=-1)
    probabilities = predictions.logits.softmax(dim=-1)
    expected = (probabilities[..., None] * predictions.changes.detach()).sum(dim=2)
    expectation_error = (changes - expected).square().sum(dim=-1)
    return errors.amin(dim=-1).mean(dim=1) + expectation_error.mean(dim=1)


def nearest_latents(predictions: Predictions, changes: Tensor) -> Tensor:
    """(S, B) the z whose predicted change is nearest the true one: argmin_z ‖Δ − g(s, z)‖."""
    errors = (changes[:, :, None] - predictions.changes).square().sum(dim=-1)
    return errors.argmin(dim=-1)
