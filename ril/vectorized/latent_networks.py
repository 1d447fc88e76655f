"""The networks of ILPO (Edwards et al., 2019), whose policy acts through latent actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from ril.vectorized.layers import Parameters, apply_linear, linear


class Predictions(NamedTuple):
    """Outputs of the latent dynamics for B states."""

    logits: Tensor  # (S, B, |Z|) of the latent policy π(z | s)
    changes: Tensor  # (S, B, |Z|, obs) predicted s' − s under each z


@dataclass(frozen=True)
class LatentDynamics:
    """The latent policy π(z | s) and the forward model g(s, z), which share a state encoder.

    Attributes:
        observations: entries of one state.
        latents: |Z|.
        encoder: neurons of the two layers of the state encoder, (128, 256) in ILPO's paper.
        generator: neurons of the layer before the predicted change, 128 in ILPO's paper.
        negative_slope: of LeakyReLU, 0.2.
    """

    observations: int
    latents: int
    encoder: tuple[int, int]
    generator: int
    negative_slope: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
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
        """Map states (S, B, obs) to (S, B, |Z|) logits of the latent policy."""
        return apply_linear(parameters, "latent", self._encode(parameters, x))

    def predict(self, parameters: Parameters, x: Tensor) -> Predictions:
        """Map states (S, B, obs) to the latent policy's logits and the predicted changes."""
        p, code = parameters, self._encode(parameters, x)
        # A Linear of a one-hot z is a row of its weight, and a Linear of a concatenation is a
        # sum, so the state's part of it is computed once for all z.
        embedding = self._activate(p["embedding.weight"] + p["embedding.bias"])  # (S, |Z|, code)
        of_state, of_latent = p["joint.weight"].chunk(2, dim=1)
        joint = torch.baddbmm(p["joint.bias"], code, of_state)[:, :, None]
        joint = self._activate(joint + torch.bmm(embedding, of_latent)[:, None])
        hidden = self._activate(apply_linear(p, "generator0", joint.flatten(1, 2)))
        changes = apply_linear(p, "generator1", hidden)
        shape = (*x.shape[:2], self.latents, self.observations)
        return Predictions(apply_linear(p, "latent", code), changes.view(shape))

    def _encode(self, p: Parameters, x: Tensor) -> Tensor:
        """Encode states: (S, B, obs) to (S, B, code)."""
        hidden = self._activate(apply_linear(p, "encoder0", x))
        return self._activate(apply_linear(p, "encoder1", hidden))

    def _activate(self, x: Tensor) -> Tensor:
        return functional.leaky_relu(x, self.negative_slope)


@dataclass(frozen=True)
class ActionRemapping:
    """The policy π(a | s, z): which real action a latent action stands for in a state.

    Attributes:
        observations: entries of one state.
        latents: |Z|.
        actions: |A|.
        encoder: neurons of the two layers of the state encoder, (128, 256) in ILPO's paper.
        hidden: neurons of the two layers after the encoders, (64, 32) in ILPO's paper.
        negative_slope: of LeakyReLU, 0.2.
    """

    observations: int
    latents: int
    actions: int
    encoder: tuple[int, int]
    hidden: tuple[int, int]
    negative_slope: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
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
        """Map states with one-hot latent actions (S, B, obs + |Z|) to (S, B, |A|) logits."""
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
    """ILPO's whole policy: the likeliest latent action, mapped to an action.

    Attributes:
        dynamics: π(z | s).
        remapping: π(a | s, z).
    """

    dynamics: LatentDynamics
    remapping: ActionRemapping

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
        return self.dynamics.shapes() | self.remapping.shapes()

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map states (S, B, obs) to (S, B, |A|) logits."""
        latents = self.dynamics.forward(parameters, x).argmax(dim=-1)
        chosen = functional.one_hot(latents, self.dynamics.latents).to(x)
        return self.remapping.forward(parameters, torch.cat((x, chosen), dim=-1))
