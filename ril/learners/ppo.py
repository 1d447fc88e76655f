"""Stable-Baselines3's PPO as a part: one rollout at a time, its rewards given from outside."""

from __future__ import annotations

import dataclasses
import random
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from ril.environments import Environment, Floats
from ril.errors import UserError
from ril.schema import PPOConfig
from ril.vectorized.networks import MLP
from ril.vectorized.rollout import Integers
from ril.vectorized.stepping import SteppedEnvironments


def actor_topology(config: PPOConfig, environment: Environment) -> MLP:
    """What acts in "MlpPolicy": tanh layers between observations and action logits."""
    return MLP(
        environment.observation_size,
        tuple(config.hidden),
        environment.action_count,
        attention=False,
        layer_norm=False,
        negative_slope=None,
    )


class PPOAgent:
    """One seed's PPO with random numbers and environments of its own.

    Stable-Baselines3 draws from torch's and numpy's global generators; here they are put in the
    seed's own state while it works, so that seeds trained side by side cannot reach each other.

    Args:
        config: hyperparameters.
        environment: the task; the agent sees scaled observations.
        seed: of networks, actions, minibatches and episodes.

    Raises:
        UserError: minibatches do not fit into a rollout.
    """

    def __init__(self, config: PPOConfig, environment: Environment, seed: int) -> None:
        rollout = config.n_envs * config.n_steps
        if config.batch_size < 2 or rollout % config.batch_size:
            raise UserError(
                f"method.ppo.batch_size={config.batch_size}: must be above 1 and divide a rollout, "
                f"n_envs · n_steps = {rollout}"
            )
        self._environments = _StableBaselinesEnvironments(environment, seed, config.n_envs)
        self._randomness = _randomness()
        settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_OF_PPO}
        with self._own_randomness():
            self.model = PPO(
                "MlpPolicy",
                self._environments,
                policy_kwargs={"net_arch": list(config.hidden)},
                seed=seed % 2**32,  # the most that numpy takes
                device="cpu",
                **settings,
            )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.model.ep_info_buffer = self.model.ep_success_buffer = deque(maxlen=1)
        self.model._last_obs = self._environments.reset()
        self.model._last_episode_starts = np.ones(config.n_envs, dtype=bool)
        self._callback = _Nothing()
        self._callback.init_callback(self.model)

    def collect(self) -> tuple[Floats, Integers]:
        """Play `n_steps` in each of the K copies.

        Returns:
            (n_steps·K, obs) scaled states, and (n_steps·K,) the actions taken in them.
        """
        model = self.model
        self._environments.begin_rollout()
        with self._own_randomness():
            model.collect_rollouts(
                self._environments, self._callback, model.rollout_buffer, model.n_steps
            )
        buffer = model.rollout_buffer
        observations = buffer.observations.reshape(-1, buffer.observations.shape[-1])
        return observations, buffer.actions.astype(np.int64).ravel()

    def improve(self, rewards: Floats) -> None:
        """PPO's update on the last rollout.

        Args:
            rewards: (n_steps·K,) for what `collect` gave; the environment's own are not used.
        """
        model, buffer = self.model, self.model.rollout_buffer
        buffer.rewards[:] = rewards.reshape(buffer.rewards.shape)
        with self._own_randomness():
            for step, copy, final_observation in self._environments.cut:
                # An episode that the step limit cut would have gone on (as in SB3's own rollouts).
                buffer.rewards[step, copy] += model.gamma * self._value(final_observation[None])[0]
            assert isinstance(model._last_obs, np.ndarray)
            last_values = torch.from_numpy(self._value(model._last_obs))
            assert model._last_episode_starts is not None
            buffer.compute_returns_and_advantage(last_values, model._last_episode_starts)
            model.train()

    def _value(self, observations: Floats) -> Floats:
        """(N, obs) scaled observations to (N,) values."""
        with torch.no_grad():
            values = self.model.policy.predict_values(torch.from_numpy(observations))
        flat: Floats = values.flatten().numpy()
        return flat

    def actor(self) -> Tensor:
        """(P,) the policy's parameters, as a row of a `Network` of `actor_topology`."""
        policy = self.model.policy
        layers = [m for m in policy.mlp_extractor.policy_net if isinstance(m, nn.Linear)]
        assert isinstance(policy.action_net, nn.Linear)
        parameters = [p for m in (*layers, policy.action_net) for p in (m.weight.T, m.bias)]
        return torch.cat([p.detach().reshape(-1) for p in parameters])

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        outside, python = _randomness(), random.getstate()
        _set_randomness(self._randomness)
        try:
            yield
        finally:
            self._randomness = _randomness()
            _set_randomness(outside)
            random.setstate(python)  # seeded by SB3's PPO, which then draws nothing from it

    def state_dict(self) -> dict[str, Any]:
        """All that the next rollout depends on, as tensors and plain values."""
        starts = self.model._last_episode_starts
        assert starts is not None
        return {
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "episode_starts": starts.tolist(),
            "environments": self._environments.stepped.state_dict(),
            "randomness": self._randomness,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
        self.model._last_episode_starts = np.array(state["episode_starts"])
        self._environments.stepped.load_state_dict(state["environments"])
        self.model._last_obs = self._environments.stepped.observations
        self._randomness = state["randomness"]


_NOT_OF_PPO = ("hidden", "n_envs")  # keys of PPOConfig that PPO takes by other ways


def _randomness() -> dict[str, Any]:
    """Torch's and numpy's global generators, as a tensor and plain values."""
    state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002 - what SB3 draws from
    inner = state["state"]
    return {
        "torch": torch.get_rng_state(),
        "numpy": [inner["key"].tolist(), inner["pos"], state["has_gauss"], state["gauss"]],
    }


def _set_randomness(state: dict[str, Any]) -> None:
    torch.set_rng_state(state["torch"])
    key, *rest = state["numpy"]
    np.random.set_state(("MT19937", np.array(key, dtype=np.uint32), *rest))  # noqa: NPY002


class _Nothing(BaseCallback):
    """Stable-Baselines3 wants a callback; this one lets it go on."""

    def _on_step(self) -> bool:
        return True


class _StableBaselinesEnvironments(VecEnv):
    """`SteppedEnvironments` of one seed, as Stable-Baselines3 wants them.

    Attributes:
        cut: (step of the rollout, copy, final observation) of each episode that the limit cut.
    """

    def __init__(self, environment: Environment, seed: int, copies: int) -> None:
        self.stepped = SteppedEnvironments(environment, [seed], copies, "ppo")
        self.cut: list[tuple[int, int, Floats]] = []
        self._step = 0
        self._chosen = np.zeros(copies, dtype=np.int64)
        self._no_infos: list[dict[str, Any]] = [{} for _ in range(copies)]
        super().__init__(
            copies,
            gym.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32),
            gym.spaces.Discrete(environment.action_count),
        )

    def begin_rollout(self) -> None:
        """Count steps from 0 again."""
        self._step = 0
        self.cut.clear()

    def reset(self) -> Floats:
        return self.stepped.observations

    def step_async(self, actions: NDArray[np.int64]) -> None:
        self._chosen = actions

    def step_wait(self) -> tuple[Floats, Floats, NDArray[np.bool_], list[dict[str, Any]]]:
        step = self.stepped.step(self._chosen)
        for copy in np.flatnonzero(step.truncated).tolist():
            self.cut.append((self._step, copy, step.next_observations[copy]))
        self._step += 1
        dones = step.terminated | step.truncated
        return self.stepped.observations, step.rewards, dones, self._no_infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
