"""Q-learning on the policy's own episodes (§3.3, eq. 1)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ril.schema import QLearningConfig
from ril.vectorized.networks import Network
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


def td_targets(batch: Batch, next_values: Tensor, discount: float) -> Tensor:
    """R_{t+1} + γ max_a Q(S_{t+1}, a), without the second term at terminal states (eq. 1).

    Args:
        batch: B transitions per seed.
        next_values: (S, B, |A|) Q(S_{t+1}, ·).
        discount: γ.

    Returns:
        (S, B).
    """
    return batch.rewards + discount * (1 - batch.terminated) * next_values.amax(dim=-1)


def td_loss(values: Tensor, batch: Batch, targets: Tensor, loss: str) -> Tensor:
    """Mean loss of the temporal differences of eq. 1.

    Args:
        values: (S, B, |A|) Q(S_t, ·).
        batch: whose actions say which of them were taken.
        targets: (S, B), without a gradient.
        loss: "huber" (threshold 1) or "mse".

    Returns:
        (S,).
    """
    taken = values.gather(-1, batch.actions[..., None]).squeeze(-1)
    distance = functional.smooth_l1_loss if loss == "huber" else functional.mse_loss
    return distance(taken, targets, reduction="none").mean(dim=1)


class QLearning:
    """S policies read as Q-functions, trained from replay.

    Args:
        policy: from obs features to |A| values.
        replay: each seed's memory, filled by the method.
        config: `method.q_learning`.
        streams: from which minibatches are drawn.
    """

    def __init__(
        self, policy: Network, replay: Replay, config: QLearningConfig, streams: Streams
    ) -> None:
        self.policy = policy
        self.replay = replay
        self.config = config
        self._streams = streams
        self._target = policy.copy() if config.target_interval else policy
        self._optimizer = ClippedAdam(policy, config.learning_rate, config.gradient_clip)

    def train(self, updates: int) -> Tensor:
        """Algorithm 1, line 13: minibatch steps of the temporal-difference loss.

        Args:
            updates: how many steps.

        Returns:
            (S,) mean loss over them.
        """
        config, device = self.config, self.policy.flat.device
        uniform = self._streams.uniform(updates, config.batch_size)
        indices = random_indices(uniform, self.replay.sizes).to(device)
        memory = self.replay.everything()
        total = torch.zeros(len(indices), device=device)
        for update in range(updates):
            if config.target_interval and self._optimizer.steps % config.target_interval == 0:
                self._target.flat.copy_(self.policy.flat)
            batch = memory.at(indices[:, update])
            with torch.no_grad():
                targets = td_targets(batch, self._target(batch.next_observations), config.discount)
            losses = td_loss(self.policy(batch.observations), batch, targets, config.loss)
            self._optimizer.step(losses)
            total += losses.detach()
        return total / max(updates, 1)

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, target network, replay and random streams."""
        return {
            "optimizer": self._optimizer.state_dict(),
            "target": self._target.flat,
            "replay": self.replay.state_dict(),
            "streams": self._streams.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self._optimizer.load_state_dict(state["optimizer"])
        self._target.flat.copy_(state["target"])
        self.replay.load_state_dict(state["replay"])
        self._streams.load_state_dict(state["streams"])
