"""Environments with Stable-Baselines3's interface, and its running normalization of them."""

from __future__ import annotations

# ruff: noqa: D102 - Stable-Baselines3 documents VecEnv's methods
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor

from ril.environments import Floats
from ril.vectorized.stepping import SteppedEnvironments


class StableBaselinesEnvironments(VecEnv):
    """`SteppedEnvironments` of one seed, with Stable-Baselines3's interface.

    `infos` has the final observation of a truncated episode, but not `TimeLimit.truncated`: with
    it, Stable-Baselines3 would add that state's value to the reward by itself.
    """

    def __init__(self, stepped: SteppedEnvironments) -> None:
        self.stepped = stepped
        environment, copies = stepped.environment, len(stepped.observations)
        self._chosen = np.zeros(copies, dtype=np.int64)
        super().__init__(
            copies,
            gym.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32),
            gym.spaces.Discrete(environment.action_count),
        )

    def reset(self) -> Floats:
        return self.stepped.observations

    def step_async(self, actions: NDArray[np.int64]) -> None:
        self._chosen = actions

    def step_wait(self) -> tuple[Floats, Floats, NDArray[np.bool_], list[dict[str, Any]]]:
        step = self.stepped.step(self._chosen)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for copy in np.flatnonzero(step.truncated).tolist():
            infos[copy]["terminal_observation"] = step.next_observations[copy]
        dones = step.terminated | step.truncated
        return self.stepped.observations, step.rewards, dones, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Normalized(VecNormalize):
    """Observations with running mean 0 and variance 1; rewards over their returns' deviation.

    Args:
        environments: the environments to normalize.
        gamma: γ of the returns.
    """

    def __init__(self, environments: VecEnv, gamma: float) -> None:
        # No clipping, because it could not be folded into a layer (docs/ppo.md, P3).
        super().__init__(environments, gamma=gamma, clip_obs=np.inf)
        self._observed = cast(RunningMeanStd, self.obs_rms)  # a dict only for dicts

    def fold(self, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        """Fold the normalization of observations into a layer xW + b.

        Args:
            weight: W, (obs, n), of a layer for normalized observations.
            bias: b, (n,).

        Returns:
            Weight and bias of the equivalent layer for observations that are not normalized.
        """
        deviation = torch.from_numpy(np.sqrt(self._observed.var + self.epsilon))
        folded = weight.double() / deviation[:, None]
        shifted = bias.double() - torch.from_numpy(self._observed.mean) @ folded
        return folded.to(weight.dtype), shifted.to(bias.dtype)

    def state_dict(self) -> dict[str, Any]:
        """Return the running moments and the returns of the current episodes, as plain values."""
        moments = [
            [np.asarray(each.mean).tolist(), np.asarray(each.var).tolist(), each.count]
            for each in (self._observed, self.ret_rms)
        ]
        return {"moments": moments, "returns": self.returns.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        for each, saved in zip((self._observed, self.ret_rms), state["moments"], strict=True):
            mean, var, each.count = saved
            each.mean, each.var = np.array(mean), np.array(var)
        self.returns = np.array(state["returns"])
