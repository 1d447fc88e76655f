"""Stable-Baselines3's PPO, one rollout at a time, with the environment's rewards or others."""

from __future__ import annotations

import dataclasses
import random
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import MISSING
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from ril.config.fields import at_least, within
from ril.environments import Environment, Floats, Integers
from ril.io.errors import UserError
from ril.learners.stable_baselines import Normalized, StableBaselinesEnvironments
from ril.learners.topology import tanh_mlp
from ril.vectorized.networks import MLP
from ril.vectorized.stepping import SteppedEnvironments


@dataclass
class PPOConfig:
    """Stable-Baselines3's names; `hidden` applies to policy and value function each."""

    hidden: list[int] = MISSING
    n_envs: int = MISSING
    n_steps: int = MISSING
    batch_size: int = MISSING
    n_epochs: int = MISSING
    learning_rate: float = MISSING
    gamma: float = within(0, 1)
    gae_lambda: float = within(0, 1)
    clip_range: float = MISSING
    ent_coef: float = at_least(0)


def actor_topology(config: PPOConfig, environment: Environment) -> MLP:
    """Build the architecture of the actor in "MlpPolicy": observations to action logits."""
    return tanh_mlp(environment.observation_size, config.hidden, environment.action_count)


class PPOAgent:
    """One seed's PPO, with its own random numbers and environments.

    Stable-Baselines3 draws from torch's and NumPy's global generators. While it works, they are
    set to the seed's own state, so that seeds trained side by side do not affect each other.

    Args:
        config: hyperparameters.
        environment: the task; the agent sees scaled observations.
        seed: seed of networks, actions, minibatches and episodes.
        normalize: whether to normalize observations and rewards by their running moments.
        schedule_steps: environment steps over which learning rate and clip range fall linearly
            to 0; None keeps them constant.

    Raises:
        UserError: the batch size does not divide a rollout.
    """

    def __init__(
        self,
        config: PPOConfig,
        environment: Environment,
        seed: int,
        *,
        normalize: bool = False,
        schedule_steps: int | None = None,
    ) -> None:
        rollout = config.n_envs * config.n_steps
        if config.batch_size < 2 or rollout % config.batch_size:
            raise UserError(
                f"method.ppo.batch_size={config.batch_size}: must be above 1 and divide a rollout, "
                f"n_envs · n_steps = {rollout}"
            )
        self._stepped = SteppedEnvironments(environment, [seed], config.n_envs, "ppo")
        self._environments: VecEnv = StableBaselinesEnvironments(self._stepped)
        if normalize:
            self._environments = Normalized(self._environments, config.gamma)
        self._schedule_steps = schedule_steps
        settings: dict[str, Any] = {name: getattr(config, name) for name in _ARGUMENTS}
        if schedule_steps is not None:
            scheduled = "learning_rate", "clip_range"
            settings |= {name: _linear_schedule(settings[name]) for name in scheduled}
        self._randomness = _randomness()
        with self._own_randomness():
            self.model = PPO(
                "MlpPolicy",
                self._environments,
                policy_kwargs={"net_arch": list(config.hidden)},
                seed=seed % 2**32,  # NumPy's global generator accepts no larger one
                device="cpu",
                **settings,
            )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.model.ep_info_buffer = self.model.ep_success_buffer = deque(maxlen=1)
        self.model._last_obs = self._environments.reset()
        self.model._last_episode_starts = np.ones(config.n_envs, dtype=bool)
        self._truncated = _TruncatedEpisodes()
        self._truncated.init_callback(self.model)

    def collect(self) -> tuple[Floats, Integers]:
        """Play `n_steps` in each of the K copies.

        Returns:
            (n_steps·K, obs) scaled states, normalized if `normalize`, and (n_steps·K,) the
            actions in them.
        """
        model = self.model
        with self._own_randomness():
            model.collect_rollouts(
                self._environments, self._truncated, model.rollout_buffer, model.n_steps
            )
        buffer = model.rollout_buffer
        observations = buffer.observations.reshape(-1, buffer.observations.shape[-1])
        return observations, buffer.actions.astype(np.int64).ravel()

    def improve(self, rewards: Floats | None = None) -> None:
        """Update policy and value function on the last rollout.

        Args:
            rewards: (n_steps·K,) rewards of the pairs from `collect`; None for the environment's.
        """
        model, buffer = self.model, self.model.rollout_buffer
        if rewards is not None:
            buffer.rewards[:] = rewards.reshape(buffer.rewards.shape)
        if self._schedule_steps is not None:
            # At least 0, because the last rollout may exceed the budget (docs/ppo.md, P4).
            model._current_progress_remaining = max(
                0.0, 1.0 - model.num_timesteps / self._schedule_steps
            )
        with self._own_randomness():
            for step, copy, final_observation in self._truncated.episodes:
                # The final state of a truncated episode has a value, as in SB3's own rollouts.
                buffer.rewards[step, copy] += model.gamma * self._value(final_observation[None])[0]
            assert isinstance(model._last_obs, np.ndarray)
            last_values = torch.from_numpy(self._value(model._last_obs))
            assert model._last_episode_starts is not None
            buffer.compute_returns_and_advantage(last_values, model._last_episode_starts)
            model.train()

    def _value(self, observations: Floats) -> Floats:
        """Compute values (N,) of scaled observations (N, obs)."""
        with torch.no_grad():
            values = self.model.policy.predict_values(torch.from_numpy(observations))
        flat: Floats = values.flatten().numpy()
        return flat

    def diagnostics(self) -> dict[str, float]:
        """Return what Stable-Baselines3 logged of its last update: means over minibatches."""
        logged = self.model.logger.name_to_value
        return {
            "entropy": -float(logged["train/entropy_loss"]),
            "value_loss": float(logged["train/value_loss"]),
            "approximate_kl": float(logged["train/approx_kl"]),
        }

    def actor(self) -> Tensor:
        """Return the actor's parameters (P,), as a row of a `Network` of `actor_topology`.

        Its inputs are scaled observations that are not normalized: that is folded into its first
        layer.
        """
        policy = self.model.policy
        modules = (*policy.mlp_extractor.policy_net, policy.action_net)
        layers = [(m.weight.T.detach(), m.bias.detach()) for m in modules if type(m) is nn.Linear]
        if isinstance(self._environments, Normalized):
            layers[0] = self._environments.fold(*layers[0])
        return torch.cat([parameter.reshape(-1) for layer in layers for parameter in layer])

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Set the global generators to the seed's own state, and restore them at the end."""
        outside, python = _randomness(), random.getstate()
        _set_randomness(self._randomness)
        try:
            yield
        finally:
            self._randomness = _randomness()
            _set_randomness(outside)
            random.setstate(python)  # SB3's PPO seeds it but draws nothing from it

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next rollout depends on, as tensors and plain values."""
        starts = self.model._last_episode_starts
        assert starts is not None
        state = {
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "steps": self.model.num_timesteps,
            "episode_starts": starts.tolist(),
            "environments": self._stepped.state_dict(),
            "randomness": self._randomness,
        }
        if isinstance(self._environments, Normalized):
            state["normalization"] = self._environments.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
        self.model.num_timesteps = state["steps"]
        self.model._last_episode_starts = np.array(state["episode_starts"])
        self._stepped.load_state_dict(state["environments"])
        self.model._last_obs = self._stepped.observations
        if isinstance(self._environments, Normalized):
            self._environments.load_state_dict(state["normalization"])
            self.model._last_obs = self._environments.normalize_obs(self._stepped.observations)
        self._randomness = state["randomness"]


#: Keys of PPOConfig that are arguments of PPO; the other two belong to networks and environments.
_ARGUMENTS = tuple(
    field.name for field in dataclasses.fields(PPOConfig) if field.name not in ("hidden", "n_envs")
)


def _linear_schedule(value: float) -> Callable[[float], float]:
    """Make a schedule that falls from `value` to 0 with the remaining share of the steps."""
    return lambda remaining: remaining * value


def _randomness() -> dict[str, Any]:
    """Return the state of torch's and NumPy's global generators, as a tensor and plain values."""
    state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002 - SB3 uses it
    inner = state["state"]
    return {
        "torch": torch.get_rng_state(),
        "numpy": [inner["key"].tolist(), inner["pos"], state["has_gauss"], state["gauss"]],
    }


def _set_randomness(state: dict[str, Any]) -> None:
    """Set both global generators to a state that `_randomness` returned."""
    torch.set_rng_state(state["torch"])
    key, *rest = state["numpy"]
    np.random.set_state(("MT19937", np.array(key, dtype=np.uint32), *rest))  # noqa: NPY002


class _TruncatedEpisodes(BaseCallback):
    """Records the episodes of a rollout that the step limit truncated.

    Attributes:
        episodes: of each, (step of the rollout, copy, final observation as the policy sees it).
    """

    def __init__(self) -> None:
        super().__init__()
        self.episodes: list[tuple[int, int, Floats]] = []

    def _on_rollout_start(self) -> None:
        self.episodes.clear()

    def _on_step(self) -> bool:
        for copy, info in enumerate(self.locals["infos"]):
            if info:
                step, final = self.locals["n_steps"], info["terminal_observation"]
                self.episodes.append((step, copy, final))
        return True
